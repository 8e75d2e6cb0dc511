"""Poses from the numbers of a file; None where they are no pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.pose import Pose

Array = NDArray[np.float64]


def quaternion_pose(position_m: Array, q_xyzw: Array) -> Array | None:
    """Position (3,), metres, and quaternion (4,) -> pose (7,), its quaternion unit with qw >= 0.

    Files round quaternions to a few digits; one that is not finite, or whose norm is further than
    0.01 from 1, is no rotation.
    """
    if not (np.isfinite(position_m).all() and abs(np.linalg.norm(q_xyzw) - 1.0) <= 0.01):
        return None
    return np.concatenate([position_m, geometry.quaternion_normalise(q_xyzw)])


def camera_pose(pose: Array | None, T_body_camera: Array) -> Array | None:
    """``T_world_body`` (7,) and ``T_body_camera`` (4, 4), metres -> ``T_world_camera`` (7,)."""
    if pose is None:
        return None
    return Pose.from_matrix(Pose.from_array(pose).to_matrix() @ T_body_camera).to_array()
