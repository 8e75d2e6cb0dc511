"""Thresholds of the marginal scope from scores, and thresholds as they are stored."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import LeftOut, SixOrUnbounded, Threshold
from cvo_edge.heads import Head
from cvo_edge.vocabulary import Scope

Array = NDArray[np.float64]


def marginal_thresholds(
    head: Head, scores: Array, confidence: float, q_hat: Callable[[Array, float], float]
) -> Array:
    """Return thresholds (sides, 6) from scores (n, sides, 6); infinite where unbounded."""
    found = np.full(scores.shape[1:], np.inf)
    for side, level in enumerate(head.side_confidences(confidence)):
        if level is not None:
            found[side] = [q_hat(scores[:, side, dof], level) for dof in range(6)]
    return found


def entry_of(
    confidence: float, scope: Scope, values: Array, left: LeftOut | None = None
) -> Threshold:
    """Convert thresholds (sides, 6), infinite where unbounded, to a stored entry."""
    sides = [_six_or_unbounded(row) for row in values]
    return Threshold(
        confidence=confidence,
        scope=scope,
        q_hat=sides[0],
        q_hat_upper=sides[1] if len(sides) == 2 else None,
        left_out=left,
    )


def _six_or_unbounded(values: Array) -> SixOrUnbounded:
    a, b, c, d, e, f = (float(value) if np.isfinite(value) else None for value in values)
    return (a, b, c, d, e, f)
