"""The motions that end at one pose of a stream, over all horizons at once.

The numbers are those of ``MotionHorizon.intervals``, to the last bit; what is looked up and counted
is done with floats, what is multiplied with arrays of all horizons.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.motion.fitting import ERRORS, Scale, predicted_bias, predicted_scale
from cvo_edge.motion.horizons import start_of
from cvo_edge.motion.intervals import Level, MotionHorizon
from cvo_edge.motion.kept import Kept
from cvo_edge.motion.relative import between, rotation_vector
from cvo_edge.motion.trace import FLOORS, LAGS, LEAST, MEANS, scale_width

Array = NDArray[np.float64]

_FLOORS = FLOORS[:, 0].tolist()
_NUMBERS = 6 + 6 * LAGS


class Ending(NamedTuple):
    """The motions over h horizons that end at one pose, and their intervals.

    Attributes
    ----------
    start
        The row at which each motion starts; -1 where there is none. What follows then means
        nothing.
    moved
        The seven numbers of each motion.
    seconds, metres
        How long each one is.
    bias, scale, widths
        Shape (6, h), (8, h) and (8, h): see ``Intervals``; half-widths, then the two radii.
    """

    start: list[int]
    moved: list[tuple[float, ...]]
    seconds: list[float]
    metres: list[float]
    bias: Array
    scale: Array
    widths: Array


class Endings:
    """The coefficients of all horizons.

    Parameters
    ----------
    horizons
        The horizons.
    level
        What to state.
    columns
        How many columns scales depend on.
    """

    def __init__(self, horizons: Sequence[MotionHorizon], level: Level, columns: int) -> None:
        self._horizons = horizons
        self._sizes = scale_width(columns)
        no_bias, no_size = np.zeros((_NUMBERS + 1, 6, 1)), np.zeros((self._sizes, 1))
        no_scale = Scale(np.zeros((self._sizes + 1, ERRORS, 1)), no_size, no_size)
        biases = [no_bias if each.bias is None else each.bias for each in horizons]
        scales = [no_scale if each.scale is None else each.scale for each in horizons]
        self._bias = np.concatenate(biases, axis=-1)
        self._scale = Scale(*(np.concatenate(each, axis=-1) for each in zip(*scales, strict=True)))
        self._thresholds = np.stack([each.thresholds(level) for each in horizons], axis=1)

    def at(
        self, kept: Kept, end: int, *, frames: bool = True, factors: Array | None = None
    ) -> Ending:
        """Return the motions that end at a row.

        ``frames``: whether horizons in frames apply; ``factors`` (8, h): what labels have made of
        the thresholds.
        """
        last, last_ns, last_m = kept.pose(end), kept.stamps_ns[end], kept.path_m[end]
        changes: list[float] = []
        for row in range(end, end - LAGS, -1):
            same = row >= 0 and kept.part[row] == kept.part[end]
            changes.extend(kept.change(row) if same else (0.0,) * 6)
        now = kept.means(kept.recent(end), end)
        usual = [a + b for a, b in zip(now, _FLOORS, strict=False)]
        twist = [abs(each) + LEAST for each in kept.twist(end)]
        starts, motions, seconds, metres = [], [], [], []
        numbers: list[float] = []
        sizes: list[float] = []
        for each in self._horizons:
            horizon, start = each.horizon, -1
            if frames or horizon.unit != "f":
                start = start_of(horizon, kept.stamps_ns, kept.path_m, kept.part, end)
            starts.append(start)
            # Without a motion, numbers of one that does not move: they are not used.
            first = max(start, 0)
            moved = between(kept.pose(first), last) if start >= 0 else _STILL
            means = kept.means(first, end)
            time_s, path_m = 1e-9 * (last_ns - kept.stamps_ns[first]), last_m - kept.path_m[first]
            motions.append(moved)
            seconds.append(time_s)
            metres.append(path_m)
            numbers += (*moved[:3], *rotation_vector(*moved[3:]), *changes)
            sizes += (a + b for a, b in zip(means, _FLOORS, strict=False))
            sizes += (*usual, *twist, time_s + LEAST, path_m + LEAST, *means[MEANS:], *now[MEANS:])
        bias = predicted_bias(self._bias, _by_number(numbers, _NUMBERS))
        columns = _by_number(sizes, self._sizes)
        logarithms = 2 * MEANS + 6 + 2
        columns[:logarithms] = np.log(columns[:logarithms])
        scale = predicted_scale(self._scale, columns)
        widths = scale * self._thresholds
        if factors is not None:
            widths *= factors
        return Ending(starts, motions, seconds, metres, bias, scale, widths)


_STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def _by_number(values: list[float], width: int) -> Array:
    """Return numbers (width, h), of h horizons one after the other."""
    return np.ascontiguousarray(np.array(values).reshape(-1, width).T)
