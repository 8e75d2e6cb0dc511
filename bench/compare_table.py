"""The table of methods and baselines from bench/results/compare/*.json.

python bench/compare_table.py redkitchen kitchen_flights
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

RESULTS = Path(__file__).parent / "results" / "compare"
OURS = ("cjp", "cqr", "csp", "mcqr")
HEADER = (
    "| | score, own bounds | score, calibrated | coverage per DoF | joint scope: coverage "
    "| its volume^(1/6) | median error | training | head | a frame |\n" + "|---" * 10 + "|"
)

Cell = dict[str, Any]


class Report(NamedTuple):
    """Figures of one recording; ``ms`` is the median time of a frame by method."""

    data: str
    split: str
    cells: list[Cell]
    ms: dict[str, float]


# One for each recording.
Reports = list[Report]


def main() -> None:
    """Print one table of the recordings named on the command line, a figure of each in a cell."""
    reports = [read(RESULTS / f"{name}.json") for name in sys.argv[1:]]
    methods = {cell["method"] for report in reports for cell in report.cells}
    print(", ".join(f"{report.data} ({report.split})" for report in reports))
    print(HEADER)
    # The sum of logarithms: recordings of any difficulty count alike.
    for method in sorted(methods, key=lambda name: np.log(scores(reports, name)).sum()):
        print(row(reports, method))


def read(path: Path) -> Report:
    """Read ``results.json`` of ``cvo-export compare``, or ``compare.json`` of earlier versions."""
    content = json.loads(path.read_text("utf-8"))
    cells = content["cells"]
    if isinstance(cells, list):
        ms = {method: figures["p50"] for method, figures in content["timing"]["ms"].items()}
        return Report(content["dataset"], content["options"]["split"], cells, ms)
    (timing,) = content["timing"].values()
    ms = {cells[name]["method"]: figures["p50"] for name, figures in timing["ms"].items()}
    place = content["places"][0]
    return Report(place["data"], place["split"], list(cells.values()), ms)


def row(reports: Reports, method: str) -> str:
    """Return a method's line; scores within 2 % of the recording's best are bold."""
    best = np.min([scores(reports, name) for name in reports[0].ms], axis=0)
    marked = [
        f"**{score:.3f}**" if score <= 1.02 * least else f"{score:.3f}"
        for score, least in zip(scores(reports, method), best, strict=True)
    ]
    head = cells(reports[0], method)[0]["head_parameters"]

    def each(form: str, *figures: Callable[[Cell], float | None]) -> str:
        medians = ([median(report, method, f) for f in figures] for report in reports)
        return ", ".join("-" if None in row else form.format(*row) for row in medians)

    parts = [
        f"**{method}**" if method in OURS else method,
        each("{:.3f}", lambda c: c["own"] and c["own"]["normalised_interval_score"]),
        ", ".join(marked),
        each("{:.3f}", lambda c: c["marginal"]["mean_coverage"]),
        each("{:.3f}", lambda c: c["joint"]["joint_coverage"]),
        each("{:.3f}", lambda c: c["joint_volume"]["geometric_mean"] ** (1 / 6)),
        each(
            "{:.2f} cm {:.2f} deg",
            lambda c: 100 * c["point_error"]["median_m"],
            lambda c: c["point_error"]["median_deg"],
        ),
        each("{:.0f} s", lambda c: c["training"] and c["training"]["processor"]),
        f"{head / 1e6:.2f} M",
        ", ".join(f"{report.ms[method]:.2f} ms" for report in reports),
    ]
    return "| " + " | ".join(parts) + " |"


def scores(reports: Reports, method: str) -> list[float]:
    """Return the calibrated interval score of each recording."""
    found = [
        median(report, method, lambda c: c["marginal"]["normalised_interval_score"])
        for report in reports
    ]
    return [value for value in found if value is not None]


def median(report: Report, method: str, figure: Callable[[Cell], Any]) -> float | None:
    """Return the median over the seeds that have this figure, None where none has."""
    found = [value for value in map(figure, cells(report, method)) if value is not None]
    return float(np.median(found)) if found else None


def cells(report: Report, method: str) -> list[Cell]:
    """Return the cells of a method, one for each seed."""
    return [cell for cell in report.cells if cell["method"] == method]


if __name__ == "__main__":
    main()
