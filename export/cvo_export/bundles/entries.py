"""Thresholds of the marginal scope from scores, and thresholds as they are stored."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import LeftOut, SixOrUnbounded, Threshold
from cvo_edge.heads import Head
from cvo_edge.vocabulary import Scope

Array = NDArray[np.float64]


def marginal_thresholds(
    head: Head,
    scores: Array,
    confidences: Sequence[float],
    q_hat: Callable[[Array, Sequence[float]], Array],
) -> Array:
    """Return thresholds (m, sides, 6) at m confidences from scores (n, sides, 6).

    They are infinite where unbounded; ``q_hat`` gives those of scores (n,) at m levels.
    """
    found = np.full((len(confidences), *scores.shape[1:]), np.inf)
    sides = zip(*map(head.side_confidences, confidences), strict=True)
    for side, levels in enumerate(sides):
        given = [level for level in levels if level is not None]
        if given:
            for dof in range(6):
                found[:, side, dof] = q_hat(scores[:, side, dof], given)
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
