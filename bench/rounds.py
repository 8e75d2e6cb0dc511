"""Measuring side by side: calls that are compared take turns within one run.

The speed of a machine changes from second to second. That shows in a ratio of medians of separate
runs, but not in a median of ratios within a round.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter, sleep
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from provenance import RESULTS, write_result

Array = NDArray[np.float64]
Array8 = NDArray[np.uint8]
T = TypeVar("T")


def interleaved(
    calls: Mapping[str, Callable[[int], object]],
    *,
    rounds: int,
    warmup: int,
    pause_s: float = 0.0,
    warm_calls: int = 0,
    before: Mapping[str, Callable[[int], object]] | None = None,
) -> dict[str, Array]:
    """Milliseconds of each call in each round, (rounds,); a call is given the round's number.

    The order rotates from round to round, because a later call finds warmer caches. A pause after
    each call keeps its spinning threads from slowing down the next one. Untimed ``warm_calls``
    restore the caches that the pause and the other calls have emptied. ``before`` holds untimed
    preparations.
    """
    names = list(calls)
    spent = {name: np.empty(warmup + rounds) for name in names}
    for number in range(warmup + rounds):
        for name in in_turn(names, number):
            for _ in range(warm_calls):
                calls[name](number)
            if before:
                before[name](number)
            begin = perf_counter()
            calls[name](number)
            spent[name][number] = 1e3 * (perf_counter() - begin)
            sleep(pause_s)
    return {name: values[warmup:] for name, values in spent.items()}


def in_turn(each: Sequence[T], number: int) -> list[T]:
    """Return all of them, rotated so that each round begins with another one."""
    first = number % len(each)
    return [*each[first:], *each[:first]]


def just_written(
    inputs: Sequence[Array8], call: Callable[[Array8], object]
) -> tuple[Callable[[int], object], Callable[[int], object]]:
    """Return the preparation of a call, and the call, for ``interleaved``.

    One input a round, in order, each just written into the same memory, as a camera or a decoder
    leaves it.
    """
    kept = np.empty_like(inputs[0])
    return (
        lambda number: np.copyto(kept, inputs[number % len(inputs)]),
        lambda _: call(kept),
    )


def figures(values: Array) -> dict[str, float]:
    """Median, 10th and 95th percentile, four digits."""
    low, middle, high = np.percentile(values, (10, 50, 95))
    return {"median": _four(middle), "p10": _four(low), "p95": _four(high)}


def ratio(numerator: Array, denominator: Array) -> dict[str, float]:
    """Return the figures of the ratio within a round."""
    return figures(numerator / denominator)


def write_report(name: str, results: Mapping[str, Any], **settings: object) -> None:
    """Write ``results/speed/NAME.json``: provenance, settings and figures."""
    write_result(RESULTS / "speed" / f"{name}.json", {"settings": settings, "results": results})


def _four(value: float) -> float:
    return float(f"{value:.4g}")
