"""What a bundle costs on this machine, beside the bare inference call in the same run."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np

from cvo_edge import preprocess
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.odometer import Odometer
from cvo_edge.pose import Scope
from cvo_edge.prepared import ModelCache
from cvo_edge.profile import LatencyProfile, environment, memory_mib, quantiles
from cvo_edge.session import Session
from cvo_edge.sources import Frame, open_source

# A common camera's frame, used where no source is given.
_DEFAULT_HEIGHT, _DEFAULT_WIDTH = 480, 640


def benchmark(
    bundle: Path,
    source: str | None = None,
    *,
    frames: int = 200,
    warmup: int = 20,
    threads: int | None = None,
    confidence: float = 0.9,
    scope: Scope = "marginal",
    cache: ModelCache | None = None,
) -> dict[str, Any]:
    """Time ``frames`` steps, each next to one bare inference call on the same model.

    The two take turns, so that a change of the machine's speed meets both; ``ratio_to_raw`` is the
    median of the step without reading over the bare call, frame by frame. Without a source a still
    synthetic image is used; its pose may be implausible, and then the conformal step is not run;
    ``frames_valid`` counts those where it was. Invalid frames of a source are not timed. Returns
    the report of ``cvo-edge bench --json``.

    Raises UsageError for counts below one, SourceError where the source gives no valid frame, and
    what ``Odometer.load`` raises.
    """
    if frames < 1 or warmup < 0:
        raise UsageError(
            f"bench: expected frames >= 1 and warmup >= 0, found {frames} and {warmup}"
        )
    start = perf_counter()
    odometer = Odometer.load(
        bundle, threads=threads, confidence=confidence, scope=scope, cache=cache
    )
    load_ms = 1e3 * (perf_counter() - start)
    session = odometer.session
    if session is None:  # pragma: no cover - just loaded
        raise UsageError("bench: expected an open odometer")
    spec = odometer.calibration.preprocess
    shape = (1, spec.height, spec.width, 3)
    feeds = {"image": np.zeros(shape, np.uint8), **odometer.head.extra_inputs(0)}
    latency, raw_ms, step_ms = LatencyProfile(), [], []
    cpu_s, first_interval_ms, valid = 0.0, 0.0, 0
    stream = _endless(source)
    for count in range(warmup + frames):
        frame = next(stream)
        if count == 0:
            estimate = odometer.step(frame.image, read_ms=frame.read_ms)
            first_interval_ms = _process_age_ms()
        if frame.image is not None:
            image = preprocess.to_bgr8(frame.image)
            if image is not None:
                feeds["image"] = preprocess.model_input(image, spec.height, spec.width, spec.crop)
        raw = 0.0
        if count % 2:  # whoever comes second finds warmer caches
            raw = _raw_ms(session, feeds)
        cpu_begin = process_time()
        begin = perf_counter()
        estimate = odometer.step(frame.image, frame.stamp_ns, frame.source, frame.read_ms)
        spent = 1e3 * (perf_counter() - begin)
        cpu_end = process_time()
        if not count % 2:
            raw = _raw_ms(session, feeds)
        # An invalid frame is quick: it must not flatter the figures of a real source.
        if count >= warmup and (source is None or estimate.pose is not None):
            valid += estimate.pose is not None
            cpu_s += cpu_end - cpu_begin
            latency.add(estimate.latency_ms)
            raw_ms.append(raw)
            step_ms.append(spent)
    if source is not None and not valid:
        raise SourceError(f"{source}: expected at least one valid frame, found none in {frames}")
    stages = latency.summary()
    return {
        "bundle": odometer.calibration.name,
        "method": odometer.calibration.method,
        "frames": frames,
        "frames_valid": valid,
        "warmup": warmup,
        "latency_ms": stages,
        "raw_model_ms": quantiles(raw_ms),
        "ratio_to_raw": {
            "median": round(float(np.median(np.array(step_ms) / np.array(raw_ms))), 4)
        },
        "throughput_fps": round(1e3 / stages["total"]["mean"], 1),
        "load_ms": round(load_ms, 1),
        "first_interval_ms": round(first_interval_ms, 1),
        "cpu_ms_per_frame": round(1e3 * cpu_s / latency.count, 3),
        "memory_mib": memory_mib(),
        "environment": environment(session.threads),
    }


def benchmark_lines(report: dict[str, Any]) -> list[str]:
    """Return the report as lines of text for a person."""
    header = f"{'ms':<12}" + "".join(f"{name:>9}" for name in ("p50", "p90", "p95", "p99", "mean"))
    rows = {**report["latency_ms"], "bare model": report["raw_model_ms"]}
    where = report["environment"]
    return [
        f"{report['bundle']} ({report['method']}): {report['frames']} frames after "
        f"{report['warmup']} warm-up, {where['threads']} threads on {where['cpu']}",
        header,
        *(f"{k:<12}" + "".join(f"{v:>9.3f}" for v in row.values()) for k, row in rows.items()),
        f"array to interval over the bare model call: {report['ratio_to_raw']['median']:.3f}",
        f"{report['throughput_fps']:.0f} frames/s, {report['cpu_ms_per_frame']:.2f} CPU-ms a "
        f"frame, load {report['load_ms']:.0f} ms, first interval "
        f"{report['first_interval_ms']:.0f} ms after process start",
        *_remark(report),
        "memory MiB: " + ", ".join(f"{k} {v:.0f}" for k, v in report["memory_mib"].items()),
    ]


def _raw_ms(session: Session, feeds: dict[str, Any]) -> float:
    begin = perf_counter()
    session.engine.run(None, feeds)
    return 1e3 * (perf_counter() - begin)


def _remark(report: dict[str, Any]) -> list[str]:
    if report["frames_valid"] == report["frames"]:
        return []
    return [
        f"{report['frames_valid']} of {report['frames']} frames gave a plausible pose; a SOURCE of "
        "the scene times the conformal step on every frame"
    ]


def _endless(source: str | None) -> Iterator[Frame]:
    if source is None:
        still = Frame(preprocess.selftest_image(_DEFAULT_HEIGHT, _DEFAULT_WIDTH), None, "", 0.0)
        while True:
            yield still
    while True:
        empty = True
        for frame in open_source(source):
            empty = False
            yield frame
        if empty:
            raise SourceError(f"{source}: expected frames, found none")


def _process_age_ms() -> float:
    """Milliseconds since this process started, by the kernel's clock (0 where unknown)."""
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        uptime = time.clock_gettime(time.CLOCK_BOOTTIME)
        return 1e3 * (uptime - int(fields[19]) / os.sysconf("SC_CLK_TCK"))
    except (OSError, AttributeError, ValueError):
        return 0.0
