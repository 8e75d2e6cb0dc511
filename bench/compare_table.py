"""The README's table of methods and baselines from bench/results/compare/*.json.

python bench/compare_table.py redkitchen kitchen_flights
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parent / "results" / "compare"
OURS = ("cjp", "cqr", "csp", "mcqr")
HEADER = (
    "| | score, own bounds | score, calibrated | coverage per DoF | joint scope: coverage, volume "
    "| median error | training | head | a frame |\n|---|---|---|---|---|---|---|---|---|"
)

Cell = dict[str, Any]


def median(cells: list[Cell], figure: Callable[[Cell], float | None]) -> float | None:
    """Return the median over the seeds that have this figure, None where none has."""
    found = [value for value in map(figure, cells) if value is not None]
    return float(np.median(found)) if found else None


def shown(value: float | None, form: str) -> str:
    """Return a figure, or a dash."""
    return "-" if value is None else form.format(value)


def row(method: str, cells: list[Cell], ms: dict[str, float], best: float) -> str:
    """Return a method's line; the best score and those within 2 % of it are bold."""
    score = median(cells, lambda cell: cell["marginal"]["normalised_interval_score"]) or 0.0
    mark = "**" if score <= 1.02 * best else ""
    volume = median(cells, lambda cell: cell["joint_volume"]["geometric_mean"]) or 0.0
    parts = [
        f"**{method}**" if method in OURS else method,
        shown(
            median(cells, lambda c: c["own"] and c["own"]["normalised_interval_score"]), "{:.3f}"
        ),
        f"{mark}{score:.3f}{mark}",
        shown(median(cells, lambda cell: cell["marginal"]["mean_coverage"]), "{:.3f}"),
        shown(median(cells, lambda cell: cell["joint"]["joint_coverage"]), "{:.3f}")
        + f", {volume ** (1 / 6):.3f}",
        shown(median(cells, lambda cell: 100 * cell["point_error"]["median_m"]), "{:.2f} cm ")
        + shown(median(cells, lambda cell: cell["point_error"]["median_deg"]), "{:.2f} deg"),
        shown(median(cells, lambda c: c["training"] and c["training"]["processor"]), "{:.0f} s"),
        f"{cells[0]['head_parameters'] / 1e6:.2f} M",
        f"{ms['p50']:.2f} ms",
    ]
    return "| " + " | ".join(parts) + " |"


def main() -> None:
    """Print a table for each recording named on the command line."""
    for recording in sys.argv[1:]:
        report = json.loads((RESULTS / f"{recording}.json").read_text("utf-8"))
        by_method: dict[str, list[Cell]] = {}
        for cell in report["cells"]:
            by_method.setdefault(cell["method"], []).append(cell)
        scores = {
            method: median(cells, lambda cell: cell["marginal"]["normalised_interval_score"]) or 0.0
            for method, cells in by_method.items()
        }
        print(f"\n{report['dataset']}, {report['options']['split']} split\n\n{HEADER}")
        for method in sorted(by_method, key=lambda name: scores[name]):
            ms = report["timing"]["ms"][method]
            print(row(method, by_method[method], ms, min(scores.values())))


if __name__ == "__main__":
    main()
