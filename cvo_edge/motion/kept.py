"""The last poses of a stream, and what a pose and a stamp have to be."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left
from collections.abc import Sequence
from operator import index

import numpy as np
from numpy.typing import ArrayLike

from cvo_edge.documents import shown
from cvo_edge.errors import UsageError
from cvo_edge.motion.relative import between, rotation_vector
from cvo_edge.motion.trace import MEANS, RECENT_NS, Limits
from cvo_edge.pose import Pose
from cvo_edge.trajectories.poses import FARTHEST_M, TOLERANCE, unit_quaternion

# Poses that are kept at most: a horizon of 100 m is long for a robot that stands.
KEPT = 1 << 16
_MISSING = (math.nan,) * 7
_LAST_NS = 2**63 - 1


class Kept:
    """The last rows of a stream, with the numbers of ``trace.Rows``, to the last bit.

    Single rows are added and read as floats: numpy takes ten times as long for so few.

    Parameters
    ----------
    limits
        What breaks the trajectory.
    columns
        How many columns come with each pose.

    Attributes
    ----------
    stamps_ns, numbers, part, path_m
        Of each row: its time, its number in the stream, and what ``Rows`` says.
    """

    def __init__(self, limits: Limits, columns: int) -> None:
        self.stamps_ns, self.numbers, self.part = array("q"), array("q"), array("q")
        self.path_m = array("d")
        self._limits = limits
        self._width = MEANS + columns
        self._poses, self._twist, self._change, self._sums = (array("d") for _ in range(4))

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.part)

    def pose(self, row: int) -> Sequence[float]:
        """Return the seven numbers of a pose."""
        return self._poses[7 * row : 7 * row + 7]

    def twist(self, row: int) -> Sequence[float]:
        """Return the six numbers of ``Rows.twist``."""
        return self._twist[6 * row : 6 * row + 6]

    def change(self, row: int) -> Sequence[float]:
        """Return the six numbers of ``Rows.change``."""
        return self._change[6 * row : 6 * row + 6]

    def means(self, start: int, end: int) -> list[float]:
        """Return the means of what is summed, from one row to a later one or the same."""
        width, count = self._width, max(end - start, 1)
        first = self._sums[width * start : width * start + width]
        last = self._sums[width * end : width * end + width]
        return [(b - a) / count for a, b in zip(first, last, strict=True)]

    def recent(self, row: int) -> int:
        """Return the first row of the same part that is at most a second older."""
        since = bisect_left(self.stamps_ns, self.stamps_ns[row] - RECENT_NS, 0, row)
        return max(since, bisect_left(self.part, self.part[row], 0, row))

    def add(
        self, number: int, stamp_ns: int, pose: Sequence[float], logarithms: Sequence[float]
    ) -> None:
        """Add a pose (7,), NaN if it is missing, with a later stamp and logarithms of columns."""
        if len(self.part) == 2 * KEPT:
            self._drop()
        known = False
        twist = change = (0.0,) * 6
        sizes = (0.0,) * MEANS
        length_m, part = 0.0, 0
        if last := len(self.part):
            seconds = 1e-9 * (stamp_ns - self.stamps_ns[-1])
            x, y, z, *q = between(self.pose(last - 1), pose)
            u, v, w = rotation_vector(*q)
            moved = x / seconds, y / seconds, z / seconds, u / seconds, v / seconds, w / seconds
            speed, turn = _two_sizes(moved)
            limits = self._limits
            known = seconds <= limits.gap_s and speed <= limits.speed and turn <= limits.turn
            part = self.part[-1] + (not known)
        if known:
            twist, length_m = moved, speed * seconds
            period_s, before = limits.period_s, self.twist(last - 1)
            if any(before):
                a, b, c, d, e, f = ((n - o) * period_s for n, o in zip(moved, before, strict=True))
                change = a, b, c, d, e, f
            sizes = (speed, turn, *_two_sizes([each / period_s for each in change]))
        values = (*sizes, *logarithms)
        if last:
            length_m += self.path_m[-1]
            sums = self._sums[-self._width :]
            values = tuple(a + b for a, b in zip(sums, values, strict=True))
        self.stamps_ns.append(stamp_ns)
        self.numbers.append(number)
        self.part.append(part)
        self.path_m.append(length_m)
        self._poses.extend(pose)
        self._twist.extend(twist)
        self._change.extend(change)
        self._sums.extend(values)

    def _drop(self) -> None:
        """Forget the older half, rather than grow without end."""
        for rows in (self.stamps_ns, self.numbers, self.part, self.path_m):
            del rows[:KEPT]
        wide = self._poses, self._twist, self._change, self._sums
        for each, width in zip(wide, (7, 6, 6, self._width), strict=True):
            del each[: width * KEPT]


def _two_sizes(twist: Sequence[float]) -> tuple[float, float]:
    x, y, z, u, v, w = twist
    return math.sqrt(x * x + y * y + z * z), math.sqrt(u * u + v * v + w * w)


def seven(pose: Pose | ArrayLike | None) -> tuple[float, ...]:
    """Return a pose (7,), NaN if it is none; raises UsageError for what is not seven numbers.

    Numbers that are no pose of a robot (not finite, a quaternion of another norm than 1, beyond
    1e9 m) count as none.
    """
    if pose is None:
        return _MISSING
    try:
        values = pose.to_array() if isinstance(pose, Pose) else np.asarray(pose)
        if values.dtype.kind not in "fiu" or values.shape != (7,):
            raise TypeError
        x, y, z, *q = map(float, values.tolist())
    except (TypeError, ValueError):
        raise UsageError(
            f"pose: expected 7 numbers tx ty tz qx qy qz qw, found {shown(pose)}"
        ) from None
    a, b, c, d = q
    square = a * a + b * b + c * c + d * d
    # Comparisons with NaN are false. As in files, norms within TOLERANCE of 1 are rounding.
    near = abs(x) < FARTHEST_M and abs(y) < FARTHEST_M and abs(z) < FARTHEST_M
    if not (near and abs(math.sqrt(square) - 1.0) <= TOLERANCE):
        return _MISSING
    return (x, y, z, *unit_quaternion(q))


def nanoseconds(stamp_ns: int) -> int:
    """Return a stamp; raises UsageError for anything but an integer of 63 bits."""
    try:
        if isinstance(stamp_ns, bool):
            raise TypeError
        stamp = index(stamp_ns)
    except TypeError:
        raise UsageError(f"stamp: expected integer nanoseconds, found {shown(stamp_ns)}") from None
    if not -_LAST_NS < stamp < _LAST_NS:
        raise UsageError(f"stamp: expected nanoseconds of 63 bits, found {stamp}")
    return stamp
