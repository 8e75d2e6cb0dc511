"""Thresholds on motion that follow true poses which come late, or only now and then.

The rule is that of ``monitor.adaptation``: for each horizon and each of its errors, with each
motion whose truth becomes known

    x <- x + eta (1{s > used} - alpha),    threshold = calibrated threshold exp(x)

where ``used`` is the threshold at the time of that motion. In the joint scope, the six degrees of
freedom count as one. Motions over a horizon overlap, so that a single bad moment is missed by all
that contain it: eta is at most 0.03 (0.09 for every third pose and rarer labels), and at most twice
the gap between labels over their delay and the horizon together, in poses. No label moves x further
than ``MOST_STALE`` from the x of its own motion.

A moment of large errors must not widen thresholds by orders. A slow x follows the same scores by a
tenth of the step, and x is at most log 2.5 above it. What holds is the share of labelled motions
that are inside in the long run, not this moment; motions that are missed while x is at that limit
are not made up for.

No threshold becomes narrower than a twentieth of the calibrated one. A robot that stands, or truths
that come from the estimate itself, show no error however long they are watched, and say nothing of
what follows. (On KITTI and EuRoC, no drive needed less than a quarter, and labels at once went down
to a thirteenth.) What is missed becomes less by that, never more.
"""

from __future__ import annotations

import math
from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from cvo_edge.monitor.steps import LARGEST, MOST_STALE

Array = NDArray[np.float64]

# Labels older than so many changes of x are refused.
_KEPT = 4096
# With 0.1 and no limit, a burst of misses widened thresholds by up to 22 on KITTI.
_ETA, _SLOW = 0.03, 0.003
_RARE = 3
_FASTER = 2.0
_ABOVE = math.log(2.5)
_LEAST = -math.log(20.0)


class MotionAdaptation:
    """x of each of the eight errors of one horizon, over the rows of a stream.

    Parameters
    ----------
    alpha
        The miscoverage to reach.
    joint
        Whether the six degrees of freedom count as one.
    """

    def __init__(self, alpha: float, *, joint: bool) -> None:
        self._alpha = alpha
        self._joint = joint
        # From which row on each x is used, ascending.
        self._since = [0]
        self._x = [np.zeros(8)]
        self._slow = np.zeros(8)
        self._last: int | None = None

    @property
    def x(self) -> Array:
        """X (8,) for the next row."""
        return self._x[-1]

    def at(self, seq: int) -> Array | None:
        """Return x (8,) as it was for a row; None if that is too long ago."""
        place = bisect_right(self._since, seq) - 1
        return self._x[place] if place >= 0 else None

    def update(self, seq: int, newest: int, span: int, scores: Array) -> NDArray[np.bool_] | None:
        """Take the scores (8,) of a motion, over its calibrated thresholds.

        Parameters
        ----------
        seq, span
            Number of the row at which the motion ended, and how many rows it is long.
        newest
            Number of the last row.
        scores
            Shape (8,).

        Returns what was covered, (8,); None if the motion is too long ago.
        """
        own = self.at(seq)
        if own is None:
            return None
        missed = scores > np.exp(own)
        gap = 1 if self._last is None or seq <= self._last else seq - self._last
        rarity = min(gap, _RARE)
        eta = min(_ETA * rarity, _FASTER * gap / (newest - seq + span))
        x = self.x + eta * (self._counted(missed) - self._alpha)
        x = np.clip(x, np.minimum(self.x, own - MOST_STALE), np.maximum(self.x, own + MOST_STALE))
        beyond = self._counted(scores > np.exp(self._slow))
        slow = self._slow + _SLOW * rarity * (beyond - self._alpha)
        self._slow = np.clip(slow, _LEAST, LARGEST)
        self._x.append(np.clip(x, _LEAST, np.minimum(self._slow + _ABOVE, LARGEST)))
        self._since.append(newest + 1)
        self._last = max(seq, self._last or 0)
        if len(self._x) > _KEPT:
            del self._x[0], self._since[0]
        return ~missed

    def _counted(self, missed: NDArray[np.bool_]) -> Array:
        counted = missed.astype(np.float64)
        if self._joint:
            counted[:6] = missed[:6].any()
        return counted
