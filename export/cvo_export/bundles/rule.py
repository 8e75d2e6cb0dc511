"""The rule of a calibration: its default, its cap, and its coverage without one recording."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import LeftOut
from cvo_edge.errors import UsageError
from cvo_edge.vocabulary import Rule, Scope, SplitKind

Array = NDArray[np.float64]

DEFAULT_CAP = 0.5


def chosen_rule(rule: Rule | None, cap: float | None, kind: SplitKind) -> tuple[Rule, float | None]:
    """Return the rule and its cap; None leaves the choice to the kind of split.

    The default is ``capped`` for a split by sequence and ``pooled`` otherwise; a cap is 0.5 by
    default.

    Raises UsageError for a cap outside (0, 1], or with a rule that has none.
    """
    if rule is None:
        rule = "capped" if kind == "sequence" else "pooled"
    if rule != "capped":
        if cap is not None:
            raise UsageError(f"cap: expected only with the rule capped, found {cap:g} with {rule}")
        return rule, None
    if cap is None:
        return rule, DEFAULT_CAP
    if not 0.0 < cap <= 1.0:
        raise UsageError(f"cap: expected a number above 0 and at most 1, found {cap:g}")
    return rule, cap


def left_out(
    scores: Array,
    sequence: NDArray[np.int64],
    sides: NDArray[np.bool_],
    scope: Scope,
    bounds: Callable[[NDArray[np.bool_]], Array],
) -> LeftOut | None:
    """Return the coverage of each recording by thresholds from the others.

    ``bounds`` gives the thresholds (sides, 6) from the rows (n,) of ``scores`` (n, sides, 6) that
    are true; ``sides`` are those that are bounded. None for fewer than two recordings, or if a
    threshold is infinite without one of them.
    """
    numbers = np.unique(sequence)
    if numbers.size < 2:
        return None
    shares = []
    for number in numbers:
        out = sequence == number
        found = bounds(~out)[sides]
        if not np.isfinite(found).all():
            return None
        inside = (scores[out][:, sides] <= found).all(axis=1)
        shares.append(np.mean(inside.all(axis=1) if scope == "joint" else inside))
    return LeftOut(
        coverage=float(np.mean(shares)),
        standard_error=float(np.std(shares, ddof=1) / np.sqrt(numbers.size)),
    )
