"""Thresholds for new recordings, from scores of recordings that are exchangeable with them.

L_g(q) is the share of recording g's scores above q, alpha = 1 - confidence, and G the number of
recordings (drives of one group count as one).

================  ================================================  ================================
rule              threshold q                                       statement about a new recording
================  ================================================  ================================
``mean``          least q with mean_g L_g(q) <= alpha               none that is proven: the average
                                                                    of these recordings
``tolerance``     max_g of the least q with L_g(q) <= alpha         with probability G / (G + 1), at
                                                                    most alpha of its scores are
                                                                    above (Wilks 1941: the maximum)
``capped``        ``conformal.capped_quantile`` with cap 0.5        E min(L, cap) <= alpha
``hierarchical``  the same with cap 1                               E L <= alpha
================  ================================================  ================================

"Scores" are those of fixed bias and scale. With crossed fits, each recording is scored by a model
fitted without it, and what the statements give is measured, not proven.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cvo_edge.vocabulary import MotionRule

Array = NDArray[np.float64]

CAP = 0.5
_TOLERANCE = 1e-9


class Scores:
    """The scores of several recordings, (n, columns) each, sorted once for all levels and rules.

    ``groups`` says which recordings are one.
    """

    def __init__(self, scores: Sequence[Array], groups: Sequence[str]) -> None:
        named: dict[str, list[Array]] = {}
        for group, values in zip(groups, scores, strict=True):
            named.setdefault(group, []).append(values)
        # Sorted by name: sums of floats depend on the order.
        parts = [np.concatenate(named[name]).T for name in sorted(named)]
        self.count = len(parts)
        self._own = [np.sort(part, axis=1) for part in parts]
        every = np.concatenate(self._own, axis=1)
        weight = np.concatenate([np.full(part.shape[1], 1.0 / part.shape[1]) for part in parts])
        # Runs that are sorted already are merged, which is faster than to sort them.
        order = np.argsort(every, axis=1, kind="stable")
        self._sorted = np.take_along_axis(every, order, axis=1)
        self._within = np.cumsum(weight[order], axis=1)

    def thresholds(self, rule: MotionRule, confidence: float) -> Array:
        """Return a threshold for each column, (columns,); infinite if the rule supports none."""
        if rule == "tolerance":
            return np.asarray(np.max([_quantile(own, confidence) for own in self._own], axis=0))
        count = self.count
        if rule == "mean":
            return self._least(confidence * count)
        cap = CAP if rule == "capped" else 1.0
        return self._least(confidence * (count + 1) - (1.0 - cap))

    def _least(self, within: float) -> Array:
        """Return the least scores up to which the recordings' shares add up to ``within``."""
        found = np.full(len(self._sorted), math.inf)
        for column, (values, shares) in enumerate(zip(self._sorted, self._within, strict=True)):
            index = int(np.searchsorted(shares, within - _TOLERANCE * self.count))
            if index < len(values):
                found[column] = values[index]
        return found


def _quantile(ascending: Array, confidence: float) -> Array:
    """Return the least scores (columns,) that at least this share of (columns, n) are up to."""
    n = ascending.shape[1]
    return ascending[:, max(0, math.ceil(confidence * n - _TOLERANCE * n) - 1)]
