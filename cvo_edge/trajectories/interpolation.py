"""Poses over time: positions interpolated linearly, rotations at constant speed (slerp)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Mask = NDArray[np.bool_]


class Track(NamedTuple):
    """Stamps (n,) in ascending order, ns, and poses (n, 7); NaN where a pose is invalid."""

    stamps_ns: Stamps
    poses: Array

    @classmethod
    def of(cls, stamps_ns: Sequence[int], poses: Sequence[Array]) -> Track:
        """Return the track of poses in any order; of equal stamps, the first pose is kept."""
        stamps, kept = np.unique(np.array(stamps_ns, np.int64), return_index=True)
        return cls(stamps, np.array(poses, np.float64).reshape(-1, 7)[kept])

    @property
    def valid(self) -> Mask:
        """Which poses are valid (n,)."""
        return self._valid(slice(None))

    def at(self, stamps_ns: Stamps, bound_ns: int) -> tuple[Array, Mask]:
        """Return transforms (m, 4, 4) at stamps (m,), and whether the nearest is within a bound.

        As ``poses_at``.
        """
        poses, near = self.poses_at(stamps_ns, bound_ns)
        T = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
        T[:, :3, :3] = geometry.quaternion_to_matrix(poses[:, 3:])
        T[:, :3, 3] = poses[:, :3]
        T[~near] = np.nan
        return T, near

    def poses_at(self, stamps_ns: Stamps, bound_ns: int) -> tuple[Array, Mask]:
        """Return poses (m, 7) at stamps (m,), and whether the nearest is within a bound.

        Beside an invalid pose, the nearest one counts alone. Poses are NaN beyond the bound and
        where the nearest pose is invalid.
        """
        after = np.searchsorted(self.stamps_ns, stamps_ns).clip(0, len(self.stamps_ns) - 1)
        before = np.where(self.stamps_ns[after] > stamps_ns, np.maximum(after - 1, 0), after)
        past, left = stamps_ns - self.stamps_ns[before], self.stamps_ns[after] - stamps_ns
        near = np.minimum(np.abs(past), np.abs(left)) <= bound_ns
        span = (self.stamps_ns[after] - self.stamps_ns[before]).astype(np.float64)
        share = np.clip(past / np.where(span > 0, span, 1.0), 0.0, 1.0)[:, np.newaxis]
        alone = np.where(np.abs(past) <= np.abs(left), before, after)
        both = self._valid(before) & self._valid(after)
        before, after = np.where(both, before, alone), np.where(both, after, alone)
        start, end = self.poses[before], self.poses[after]
        turn = geometry.quaternion_multiply(geometry.quaternion_conjugate(start[:, 3:]), end[:, 3:])
        step = geometry.quaternion_exp(share * geometry.quaternion_log(turn))
        q = geometry.quaternion_normalise(geometry.quaternion_multiply(start[:, 3:], step))
        t_m = start[:, :3] + share * (end[:, :3] - start[:, :3])
        poses = np.concatenate([t_m, q], axis=1)
        poses[~near] = np.nan
        return poses, near

    def _valid(self, places: NDArray[np.int64] | slice) -> Mask:
        return np.asarray(np.isfinite(self.poses[places]).all(axis=1))
