"""A recording as it is calibrated: its rows, and the truth at their stamps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.pairs import Pair
from cvo_edge.motion.relative import motion, norms, residual
from cvo_edge.motion.trace import Limits, Rows, rows_of

Array = NDArray[np.float64]

# Limits, as multiples of what was found in the recordings.
_GAP, _FAST, _SLACK_MPS, _SLACK_RADPS = 3.0, 3.0, 1.0, 0.5
_NEARLY_ALL = 0.999
_NOTHING = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


class About(NamedTuple):
    """What is known of a pair before limits are: names, and what its truth's motions reach.

    ``columns``: names of the estimate's columns. ``reached``: usual and longest time between poses
    (s), highest speed (m/s) and turn rate (rad/s), each but for a thousandth of the poses.
    ``unscaled``: whether the estimate's steps have no length; the speed is then one step's.
    """

    name: str
    group: str
    columns: tuple[str, ...]
    reached: tuple[float, float, float, float]
    unscaled: bool


class Recording(NamedTuple):
    """A recording's rows and its truth (n, 7), NaN where it is not known."""

    rows: Rows
    truth: Array


class Size(NamedTuple):
    """How large a recording is: poses with a truth, all rows, seconds and metres."""

    poses: int
    rows: int
    seconds: float
    metres: float


def about(pair: Pair) -> About:
    """Describe a pair."""
    seconds = 1e-9 * np.diff(pair.stamps_ns)
    usual_s, truth = float(np.median(seconds)), pair.truth
    step = norms(residual(np.tile(_NOTHING, (len(seconds), 1)), motion(truth[:-1], truth[1:])))
    rates = step[np.isfinite(step).all(axis=1)] / usual_s
    speed, turn = np.quantile(rates, _NEARLY_ALL, axis=0).tolist()
    longest_s = float(np.quantile(seconds, _NEARLY_ALL))
    if pair.unscaled:
        speed = 1.0 / usual_s
    reached = usual_s, longest_s, speed, turn
    return About(pair.name, pair.group, tuple(pair.columns), reached, pair.unscaled)


def limits_of(pairs: Sequence[About]) -> Limits:
    """Return what breaks trajectories like these: three times what the truth's motions reach."""
    usual, longest, speeds, turns = zip(*(each.reached for each in pairs), strict=True)
    period_s = float(np.median(usual))
    gap_s = max(_GAP * period_s, 1.5 * min(max(longest), 10.0 * period_s))
    speed, turn = _FAST * max(speeds) + _SLACK_MPS, _FAST * max(turns) + _SLACK_RADPS
    return Limits(*(float(f"{value:.4g}") for value in (period_s, gap_s, speed, turn)))


def trace_of(pair: Pair, limits: Limits, columns: Sequence[str]) -> Rows:
    """Return the rows of a pair's estimate."""
    values = np.empty((len(pair.stamps_ns), len(columns)))
    for index, name in enumerate(columns):
        values[:, index] = pair.columns[name]
    return rows_of(pair.stamps_ns, pair.estimate, values, limits)


def recording_of(pair: Pair, limits: Limits, columns: Sequence[str]) -> Recording:
    """Return the rows and the truth of a pair."""
    return Recording(trace_of(pair, limits, columns), pair.truth)


def size_of(recording: Recording) -> Size:
    """Measure a recording."""
    rows = recording.rows
    known = np.isfinite(np.concatenate([recording.truth, rows.poses], axis=1)).all(axis=1)
    seconds = 1e-9 * float(rows.stamps_ns[-1] - rows.stamps_ns[0])
    return Size(int(known.sum()), len(known), seconds, float(rows.path_m[-1]))


def extent(recording: Recording, horizon: Horizon) -> float:
    """Return how long a recording is, in the unit of a horizon."""
    along = horizon.along(recording.rows.stamps_ns, recording.rows.path_m)
    return float(along[-1] - along[0])


def longest_part(recording: Recording, horizon: Horizon) -> tuple[float, Array]:
    """Return the longest part between breaks, and all steps, in the unit of a horizon."""
    rows = recording.rows
    along = horizon.along(rows.stamps_ns, rows.path_m)
    begin = np.flatnonzero(np.diff(rows.part, prepend=-1))
    end = np.append(begin[1:], len(along)) - 1
    return float((along[end] - along[begin]).max()), np.diff(along)
