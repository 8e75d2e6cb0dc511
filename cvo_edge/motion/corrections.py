"""What a pair's misalignment costs, and pairs without it.

Corrections follow each other: time, then frame, then scale. Each is measured by what it does to the
error that 90 % of motions do not exceed, over one frame and over one second. It is worth while if
it takes a tenth off any of them, if it is more than three standard errors away from nothing, and if
it is not so small that the bias, which is learned in any case, takes it off as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.motion.alignment import Alignment
from cvo_edge.motion.horizons import Horizon, path_length, starts
from cvo_edge.motion.pairs import Pair
from cvo_edge.motion.relative import motion, norms, residual
from cvo_edge.vocabulary import MOTION_CORRECTIONS, MotionCorrection

Array = NDArray[np.float64]

HORIZONS = (Horizon("f", 1), Horizon("s", 1))
_LEVEL = 0.9
_WORTH = 0.9
_SIGNIFICANT = 3.0
# The least corrections: a share of the estimate's period and, of keyframes, seconds; degrees, and a
# share of the scale.
_LEAST_OFFSET_S, _LEAST_OFFSET, _LEAST_TURN_DEG, _LEAST_SCALE = 0.02, 0.25, 0.6, 0.01
# Factors between units: one file in millimetres or centimetres.
_UNITS = (1000.0, 100.0, 0.01, 0.001)
_LIKE = 1.15


class Effect(NamedTuple):
    """Errors before and after a correction, (2 horizons, position m and rotation rad).

    ``worth``: whether it should be made.
    """

    before: Array
    after: Array
    worth: bool


class Fit(NamedTuple):
    """What was found of a pair, and the effect of each correction after those before it.

    ``period_s``: usual time between poses of the estimate.
    """

    name: str
    period_s: float
    alignment: Alignment
    effects: dict[MotionCorrection, Effect]

    @property
    def unit(self) -> float | None:
        """The factor of a unit by which translations differ, or None."""
        scale = self.alignment.scale
        return next((u for u in _UNITS if u / _LIKE <= scale <= u * _LIKE), None)


def corrected(
    pair: Pair,
    alignment: Alignment,
    wanted: Sequence[MotionCorrection],
    scale: float | None = None,
) -> Pair:
    """Return a pair with its own alignment corrected; ``scale`` is another one than its own."""
    if "time" in wanted:
        pair = replace(pair, offset_ns=round(1e9 * alignment.offset_s))
    if "frame" in wanted:
        pair = replace(pair, turn=geometry.quaternion_exp(alignment.determined_rotation))
    if "scale" in wanted:
        scale = alignment.scale
    if scale is not None:
        estimate = pair.estimate.copy()
        estimate[:, :3] *= scale
        pair = replace(pair, estimate=estimate)
    return pair


def fit_of(pair: Pair, alignment: Alignment) -> Fit:
    """Measure what correcting a pair would do."""
    period_s = 1e-9 * float(np.median(np.diff(pair.stamps_ns)))
    least_s = max(
        min(_LEAST_OFFSET * period_s, _LEAST_OFFSET_S), _SIGNIFICANT * alignment.offset_error_s
    )
    least_scale = max(_LEAST_SCALE, _SIGNIFICANT * alignment.scale_error)
    significant = {
        "time": abs(alignment.offset_s) > least_s,
        "frame": _turned(alignment),
        "scale": abs(alignment.scale - 1.0) > least_scale,
    }
    effects: dict[MotionCorrection, Effect] = {}
    before = _errors(pair)
    for count, correction in enumerate(MOTION_CORRECTIONS, start=1):
        after = _errors(corrected(pair, alignment, MOTION_CORRECTIONS[:count]))
        better = bool((after < _WORTH * before).any())
        effects[correction] = Effect(before, after, better and significant[correction])
        before = after
    return Fit(pair.name, period_s, alignment, effects)


def _turned(alignment: Alignment) -> bool:
    along = np.rad2deg(np.abs(alignment.axes @ alignment.determined_rotation))
    least = np.maximum(_LEAST_TURN_DEG, _SIGNIFICANT * alignment.rotation_error_deg)
    return bool((along > least).any())


def _errors(pair: Pair) -> Array:
    """Return the errors (2 horizons, 2) that 90 % of motions do not exceed; NaN without any."""
    truth, every = pair.truth, np.arange(len(pair.stamps_ns))
    found = np.full((len(HORIZONS), 2), np.nan)
    for row, horizon in enumerate(HORIZONS):
        along = horizon.along(pair.stamps_ns, path_length(np.nan_to_num(pair.estimate)))
        start = starts(horizon, along, np.zeros_like(every), every)
        end = np.flatnonzero(start >= 0)
        off = residual(
            motion(pair.estimate[start[end]], pair.estimate[end]),
            motion(truth[start[end]], truth[end]),
        )
        sizes = norms(off[np.isfinite(off).all(axis=1)])
        if len(sizes):
            found[row] = np.quantile(sizes, _LEVEL, axis=0)
    return found
