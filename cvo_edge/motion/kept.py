"""The last poses of a stream, and what a pose and a stamp have to be."""

from __future__ import annotations

from operator import index

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvo_edge import geometry
from cvo_edge.documents import shown
from cvo_edge.errors import UsageError
from cvo_edge.motion.trace import Rows, cut
from cvo_edge.pose import Pose
from cvo_edge.trajectories.poses import quaternion_pose

Array = NDArray[np.float64]

# Poses that are kept at most: a horizon of 100 m is long for a robot that stands.
KEPT = 1 << 16
_FIRST = 256
_LAST_NS = 2**63 - 1


class Kept:
    """The last rows, in arrays that grow."""

    def __init__(self) -> None:
        self._size = 0
        self._arrays: Rows | None = None
        self.numbers: list[int] = []

    @property
    def rows(self) -> Rows | None:
        """All rows; None without any."""
        return None if self._arrays is None else cut(self._arrays, slice(0, self._size))

    def add(self, seq: int, row: Rows) -> Rows:
        """Add a row and return all of them."""
        if self._arrays is None:
            self._arrays = cut(row, np.zeros(_FIRST, np.int64))
        if self._size == len(self._arrays.part):
            # Rather than growing without end, the older ones are dropped.
            kept = min(self._size, KEPT)
            latest = np.arange(self._size - kept, self._size)
            self._arrays = cut(self._arrays, np.concatenate([latest, latest]))
            self.numbers = self.numbers[-kept:]
            self._size = kept
        for array, values in zip(self._arrays, row, strict=True):
            array[self._size] = values[0]
        self.numbers.append(seq)
        self._size += 1
        return cut(self._arrays, slice(0, self._size))


def seven(pose: Pose | ArrayLike | None) -> Array:
    """Return a pose (7,), NaN if it is none; raises UsageError for what is not seven numbers.

    Numbers that are no pose of a robot (not finite, no quaternion, beyond 1e9 m) count as none.
    """
    if pose is None:
        return np.full(7, np.nan)
    try:
        values = pose.to_array() if isinstance(pose, Pose) else np.asarray(pose)
        if values.dtype.kind not in "fiu":
            raise TypeError
        values = values.astype(np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (7,):
        raise UsageError(f"pose: expected 7 numbers tx ty tz qx qy qz qw, found {shown(pose)}")
    with np.errstate(all="ignore"):
        q = geometry.quaternion_normalise(values[3:])
        found = quaternion_pose(values[:3], q)
    return np.full(7, np.nan) if found is None else found


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
