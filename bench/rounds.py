"""Measuring side by side: what is compared takes turns, and figures are of one run.

Machines change their speed from second to second. A ratio of two medians of separate runs shows
that; a median of ratios within a round does not.
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

    Who begins changes from round to round: whoever comes later finds warmer caches. With a
    pause behind each call, threads that go on looking for work do not slow down the next one; after
    it, and after a neighbour that fills every cache, untimed ``warm_calls`` make of the timed one
    what it is in a loop. What is to be done ``before`` a call is not timed either.
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
    """Return all of them, another one first in every round."""
    first = number % len(each)
    return [*each[first:], *each[:first]]


def just_written(
    inputs: Sequence[Array8], call: Callable[[Array8], object]
) -> tuple[Callable[[int], object], Callable[[int], object]]:
    """Return what comes before a call, and the call, for ``interleaved``.

    One input a round, in their order, each just written into the same memory: as a camera or a
    decoder leaves it, and not as it was when it was last looked at.
    """
    kept = np.empty_like(inputs[0])
    return (
        lambda number: np.copyto(kept, inputs[number % len(inputs)]),
        lambda _: call(kept),
    )


def figures(values: Array) -> dict[str, float]:
    """Median and 95th percentile, four digits."""
    return {"median": _four(np.median(values)), "p95": _four(np.percentile(values, 95))}


def ratio(numerator: Array, denominator: Array) -> dict[str, float]:
    """Return median and 95th percentile of what one round's times are to each other."""
    return figures(numerator / denominator)


def write_report(name: str, results: Mapping[str, Any], **settings: object) -> None:
    """Write ``results/speed/NAME.json``: figures, and all that a reader needs to judge them."""
    write_result(RESULTS / "speed" / f"{name}.json", {"settings": settings, "results": results})


def _four(value: float) -> float:
    return float(f"{value:.4g}")
