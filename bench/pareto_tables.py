"""Tables of ``results/pareto``: score against milliseconds.

``bench/tables.py`` writes them into the pages; ``bench/pareto_picture.py`` draws the picture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from markdown_table import table
from numpy.typing import NDArray
from provenance import read_result

SCORE = "normalised_interval_score"
PRECISIONS = ("fp32", "int8")
THREADS = ("2", "1")
# The networks that ``train`` makes by default, and the size that others are compared with.
DEFAULT = {"stages": "16", "kept": 100}
DEFAULT_SIZES = {"cjp": "192x144", "scr": "256x192"}
LARGEST = "256x192"


class Point(NamedTuple):
    """A network in one precision; milliseconds (p10) of a frame by threads.

    ``score`` is the mean over seeds; ``lost`` what it is more than at the largest size in float32,
    and the standard error of that over the test recordings, 0 where their scores are not known;
    ``without`` the share of test frames without an interval. All are None without training.
    """

    method: str
    data: str
    label: str
    precision: str
    score: float | None
    lost: tuple[float, float] | None
    without: float | None
    frame: dict[str, float]
    default: bool


def points(found: dict[str, Any]) -> list[Point]:
    """Return all networks."""
    made = []
    for row in found["networks"].values():
        method, data = row["method"], row["data"]
        wanted = {"method": method, "data": data, "size": LARGEST, **DEFAULT}
        default = {**wanted, "size": DEFAULT_SIZES[method]}
        reference = next(r for r in found["networks"].values() if wanted.items() <= r.items())
        for precision in PRECISIONS:
            one = row[precision]
            # Seeds are splits: a difference is that of the same seed, hence the same recordings.
            pairs = list(zip(one["seeds"], reference["fp32"]["seeds"], strict=False))
            lost = [np.subtract(_of_recordings(a), _of_recordings(b)) for a, b in pairs]
            scores = [seed[SCORE] for seed, _ in pairs]
            made.append(
                Point(
                    method,
                    data,
                    _label(row),
                    precision,
                    _mean(scores),
                    _mean_and_error(np.concatenate(lost)) if lost else None,
                    _mean([seed["without_interval"] for seed, _ in pairs]),
                    {t: one["threads"][t]["frame"]["p10"] for t in THREADS},
                    default.items() <= row.items(),
                )
            )
    return made


def _of_recordings(seed: dict[str, Any]) -> list[float]:
    """Return the scores of single recordings, or the one of all."""
    return list(seed.get("of_recordings", [seed[SCORE]]))


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


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
    largest = _label({"size": LARGEST, **DEFAULT})
    reference = next(
        p for p in some if (p.method, p.label, p.precision) == ("cjp", largest, "fp32")
    )
    fronts = {
        (method, threads): front([p for p in some if p.method == method], threads)
        for method in DEFAULT_SIZES
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
                "-" if point.without is None else f"{point.without:.3f}",
                *(f"{point.frame[t]:.2f}" for t in THREADS),
                *(f"{point.frame[t] / reference.frame[t]:.2f}" for t in THREADS),
                " and ".join(on) or "-",
            ]

    head = [
        *("method", "network", "", "score", f"less {LARGEST}'s in fp32"),
        "frames without an interval",
        *("2 threads, ms", "1 thread, ms", f"/ CJP at {LARGEST}, 2", f"/ CJP at {LARGEST}, 1"),
        "on its method's front",
    ]
    return table(head, rows())


def _difference(point: Point) -> str:
    return "-" if point.lost in (None, (0.0, 0.0)) else _text(point.lost)


def _text(difference: tuple[float, float]) -> str:
    value, error = difference
    return f"{value:+.3f} ± {error:.3f}" if error else f"{value:+.3f}"


def backbones() -> str:
    """Return the table of other networks' times."""
    found = read_result("pareto", "pareto")["backbones"]

    def cell(row: dict[str, Any], threads: str) -> list[str]:
        return [f"{row[precision][threads]['raw']['p10']:.2f}" for precision in PRECISIONS]

    head = ["network up to stride 16, 256x192"]
    head += [f"{p} on {t}, ms" for t in THREADS for p in PRECISIONS]
    return table(head, ([name, *cell(row, "2"), *cell(row, "1")] for name, row in found.items()))


def sizes() -> str:
    """Return the table of ``bench/sizes.py``: sizes of the input, with the whole training."""
    scores: dict[tuple[str, ...], list[float]] = {}
    for row in read_result("pareto", "sizes")["results"]:
        for precision in PRECISIONS:
            key = row["method"], row["data"], row["size"], precision
            scores.setdefault(key, []).append(row[precision][SCORE])

    def rows() -> Iterator[list[str]]:
        for (method, data, size, precision), values in scores.items():
            largest = scores[method, data, LARGEST, "fp32"]
            seeds = min(len(values), len(largest))
            more = np.subtract(values[:seeds], largest[:seeds])
            yield [
                *(method, data, size, precision, f"{np.mean(values):.3f}"),
                " ".join(f"{value:.3f}" for value in values),
                "-" if values is largest else _text(_mean_and_error(more)),
            ]

    head = ["method", "data", "size", "", "score", "of each seed", f"less {LARGEST}'s in fp32"]
    return table(head, rows())


def wrong_frames() -> str:
    """Return the table of ``bench/wrong_frames.py`` for bundles of several input sizes."""

    def rows() -> Iterator[list[str]]:
        for size in ("256x192", "192x144", "160x120"):
            found = read_result("pareto", f"wrong-frames-{size}")
            kinds = list(found["wrong"].values())
            shares = [[kind[key] for kind in kinds] for key in ("wrong", "finite")]
            yield [
                size,
                *(f"{np.mean(share):.3f}" for share in shares),
                f"{found['summary']['all']['over_0.10']} of {len(kinds)}",
                f"{found['harmless']['clean']['wrong']:.2f}",
            ]

    head = ["size", "finite and wrong", "finite", "kinds with more than .10 finite and wrong"]
    return table([*head, "clean frames: wrong"], rows())


TABLES: dict[str, Callable[[], str]] = {
    "pareto sizes": sizes,
    "pareto flights": partial(scores, "flights"),
    "pareto walk": partial(scores, "walk"),
    "pareto backbones": backbones,
    "pareto wrong frames": wrong_frames,
}
