"""Tables of ``results/study`` for ``bench/tables.py``: medians over seeds, sets of 0.9."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from markdown_table import table
from provenance import read_result

Cell = dict[str, Any]
Figure = Callable[[Cell], float | None]

KNOWN, NEW = "methods between known frames", "methods on new flights"
BACKBONES, SHARES = "backbones, all from scratch", "less training data"
SHARPNESS = "CJP: sharpness and gate"
# As columns, in the order in which the paper introduces them.
METHODS = ("cqr", "csp", "mcqr", "cjp")
# Name in a cell -> in a table.
NOISES = {
    "gaussian:0.1": "gaussian, .1",
    "salt-and-pepper:0.05": "salt and pepper, .05",
    "speckle:0.22": "speckle, .22",
    "motion-blur:0.03": "motion blur, 3 %",
    "exposure:-2.0": "exposure, -2 stops",
    "occlusion:0.1": "occlusion, 10 %",
}


@cache
def results() -> dict[str, Any]:
    """Return the study's results."""
    return read_result("study", "results")


def cells(grid: str, method: str = "cjp", backbone: str = "", **varied: object) -> list[Cell]:
    """Return the cells of a grid, one per seed, for one value of each option that varies."""
    found = [
        results()["cells"][place["cell"]]
        for place in results()["places"]
        if place["grid"] == grid
        and place["method"] == method
        and place["varied"] == varied
        and place["backbone"] in (backbone or place["backbone"])
    ]
    if not found:
        raise KeyError(f"expected cells of {grid}, {method}, {varied}, found none")
    return found


def median(found: list[Cell], figure: Figure) -> float | None:
    """Return the median over the seeds that have this figure, None where no seed has it."""
    values = [value for value in map(figure, found) if value is not None]
    return float(np.median(values)) if values else None


def share(value: float | None) -> str:
    """Three digits without the leading zero."""
    return "-" if value is None else f"{value:.3f}".removeprefix("0")


def two_digits(value: float | None) -> str:
    """Two digits without the leading zero."""
    return "-" if value is None else f"{value:.2f}".removeprefix("0")


def score(cell: Cell) -> float:
    """Interval score over the poses' deviations."""
    return float(cell["marginal"]["normalised_interval_score"])


def own_coverage(cell: Cell) -> float | None:
    """Coverage of the network's own bounds, mean over the degrees of freedom."""
    return cell["own"] and cell["own"]["mean_coverage"]


def table_one() -> str:
    """Return the paper's Table I with numbers, between known frames."""
    by_method = {method: cells(KNOWN, method) for method in METHODS}
    ms = {
        results()["cells"][name]["method"]: times["p50"]
        for name, times in results()["timing"][KNOWN]["ms"].items()
    }

    def row(what: str, shown: Callable[[list[Cell]], str]) -> list[str]:
        return [what, *(shown(found) for found in by_method.values())]

    def pieces(found: list[Cell]) -> str:
        value = median(found, lambda c: c["pieces"])
        return "none" if value is None else f"{100 * value:.1f} %"

    def complexity(found: list[Cell]) -> str:
        return f"{ms[found[0]['method']]:.2f}, {found[0]['model_bytes'] / 2**20:.1f}"

    def accuracy(found: list[Cell]) -> str:
        correlation = median(found, lambda c: c["adaptiveness"]["rank_correlation"])
        return f"{two_digits(correlation)}; {share(median(found, score))}"

    def seconds(found: list[Cell]) -> str:
        return f"{median(found, lambda c: c['training'] and c['training']['processor']):.0f}"

    def by_share(method: str) -> str:
        shares = (cells(SHARES, method, share=value) for value in (0.25, 0.5, 1.0))
        return ", ".join(share(median(found, score)) for found in shares)

    return table(
        ["paper's row and words (CQR, CSP, MCQR, CJP)", *(m.upper() for m in METHODS)],
        [
            row("disjoint bands (no, yes, no, no): share of sets in pieces", pieces),
            row(
                "complexity (low, low, high, medium): ms per frame, MiB of the model",
                complexity,
            ),
            [
                "interval calibration (fixed, fixed, fixed, tunable): own coverage for lambda "
                "0, .5, 1; with the paper's loss gate",
                *("-", "-", "-"),
                "; ".join(
                    ", ".join(
                        share(median(cells(SHARPNESS, sharpness=s, gate=gate), own_coverage))
                        for s in (0.0, 0.5, 1.0)
                    )
                    for gate in ("corrected", "literal")
                ),
            ],
            row(
                "interval adaptiveness (conservative, semi-tunable, flexible, tunable): width on "
                "frames of large over small errors",
                lambda found: two_digits(median(found, lambda c: c["adaptiveness"]["width_ratio"])),
            ),
            row(
                "uncertainty accuracy (low, medium, high, high): rank correlation of width and "
                "error; score",
                accuracy,
            ),
            row("training time (short, medium, long, medium): processor seconds", seconds),
            [
                "data dependency (low, high, high, low): score at 25, 50, 100 % of the frames",
                *map(by_share, METHODS),
            ],
        ],
    )


def coverage() -> str:
    """Return coverage of single degrees of freedom and of all six, on both recordings."""
    methods = ("cjp", "cqr", "csp", "mcqr")

    def row(what: str, grid: str) -> list[str]:
        return [
            what,
            *(
                f"{share(median(found, lambda c: c['marginal']['mean_coverage']))} "
                f"({share(median(found, lambda c: c['joint']['joint_coverage']))})"
                for found in (cells(grid, method) for method in methods)
            ),
        ]

    own = [[median(cells(grid, m), own_coverage) for grid in (KNOWN, NEW)] for m in methods]
    return table(
        ["", *(method.upper() for method in methods)],
        [
            row("between known frames", KNOWN),
            row("on new flights", NEW),
            [
                "the network's own bounds: known frames, new flights",
                *("-" if None in pair else ", ".join(map(share, pair)) for pair in own),
            ],
        ],
    )


def sharpness() -> str:
    """Return what lambda does to CJP's own bounds and to the calibrated score, by gate."""
    head = [
        *("lambda", "own coverage, width: corrected gate", "the paper's gate"),
        *("calibrated score: corrected", "the paper's"),
    ]
    rows = []
    for value in (0.0, 0.25, 0.5, 0.75, 1.0):
        gates = [cells(SHARPNESS, sharpness=value, gate=g) for g in ("corrected", "literal")]
        rows.append(
            [
                f"{value:g}".removeprefix("0") or "0",
                *(
                    f"{share(median(found, own_coverage))}, "
                    f"{median(found, lambda c: 100 * c['own']['mean_width']['m']):.2f} cm"
                    for found in gates
                ),
                *(share(median(found, score)) for found in gates),
            ]
        )
    return table(head, rows)


def noise() -> str:
    """Return CJP's width and coverage with each noise, at clean thresholds and recalibrated."""
    head = [""]
    for where in ("known frames", "new flights"):
        head += [f"{where}: width, clean thresholds", "coverage", "recalibrated"]
    rows = [["none", *_clean(cells(KNOWN)), *_clean(cells(NEW))]]
    for name, label in NOISES.items():
        rows.append([label, *(x for grid in (KNOWN, NEW) for x in _noisy(cells(grid), name))])
    return table(head, rows)


def _clean(found: list[Cell]) -> list[str]:
    width = f"{median(found, lambda c: 100 * c['marginal']['mean_width']['m']):.1f}"
    return [width, share(median(found, lambda c: c["marginal"]["mean_coverage"])), width]


def _noisy(found: list[Cell], name: str) -> list[str]:
    entries = [cell["noise"][name] for cell in found]
    width, again = (
        f"{median(entries, lambda e, kind=kind: 100 * e[kind]['mean_width']['m']):.1f}"
        for kind in ("clean", "recalibrated")
    )
    return [width, share(median(entries, lambda e: e["clean"]["mean_coverage"])), again]


def backbones() -> str:
    """Return networks trained from nothing: size, error, coverage, width, and width with noise."""
    head = [
        *("network, up to stride 16", "parameters (M)", "point error", "coverage", "mean width"),
        *("score", "with gaussian, salt and pepper, speckle (recalibrated)"),
    ]
    labels = {
        "resnet34": "ResNet34",
        "mobilenetv2_100": "MobileNetV2",
        "mobilenetv4_conv_small": "MobileNetV4, conv small",
    }
    rows = []
    for backbone, label in labels.items():
        (cell,) = cells(BACKBONES, backbone=backbone)
        error = cell["point_error"]
        noisy = [
            100 * cell["noise"][name]["recalibrated"]["mean_width"]["m"]
            for name in list(NOISES)[:3]
        ]
        rows.append(
            [
                *(label, f"{cell['graph_parameters'] / 1e6:.2f}"),
                f"{100 * error['median_m']:.1f} cm, {error['median_deg']:.1f} deg",
                share(cell["marginal"]["mean_coverage"]),
                f"{100 * cell['marginal']['mean_width']['m']:.1f} cm",
                f"{score(cell):.2f}",
                ", ".join(f"{width:.1f}" for width in noisy) + " cm",
            ]
        )
    return table(head, rows)


TABLES: dict[str, Callable[[], str]] = {
    "study-table-one": table_one,
    "study-coverage": coverage,
    "study-sharpness": sharpness,
    "study-noise": noise,
    "study-backbones": backbones,
}
