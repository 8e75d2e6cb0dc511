"""What an estimate says about its own motion: the numbers that errors are predicted from.

Nothing here needs the truth, and nothing looks ahead: all numbers of a pose come from this pose and
earlier ones of the same part. Whether poses are added one by one or all at once makes no
difference, to the last bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.relative import motion

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# The changes of motion at its end, and one and two steps before: an estimator that lags, or that
# assumes a constant speed, errs by them.
LAGS = 3
# Averages are taken over this time, besides the motion itself.
_RECENT_S = 1.0
# Speed, turn rate and their changes per second: below these, a logarithm says nothing.
_FLOORS = np.array([0.02, 0.01, 0.05, 0.05])
_LEAST = 0.02
_MEANS = len(_FLOORS)


class Limits(NamedTuple):
    """A motion never crosses a step that is longer than ``gap_s``, or faster than these speeds.

    ``period_s`` is the usual time between poses; ``speed`` in m/s, ``turn`` in rad/s.
    """

    period_s: float
    gap_s: float
    speed: float
    turn: float


class Rows(NamedTuple):
    """Poses with what follows from them; n poses in the order of their stamps.

    Attributes
    ----------
    stamps_ns, poses
        Shape (n,) and (n, 7): ``T_world_body``; NaN where the estimator gave no pose.
    part
        Shape (n,): counts the breaks up to each pose; a pose that is no pose is a part of its own.
    path_m
        Shape (n,): length of the path up to each pose, without steps across a break.
    twist
        Shape (n, 6): motion of the step that ends at the pose, m/s and rad/s; zero after a break.
    change
        Shape (n, 6): how it differs from that of the step before, m and rad a step; zero without.
    sums
        Shape (n, 4 + columns): running sums of speed, turn rate, the sizes of their changes per
        second, and the logarithms of columns of the file.
    """

    stamps_ns: Integers
    poses: Array
    part: Integers
    path_m: Array
    twist: Array
    change: Array
    sums: Array


def first_row(stamp_ns: int, pose: Array, columns: Array) -> Rows:
    """Return the first row of a trace: pose (7,), columns (c,)."""
    return Rows(
        np.array([stamp_ns], np.int64),
        _usable(pose[np.newaxis], columns[np.newaxis]),
        np.zeros(1, np.int64),
        np.zeros(1),
        np.zeros((1, 6)),
        np.zeros((1, 6)),
        np.concatenate([np.zeros(_MEANS), _logarithms(columns)])[np.newaxis],
    )


def next_rows(
    last: Rows, stamps_ns: Integers, poses: Array, columns: Array, limits: Limits
) -> Rows:
    """Return the rows of poses (m, 7) with later stamps (m,) and columns (m, c).

    ``last`` is the row before; of more rows, the last one counts.
    """
    poses = _usable(poses, columns)
    stamps = np.concatenate([last.stamps_ns[-1:], stamps_ns])
    every = np.concatenate([last.poses[-1:], poses])
    seconds = 1e-9 * np.diff(stamps)
    step = motion(every[:-1], every[1:])
    twist = np.concatenate([step[:, :3], geometry.quaternion_log(step[:, 3:])], axis=1)
    twist /= seconds[:, np.newaxis]
    speed, turn = _sizes(twist)
    # Comparisons with NaN are false: a pose that is no pose is a break, too.
    known = (seconds <= limits.gap_s) & (speed <= limits.speed) & (turn <= limits.turn)
    twist[~known] = 0.0
    before = np.concatenate([last.twist[-1:], twist[:-1]])
    # The twist before is zero after a break. One that stands exactly still counts as unknown, too:
    # a row does not say which it is.
    moving = before.any(axis=1)
    change = np.where((known & moving)[:, np.newaxis], (twist - before) * limits.period_s, 0.0)
    sizes = [*_sizes(twist), *_sizes(change / limits.period_s)]
    values = np.concatenate([np.stack(sizes, axis=1), _logarithms(columns)], axis=1)
    length_m = np.where(known, speed * seconds, 0.0)
    return Rows(
        stamps_ns,
        poses,
        last.part[-1] + np.cumsum(~known),
        _summed(last.path_m[-1:], length_m),
        twist,
        change,
        _summed(last.sums[-1:], values),
    )


def cut(rows: Rows, places: Integers | slice) -> Rows:
    """Return some of the rows."""
    return Rows(
        rows.stamps_ns[places],
        rows.poses[places],
        rows.part[places],
        rows.path_m[places],
        rows.twist[places],
        rows.change[places],
        rows.sums[places],
    )


def rows_of(stamps_ns: Integers, poses: Array, columns: Array, limits: Limits) -> Rows:
    """Return the rows of all poses (n, 7) of a trajectory, with columns (n, c)."""
    first = first_row(int(stamps_ns[0]), poses[0], columns[0])
    rest = next_rows(first, stamps_ns[1:], poses[1:], columns[1:], limits)
    return Rows(*(np.concatenate(both) for both in zip(first, rest, strict=True)))


def _usable(poses: Array, columns: Array) -> Array:
    """Return poses (m, 7), NaN where a column (m, c) is not a number."""
    fine = np.asarray(np.isfinite(columns).all(axis=1))
    return np.asarray(np.where(fine[:, np.newaxis], poses, np.nan))


def _summed(start: Array, values: Array) -> Array:
    """Return running sums in the order of single additions."""
    return np.asarray(np.cumsum(np.concatenate([start, values]), axis=0)[1:])


def _sizes(twists: Array) -> tuple[Array, Array]:
    halves = twists.reshape(-1, 2, 3)
    sizes = np.sqrt((halves * halves).sum(axis=2))
    return sizes[:, 0], sizes[:, 1]


def _logarithms(columns: Array) -> Array:
    # Of a pose that is missing, which is a break, any number does.
    finite = np.where(np.isfinite(columns), columns, 1.0)
    return np.asarray(np.log(np.maximum(finite, 1e-12)))


def motion_numbers(rows: Rows, start: Integers, end: Integers) -> tuple[Array, Array]:
    """Return the motions between rows, (m, 7), and the numbers their bias is linear in, (m, 24).

    These are the motion itself (m, rad) and the changes at its end.
    """
    moved = motion(rows.poses[start], rows.poses[end])
    numbers = [moved[:, :3], geometry.quaternion_log(moved[:, 3:])]
    for lag in range(LAGS):
        row = np.maximum(end - lag, 0)
        same = (rows.part[row] == rows.part[end]) & (end >= lag)
        numbers.append(np.where(same[:, np.newaxis], rows.change[row], 0.0))
    return moved, np.concatenate(numbers, axis=1)


def scale_numbers(rows: Rows, start: Integers, end: Integers, recent: Integers) -> Array:
    """Return the numbers that logarithms of errors are linear in, (m, ``scale_width``).

    ``recent``: the row one second before the end, or the first row of its part.
    """
    means = (rows.sums[end] - rows.sums[start]) / (end - start)[:, np.newaxis]
    now = _recent_means(rows, recent, end)
    seconds = 1e-9 * (rows.stamps_ns[end] - rows.stamps_ns[start])
    extent = np.stack([seconds, rows.path_m[end] - rows.path_m[start]], axis=1)
    sizes = [
        np.log(means[:, :_MEANS] + _FLOORS),
        np.log(now[:, :_MEANS] + _FLOORS),
        np.log(np.abs(rows.twist[end]) + _LEAST),
        np.log(extent + _LEAST),
        means[:, _MEANS:],
        now[:, _MEANS:],
    ]
    return np.concatenate(sizes, axis=1)


RECENT = Horizon("s", _RECENT_S)


def recent_numbers(rows: Rows, recent: Integers, end: Integers) -> Array:
    """Return logarithms of the means over the last second, (m, 4 + columns)."""
    now = _recent_means(rows, recent, end)
    return np.concatenate([np.log(now[:, :_MEANS] + _FLOORS), now[:, _MEANS:]], axis=1)


def _recent_means(rows: Rows, recent: Integers, end: Integers) -> Array:
    return np.asarray(
        (rows.sums[end] - rows.sums[recent]) / np.maximum(end - recent, 1)[:, np.newaxis]
    )


def scale_width(columns: int) -> int:
    """Return how many numbers ``scale_numbers`` gives with this many columns of a file."""
    return 2 * _MEANS + 6 + 2 + 2 * columns
