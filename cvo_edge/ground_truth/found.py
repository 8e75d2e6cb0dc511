"""Poses that were found in files, by what they have in common with frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cvo_edge.trajectories.interpolation import Mask, Stamps
from cvo_edge.trajectories.poses import matrix_to_pose
from cvo_edge.trajectories.trajectory import Skipped, Trajectory, nearest_stamp

Array = NDArray[np.float64]
Key = int | str


@dataclass(frozen=True)
class Found:
    """Poses of a camera.

    Attributes
    ----------
    by
        What poses belong to frames by: the stamp in ns, the number or the name.
    at
        Maps this key of a frame to its ``T_world_camera`` (7,), or to None if it has none.
    first, last
        The keys of the first and the last pose.
    skipped
        What the file holds without giving a pose.
    note
        How the poses were moved to the camera, if they were.
    """

    by: Literal["stamp", "number", "name"]
    at: Callable[[Any], Array | None]
    first: Key
    last: Key
    skipped: Skipped
    note: str = ""


def by_key(by: Literal["number", "name"], trajectory: Trajectory[Any], note: str = "") -> Found:
    """Return poses that belong to the frames of their keys."""
    poses = dict(zip(trajectory.keys, trajectory.poses, strict=True))
    return Found(by, poses.get, *_ends(trajectory), trajectory.skipped, note)


def by_nearest_stamp(trajectory: Trajectory[int], bound_ns: int, note: str = "") -> Found:
    """Return poses that belong to the frames nearest to their stamps, within a bound."""

    def at(stamp_ns: int) -> Array | None:
        nearest = nearest_stamp(trajectory.keys, stamp_ns, bound_ns)
        return None if nearest is None else trajectory.poses[nearest]

    return Found("stamp", at, *_ends(trajectory), trajectory.skipped, note)


def interpolated(
    at: Callable[[Stamps], tuple[Array, Mask]],
    first_ns: int,
    last_ns: int,
    skipped: Skipped,
    note: str,
) -> Found:
    """Return poses at any stamp: ``at`` gives transforms (m, 4, 4) and which of them are near."""

    def pose_at(stamp_ns: int) -> Array | None:
        T, near = at(np.array([stamp_ns], np.int64))
        return matrix_to_pose(T[0]) if near[0] else None

    return Found("stamp", pose_at, first_ns, last_ns, skipped, note)


def _ends(trajectory: Trajectory[Any]) -> tuple[Key, Key]:
    return trajectory.keys[0], trajectory.keys[-1]
