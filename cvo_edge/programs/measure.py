"""Measurements: latency quantiles per stage, memory, and the environment."""

from __future__ import annotations

import contextlib
import os
import platform
import resource
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from cvo_edge.engine.cores import allowed_cores

STAGES = ("read", "preprocess", "model", "conformal", "total")


class LatencyProfile:
    """Latencies per stage in bounded memory.

    Each stage has a ring buffer of ``capacity`` values, so the quantiles of a longer run are those
    of its last ``capacity`` frames.
    """

    def __init__(self, stages: Iterable[str] = STAGES, capacity: int = 100_000) -> None:
        self._values = {stage: np.empty(min(capacity, 1024), np.float32) for stage in stages}
        self._capacity = capacity
        self.count = 0

    def add(self, latency_ms: Mapping[str, float]) -> None:
        """Record the milliseconds of one frame by stage."""
        index = self.count % self._capacity
        for stage, values in self._values.items():
            if index >= values.size:
                size = min(self._capacity, 2 * values.size)
                values = np.resize(values, size)
                self._values[stage] = values
            values[index] = latency_ms[stage]
        self.count += 1

    def summary(self) -> dict[str, dict[str, float]]:
        """Return p50, p90, p95, p99 and mean in milliseconds by stage; empty without frames."""
        kept = min(self.count, self._capacity)
        return {stage: quantiles(values[:kept]) for stage, values in self._values.items() if kept}


def quantiles(values_ms: ArrayLike) -> dict[str, float]:
    """Return p50, p90, p95, p99 and mean of milliseconds, rounded to 0.1 us."""
    values = np.asarray(values_ms, dtype=np.float64)
    found = {f"p{q}": float(np.percentile(values, q)) for q in (50, 90, 95, 99)}
    found["mean"] = float(values.mean())
    return {name: round(value, 4) for name, value in found.items()}


class Memory(TypedDict):
    """Peak, current and anonymous resident memory in MiB; None if the system does not tell."""

    peak_rss: float
    rss: float | None
    anonymous: float | None


def memory_mib() -> Memory:
    """Return the memory of this process; without /proc, the peak alone is known."""
    kib: dict[str, float | None] = {"VmHWM": None, "VmRSS": None, "RssAnon": None}
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            name, _, value = line.partition(":")
            if name in kib:
                kib[name] = float(value.split()[0])
    except OSError:
        pass
    peak = kib["VmHWM"]
    if peak is None:
        # In KiB on Linux and bytes on macOS.
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        peak = peak / 1024 if sys.platform == "darwin" else peak
    return {
        "peak_rss": round(peak / 1024, 1),
        "rss": _mib(kib["VmRSS"]),
        "anonymous": _mib(kib["RssAnon"]),
    }


def _mib(kib: float | None) -> float | None:
    return None if kib is None else round(kib / 1024, 1)


def waited_for_cores_s() -> float | None:
    """Return the seconds that this process's threads were ready but had no core, None if unknown.

    Only existing threads count. The figure reveals load from other processes.
    """
    waited_ns, tasks = 0, list(Path("/proc/self/task").glob("*/schedstat"))
    if not tasks:
        return None
    for path in tasks:
        # A thread may have ended meanwhile.
        with contextlib.suppress(OSError, ValueError, IndexError):
            waited_ns += int(path.read_text().split()[1])
    return 1e-9 * waited_ns


def environment(threads: int | None = None) -> dict[str, Any]:
    """Return what is needed to interpret latencies: processor, cores, versions, governor."""
    # Imported here to keep the start of other commands fast.
    import importlib.metadata

    versions = {"python": platform.python_version()}
    for package in ("cvo-edge", "numpy", "onnxruntime", "opencv-python-headless", "msgspec"):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "unknown"
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        versions["openvino"] = importlib.metadata.version("openvino")
    governor = _first_line(Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"))
    return {
        "cpu": _cpu_name(),
        "architecture": platform.machine(),
        "system": f"{platform.system()} {platform.release()}",
        "cores_present": os.cpu_count(),
        "cores_allowed": allowed_cores(),
        "threads": threads,
        "governor": governor,
        "load_average": list(os.getloadavg()),
        "memory_available_mib": os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") >> 20,
        "versions": versions,
    }


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            name, _, value = line.partition(":")
            if name.strip() in ("model name", "Model", "Hardware"):
                return value.strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def _first_line(path: Path) -> str | None:
    try:
        return path.read_text().splitlines()[0].strip()
    except (OSError, IndexError):
        return None
