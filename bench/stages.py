"""Where the time of a frame goes, from a JPEG file to a line of JSON.

    python bench/stages.py

``cvo-edge bench --stages`` on every demonstration bundle and on whole networks, one after another,
several times; medians of all rounds' medians, microseconds.
"""

from __future__ import annotations

from statistics import median
from typing import Any

from networks import DEMONSTRATED, demonstration, frames, whole_bundle
from rounds import write_report

from cvo_edge.programs.bench import benchmark

THREADS, ROUNDS, FRAMES, WARM_UP = 2, 3, 100, 20
BACKBONE = "mobilenetv2_100"


def main() -> None:
    """Measure all, print the time around the engine, and write the result file."""
    folder = frames()[0].parent
    bundles = {method: demonstration(method) for method in DEMONSTRATED}
    for precision in ("fp32", "int8"):
        bundles[f"cjp, whole, {precision}"] = whole_bundle("cjp", BACKBONE, precision)
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in bundles}
    for _ in range(ROUNDS):
        for name, bundle in bundles.items():
            report = benchmark(
                bundle,
                str(folder),
                frames=FRAMES,
                warmup=WARM_UP,
                threads=THREADS,
                stages=True,
            )
            found[name].append(report["stages"])
    results = {name: _medians(rounds) for name, rounds in found.items()}
    for name, row in results.items():
        print(f"{name}: " + ", ".join(f"{stage} {us:.0f}" for stage, us in row.items()), "us")
    write_report("stages", results, threads=THREADS, rounds=ROUNDS, frames=FRAMES, warmup=WARM_UP)


def _medians(rounds: list[dict[str, Any]]) -> dict[str, float]:
    """Return the median of the rounds' medians by stage."""
    values: dict[str, list[float]] = {}
    for stages in rounds:
        for row in stages["rows"]:
            values.setdefault(row["stage"], []).append(row["p50_us"])
    return {stage: round(median(several), 1) for stage, several in values.items()}


if __name__ == "__main__":
    main()
