"""EuRoC poses (Burri et al. 2016): ``timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z,...`` in each line.

Integer nanoseconds, metres and a quaternion, scalar first: the pose of the body (the IMU) in the
world. ``T_BS`` in a camera's ``sensor.yaml`` is ``T_body_camera``, so

    T_world_camera = T_world_body @ T_BS
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.trajectories.poses import (
    camera_pose,
    quaternion_poses,
    rigid_transform,
)
from cvo_edge.trajectories.tables import read_rows, read_text
from cvo_edge.trajectories.trajectory import Entry, Trajectory, trajectory_of

FORM = "timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z"

# One period of the ground truth (200 Hz). Camera and IMU are triggered together and the ground
# truth uses the IMU's stamps, so the nearest pose belongs to the image and needs no interpolation.
MAX_STAMP_DIFFERENCE_NS = 5_000_000

_T_BS = re.compile(r"^T_BS:[^\[]*\[([^\]]*)\]", re.MULTILINE)


def read_euroc(path: Path, T_body_camera: NDArray[np.float64]) -> Trajectory[int]:
    """Read a list of body poses, by stamp, as the poses of a camera.

    Raises SourceError if the file cannot be read, a line is malformed, or no pose is valid.
    """
    rows = read_rows(path, FORM, separator=",", more=True)
    numbers = np.array([row.numbers(1) for row in rows]).reshape(-1, 7)
    poses, faults = quaternion_poses(numbers[:, :3], np.roll(numbers[:, 3:], -1, axis=1))
    if not np.array_equal(T_body_camera, np.eye(4)):
        poses = [camera_pose(pose, T_body_camera) for pose in poses]
    entries = [
        Entry(row.nanoseconds(), pose, row.where, fault or None)
        for row, pose, fault in zip(rows, poses, faults, strict=True)
    ]
    return trajectory_of(path, sorted(entries, key=lambda entry: entry.key))


def read_body_camera(path: Path) -> NDArray[np.float64]:
    """Read ``T_body_camera`` (4, 4), metres, from a ``sensor.yaml``; raises SourceError."""
    text = read_text(path, "a camera's T_BS and intrinsics")
    match = _T_BS.search(re.sub("#.*", "", text))
    return rigid_transform(path, "T_BS", match and match[1])
