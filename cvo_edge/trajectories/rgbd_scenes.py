"""RGB-D Scenes v2 (Lai et al. 2014): ``a b c d x y z`` in each line of a ``.pose`` file.

Line i, counted from 0, belongs to image i: the quaternion a + bi + cj + dk, scalar first, then the
camera's position in metres. Together they are ``T_world_camera`` of an OpenCV camera. The world
frame is the first camera frame of the scene.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cvo_edge.trajectories.poses import quaternion_fault, quaternion_pose
from cvo_edge.trajectories.tables import read_rows
from cvo_edge.trajectories.trajectory import Entry, Trajectory, trajectory_of

FORM = "a b c d x y z"


def read_rgbd_scenes(path: Path) -> Trajectory[int]:
    """Read a pose file, by number of the frame.

    Raises SourceError if the file cannot be read, a line is malformed, or no pose is valid.
    """
    entries = []
    for number, row in enumerate(read_rows(path, FORM, comments=False)):
        numbers = row.numbers()
        position_m, q_xyzw = numbers[4:], np.roll(numbers[:4], -1)
        pose = quaternion_pose(position_m, q_xyzw)
        entries.append(Entry(number, pose, row.where, quaternion_fault(position_m, q_xyzw)))
    return trajectory_of(path, entries)
