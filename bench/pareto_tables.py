"""Table and picture of ``results/pareto``: score against milliseconds.

python bench/pareto_tables.py    # draw docs/pictures/pareto.png
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from markdown_table import table
from numpy.typing import NDArray
from provenance import read_result

PRECISIONS = ("fp32", "int8")
THREADS = ("2", "1")
# The networks that ``train`` makes by default.
DEFAULT = {"size": "256x192", "stages": "16", "kept": 100}
METHODS = ("cjp", "scr")


class Point(NamedTuple):
    """A network in one precision; milliseconds (p10) of a frame by threads.

    ``score`` is the mean over seeds; ``lost`` what it is more than the default's in float32, and
    the standard error of that over the test recordings. Both are None without training.
    """

    method: str
    data: str
    label: str
    precision: str
    score: float | None
    lost: tuple[float, float] | None
    frame: dict[str, float]
    default: bool


def points(found: dict[str, Any]) -> list[Point]:
    """Return all networks."""
    made = []
    for row in found["networks"].values():
        wanted = {"method": row["method"], "data": row["data"], **DEFAULT}
        reference = next(r for r in found["networks"].values() if wanted.items() <= r.items())
        for precision in PRECISIONS:
            one = row[precision]
            # Seeds are splits: a difference is that of the same seed, hence the same recordings.
            pairs = list(zip(one["seeds"], reference["fp32"]["seeds"], strict=False))
            lost = [np.subtract(a["of_recordings"], b["of_recordings"]) for a, b in pairs]
            scores = [seed["normalised_interval_score"] for seed, _ in pairs]
            made.append(
                Point(
                    row["method"],
                    row["data"],
                    _label(row),
                    precision,
                    float(np.mean(scores)) if scores else None,
                    _mean_and_error(np.concatenate(lost)) if lost else None,
                    {t: one["threads"][t]["frame"]["p10"] for t in THREADS},
                    wanted.items() <= row.items(),
                )
            )
    return made


def _mean_and_error(values: NDArray[np.float64]) -> tuple[float, float]:
    if values.size == 1:
        return float(values[0]), 0.0
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(values.size))


def _label(row: dict[str, Any]) -> str:
    kept = "" if row["kept"] == 100 else f", {row['kept']} % of the channels"
    return f"{row['size']}, stride {row['stages']}{kept}"


def front(some: list[Point], threads: str) -> list[Point]:
    """Return those of which no other is both faster and better, the fastest first."""
    best, found = np.inf, []
    for point in sorted(some, key=lambda point: point.frame[threads]):
        if point.score is not None and point.score < best:
            best = point.score
            found.append(point)
    return found


def knee(some: list[Point], threads: str) -> Point:
    """Return the fastest network whose score is within two standard errors of the best one's.

    Errors are those of differences on the same recordings.
    """
    scored = [(point.lost, point) for point in some if point.lost is not None]
    least, error = min(lost for lost, _ in scored)
    equal = [p for lost, p in scored if lost[0] - least <= 2.0 * max(lost[1], error)]
    return min(equal, key=lambda point: point.frame[threads])


def scores(data: str) -> str:
    """Return the table of the networks on one kind of data."""
    every = points(read_result("pareto", "pareto"))
    some = [point for point in every if point.data == data]
    default = next(p for p in some if p.default and p.method == "cjp" and p.precision == "fp32")
    fronts = {
        (method, threads): front([p for p in some if p.method == method], threads)
        for method in METHODS
        for threads in THREADS
    }

    def rows() -> Iterator[list[str]]:
        for point in some:
            on = [t for t in THREADS if point in fronts[point.method, t]]
            yield [
                point.method,
                point.label + (" (default)" if point.default else ""),
                point.precision,
                "-" if point.score is None else f"{point.score:.3f}",
                _difference(point),
                *(f"{point.frame[t]:.2f}" for t in THREADS),
                *(f"{point.frame[t] / default.frame[t]:.2f}" for t in THREADS),
                " and ".join(on) or "-",
            ]

    head = [
        *("method", "network", "", "score", "less the default's in fp32"),
        *("2 threads, ms", "1 thread, ms", "/ CJP's default, 2", "/ CJP's default, 1"),
        "on its method's front",
    ]
    return table(head, rows())


def _difference(point: Point) -> str:
    if point.lost is None or (point.default and point.precision == "fp32"):
        return "-"
    value, error = point.lost
    return f"{value:+.3f} ± {error:.3f}" if error else f"{value:+.3f}"


def backbones() -> str:
    """Return the table of other networks' times."""
    found = read_result("pareto", "pareto")["backbones"]

    def cell(row: dict[str, Any], threads: str) -> list[str]:
        return [f"{row[precision][threads]['raw']['p10']:.2f}" for precision in PRECISIONS]

    head = ["network up to stride 16, 256x192"]
    head += [f"{p} on {t}, ms" for t in THREADS for p in PRECISIONS]
    return table(head, ([name, *cell(row, "2"), *cell(row, "1")] for name, row in found.items()))


TABLES: dict[str, Callable[[], str]] = {
    "pareto flights": partial(scores, "flights"),
    "pareto walk": partial(scores, "walk"),
    "pareto backbones": backbones,
}
