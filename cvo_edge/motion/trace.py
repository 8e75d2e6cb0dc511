"""What an estimate says about its own motion: the numbers that errors are predicted from.

Nothing here needs the truth, and nothing looks ahead: all numbers of a pose come from this pose and
earlier ones of the same part. Whether poses are added one by one or all at once makes no
difference, to the last bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.relative import between, rotation_vectors

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# The changes of motion at its end, and one and two steps before: an estimator that lags, or that
# assumes a constant speed, errs by them.
LAGS = 3
# Averages are taken over this time, besides the motion itself.
_RECENT_S = 1.0
# Speed, turn rate and their changes per second: below these, a logarithm says nothing.
FLOORS = np.array([[0.02], [0.01], [0.05], [0.05]])
LEAST = 0.02
MEANS = len(FLOORS)


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


def rows_of(stamps_ns: Integers, poses: Array, columns: Array, limits: Limits) -> Rows:
    """Return the rows of all poses (n, 7) of a trajectory, with columns (n, c)."""
    fine = np.asarray(np.isfinite(columns).all(axis=1))
    poses = np.where(fine[:, np.newaxis], poses, np.nan)
    seconds = 1e-9 * np.diff(stamps_ns)
    step = between(poses[:-1].T, poses[1:].T)
    twist = np.array([*step[:3], *rotation_vectors(*step[3:])]) / seconds
    speed, turn = _size(twist[:3]), _size(twist[3:])
    # Comparisons with NaN are false: a pose that is no pose is a break, too.
    known = (seconds <= limits.gap_s) & (speed <= limits.speed) & (turn <= limits.turn)
    twist[:, ~known] = 0.0
    change = np.zeros_like(twist)
    # The twist before is zero after a break. One that stands exactly still counts as unknown, too:
    # a row does not say which it is.
    changes = known[1:] & twist[:, :-1].any(axis=0)
    change[:, 1:] = np.where(changes, (twist[:, 1:] - twist[:, :-1]) * limits.period_s, 0.0)
    per_s = change / limits.period_s
    sizes = [_size(each) for each in (twist[:3], twist[3:], per_s[:3], per_s[3:])]
    values = np.concatenate([np.stack(sizes, axis=1), column_logarithms(columns[1:])], axis=1)
    first = np.concatenate([np.zeros(MEANS), column_logarithms(columns[0])])
    part = np.concatenate([[0], np.cumsum(~known)])
    path_m = np.cumsum(np.concatenate([[0.0], np.where(known, speed * seconds, 0.0)]))
    # Sums in the order of single additions.
    sums = np.cumsum(np.concatenate([first[np.newaxis], values]), axis=0)
    nothing = np.zeros((1, 6))
    return Rows(
        stamps_ns,
        poses,
        part,
        path_m,
        np.concatenate([nothing, twist.T]),
        np.concatenate([nothing, change.T]),
        sums,
    )


def column_logarithms(columns: Array) -> Array:
    """Return the logarithms of columns of the file."""
    # Of a pose that is missing, which is a break, any number does.
    finite = np.where(np.isfinite(columns), columns, 1.0)
    return np.asarray(np.log(np.maximum(finite, 1e-12)))


def _size(vectors: Array) -> Array:
    x, y, z = vectors
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def motion_numbers(rows: Rows, start: Integers, end: Integers) -> tuple[Array, Array]:
    """Return the motions between rows, (m, 7), and the numbers their bias is linear in, (m, 24).

    These are the motion itself (m, rad) and the changes at its end.
    """
    moved = np.array(between(rows.poses[start].T, rows.poses[end].T))
    numbers = [moved[:3], np.array(rotation_vectors(*moved[3:]))]
    for lag in range(LAGS):
        row = np.maximum(end - lag, 0)
        same = (rows.part[row] == rows.part[end]) & (end >= lag)
        numbers.append(np.where(same, rows.change[row].T, 0.0))
    return moved.T, np.concatenate(numbers).T


def scale_numbers(rows: Rows, start: Integers, end: Integers, recent: Integers) -> Array:
    """Return the numbers that logarithms of errors are linear in, (m, ``scale_width``).

    ``recent``: the row one second before the end, or the first row of its part.
    """
    means, now = _means(rows, start, end), _means(rows, recent, end)
    seconds = 1e-9 * (rows.stamps_ns[end] - rows.stamps_ns[start])
    extent = np.stack([seconds, rows.path_m[end] - rows.path_m[start]])
    sizes = [
        np.log(means[:MEANS] + FLOORS),
        np.log(now[:MEANS] + FLOORS),
        np.log(np.abs(rows.twist[end].T) + LEAST),
        np.log(extent + LEAST),
        means[MEANS:],
        now[MEANS:],
    ]
    return np.concatenate(sizes).T


def tube_numbers(rows: Rows, start: Integers, end: Integers) -> Array:
    """Return the numbers that a tube's logarithms are linear in, (``tube_width``, m).

    They are means since the anchor ``start``, and how far it is back in time and along the path.
    """
    seconds = 1e-9 * (rows.stamps_ns[end] - rows.stamps_ns[start])
    metres = rows.path_m[end] - rows.path_m[start]
    return since_numbers(_means(rows, start, end), np.stack([seconds, metres]))


def since_numbers(means: Array, extent: Array) -> Array:
    """Return the same from means (4 + columns, m), and seconds and metres (2, m)."""
    return np.concatenate([logarithms(means), np.log(extent + LEAST)])


RECENT = Horizon("s", _RECENT_S)
RECENT_NS = round(1e9 * _RECENT_S)


def recent_numbers(rows: Rows, recent: Integers, end: Integers) -> Array:
    """Return logarithms of the means over the last second, (m, 4 + columns)."""
    return logarithms(_means(rows, recent, end)).T


def logarithms(means: Array) -> Array:
    """Return logarithms of the first four of means (4 + columns, m); columns are logarithms."""
    return np.concatenate([np.log(means[:MEANS] + FLOORS), means[MEANS:]])


def _means(rows: Rows, start: Integers, end: Integers) -> Array:
    """Return the means of what is summed, (4 + columns, m)."""
    return np.asarray((rows.sums[end] - rows.sums[start]).T / np.maximum(end - start, 1))


def scale_width(columns: int) -> int:
    """Return how many numbers ``scale_numbers`` gives with this many columns of a file."""
    return 2 * MEANS + 6 + 2 + 2 * columns


def tube_width(columns: int) -> int:
    """Return how many numbers ``tube_numbers`` gives with this many columns of a file."""
    return MEANS + columns + 2
