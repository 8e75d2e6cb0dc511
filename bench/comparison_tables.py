"""Tables of ``results/compare`` for ``bench/tables.py``.

Methods and baselines side by side, medians over seeds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from markdown_table import table
from networks import METHODS
from provenance import read_result

RECORDINGS = ("redkitchen", "kitchen_flights")
Cell = dict[str, Any]
Report = dict[str, Any]


def comparison() -> str:
    """Return one line per method, with the figures of both recordings as pairs."""
    found = [_report(name) for name in RECORDINGS]
    methods = {cell["method"] for report in found for cell in report["cells"]}
    head = [
        *("", "score, own bounds", "score, calibrated", "coverage per DoF"),
        *("joint scope: coverage", "its volume^(1/6)", "median error", "training", "head"),
        "per frame",
    ]
    # The sum of logarithms: recordings of any difficulty count alike.
    order = sorted(methods, key=lambda name: float(np.log(scores(found, name)).sum()))
    return table(head, [_row(found, method) for method in order])


def _report(recording: str) -> Report:
    """Return what ``cvo-export compare`` wrote of a recording, now or before it was a study."""
    found = read_result("compare", recording)
    if isinstance(found["cells"], list):
        return found
    cells = found["cells"]
    (timing,) = found["timing"].values()
    return {
        "cells": list(cells.values()),
        "heads": dict.fromkeys(cell["method"] for cell in cells.values()),
        "timing": {"ms": {cells[name]["method"]: ms for name, ms in timing["ms"].items()}},
    }


def _row(found: list[Report], method: str) -> list[str]:
    """Return a method's line; scores within 2 % of the recording's best are bold."""
    best = np.min([scores(found, name) for name in found[0]["heads"]], axis=0)
    marked = [
        f"**{score:.3f}**" if score <= 1.02 * least else f"{score:.3f}"
        for score, least in zip(scores(found, method), best, strict=True)
    ]
    head = cells(found[0], method)[0]["head_parameters"]

    def each(form: str, *figures: Callable[[Cell], float | None]) -> str:
        medians = ([median(report, method, figure) for figure in figures] for report in found)
        return ", ".join("-" if None in row else form.format(*row) for row in medians)

    return [
        f"**{method}**" if method in METHODS else method,
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
        ", ".join(f"{report['timing']['ms'][method]['p50']:.2f} ms" for report in found),
    ]


def own_bounds(recording: str) -> str:
    """Return coverage, all six at once and width of one recording, own bounds and calibrated."""
    report = _report(recording)
    rows = []
    for method in report["heads"]:
        for bounds, label in (("own", f"{method}, own bounds"), ("marginal", method)):
            found = [cell[bounds] for cell in cells(report, method) if cell[bounds]]
            if found:
                rows.append([label, *_bounds_cells(found)])
    return table(["", "coverage per DoF", "all six", "median width", "score, each seed"], rows)


def _bounds_cells(found: list[Cell]) -> list[str]:
    def middle(figure: Callable[[Cell], float]) -> float:
        return float(np.median([figure(entry) for entry in found]))

    values = [entry["normalised_interval_score"] for entry in found]
    return [
        f"{middle(lambda e: e['mean_coverage']):.3f}",
        f"{middle(lambda e: e['joint_coverage']):.3f}",
        f"{100 * middle(lambda e: e['median_width']['m']):.2f} cm "
        f"{middle(lambda e: e['median_width']['deg']):.2f} deg",
        f"{np.median(values):.3f} ({', '.join(f'{value:.3f}' for value in values)})",
    ]


def scores(found: list[Report], method: str) -> list[float]:
    """Return the calibrated interval score of each recording."""
    values = [
        median(report, method, lambda c: c["marginal"]["normalised_interval_score"])
        for report in found
    ]
    return [value for value in values if value is not None]


def median(report: Report, method: str, figure: Callable[[Cell], Any]) -> float | None:
    """Return the median over the seeds that have this figure, None where no seed has it."""
    found = [value for value in map(figure, cells(report, method)) if value is not None]
    return float(np.median(found)) if found else None


def cells(report: Report, method: str) -> list[Cell]:
    """Return the cells of a method, one per seed."""
    return [cell for cell in report["cells"] if cell["method"] == method]


TABLES: dict[str, Callable[[], str]] = {
    "comparison": comparison,
    **{f"own-bounds-{name}": partial(own_bounds, name) for name in RECORDINGS},
}
