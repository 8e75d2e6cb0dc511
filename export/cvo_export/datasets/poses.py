"""Convert numbers from files to poses, or to None if they are invalid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.pose import Pose

Array = NDArray[np.float64]


def quaternion_pose(position_m: Array, q_xyzw: Array) -> Array | None:
    """Return the pose (7,) of a position (3,), metres, and a quaternion (4,); unit, qw >= 0.

    Files round quaternions to a few digits, so norms within 0.01 of 1 are normalised. Returns None
    for other norms and for numbers that are not finite.
    """
    if not (np.isfinite(position_m).all() and abs(np.linalg.norm(q_xyzw) - 1.0) <= 0.01):
        return None
    return np.concatenate([position_m, geometry.quaternion_normalise(q_xyzw)])


def camera_pose(pose: Array | None, T_body_camera: Array) -> Array | None:
    """Return ``T_world_camera`` (7,) from ``T_world_body`` (7,) and ``T_body_camera`` (4, 4)."""
    if pose is None:
        return None
    return Pose.from_matrix(Pose.from_array(pose).to_matrix() @ T_body_camera).to_array()
