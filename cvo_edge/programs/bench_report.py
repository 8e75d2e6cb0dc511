"""The texts of ``bench``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# Share of the time spent waiting for a core that counts as a busy machine.
_BUSY_SHARE = 0.05
# What a frame's time is in each mode.
TIMED = {
    "latency": "array to interval",
    "throughput": "time per frame",
    "live": "age of a frame at its interval",
}


def benchmark_lines(report: Mapping[str, Any]) -> list[str]:
    """Return the report as lines of readable text."""
    header = f"{'ms':<12}" + "".join(f"{name:>9}" for name in ("p50", "p90", "p95", "p99", "mean"))
    rows = {**report["latency_ms"], "bare model": report["raw_model_ms"]}
    where = report["environment"]
    return [
        f"{report['bundle']} ({report['method']}, {report['precision']} on {report['provider']}), "
        f"mode {report['mode']}: {report['frames']} frames after {report['warmup']} warm-up, "
        f"{where['threads']} threads on {where['cpu']}",
        header,
        *(f"{k:<12}" + "".join(f"{v:>9.3f}" for v in row.values()) for k, row in rows.items()),
        f"{TIMED[report['mode']]} over the bare model call: {report['ratio_to_raw']['median']:.3f}",
        f"{report['throughput_fps']:.1f} frames/s, {report['cpu_ms_per_frame']:.2f} CPU-ms "
        f"per frame, load {report['load_ms']:.0f} ms, first interval "
        f"{_number(report['first_interval_ms'])} ms after process start",
        *remarks(report),
        "memory MiB: " + ", ".join(f"{k} {_number(v)}" for k, v in report["memory_mib"].items()),
    ]


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.0f}"


def remarks(report: Mapping[str, Any]) -> list[str]:
    """Return what a reader has to know of a report, in sentences."""
    remarks = []
    if report["frames_skipped"]:
        remarks.append(f"{report['frames_skipped']} frames dropped for newer ones")
    if report["frames_valid"] < report["frames"]:
        remarks.append(
            f"{report['frames_valid']} of {report['frames']} frames gave a plausible pose; "
            "give a SOURCE from the bundle's scene to time the conformal step on every frame"
        )
    if report["frames_in_alarm"]:
        remarks.append(f"{report['frames_in_alarm']} frames during an alarm: they have no interval")
    if report["first_interval_ms"] is None or report["waited_for_cores"] is None:
        remarks.append(
            "null where this system does not tell (no /proc): first interval, waiting for cores, "
            "memory other than the peak"
        )
    elif report["waited_for_cores"] > _BUSY_SHARE:
        remarks.append(
            f"busy machine: {report['waited_for_cores']:.0%} of the time was spent waiting for a "
            "core used by other processes; fewer --threads may be faster"
        )
    return remarks
