"""KITTI odometry (Geiger et al. 2012): the rows of a 3x4 matrix in each line of a pose file.

Line i, counted from 0, belongs to image i: twelve numbers, ``T_world_camera0`` in metres. Camera 0
is the left grey camera (OpenCV convention), and the world frame is its frame at the first image.
SemanticKITTI (Behley et al. 2019) has the same poses.

For each camera, ``calib.txt`` gives the projection P = K [I | b] from the rectified frame of camera
0: a point has the coordinates ``p_camera = p_camera0 + b``, in metres, in the camera's own frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.trajectories.poses import camera_pose, matrices_to_poses
from cvo_edge.trajectories.tables import read_rows
from cvo_edge.trajectories.trajectory import Entry, Trajectory, trajectory_of

Array = NDArray[np.float64]

FORM = " ".join(f"r{i}1 r{i}2 r{i}3 t{i}" for i in (1, 2, 3))
CALIBRATION = "calib.txt"


def pose_file(folder: Path) -> Path:
    """Return the poses of a sequence's folder: KITTI's or, without them, SemanticKITTI's."""
    own, beside = folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"
    return own if own.is_file() and not beside.is_file() else beside


def read_kitti(path: Path, T_camera0_camera: Array) -> Trajectory[int]:
    """Read a pose file, by number of the frame, as the poses of a camera.

    Raises SourceError if the file cannot be read, a line is malformed, or no pose is valid.
    """
    rows = read_rows(path, FORM, comments=False)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = np.array([row.numbers() for row in rows]).reshape(-1, 3, 4)
    poses, faults = matrices_to_poses(T)
    if not np.array_equal(T_camera0_camera, np.eye(4)):
        poses = [camera_pose(pose, T_camera0_camera) for pose in poses]
    return trajectory_of(
        path,
        [
            Entry(number, pose, row.where, fault or None)
            for number, (pose, row, fault) in enumerate(zip(poses, rows, faults, strict=True))
        ],
    )


def read_calibration(path: Path, camera: int) -> tuple[Array, Array]:
    """Return K (3, 3), pixels, and ``T_camera0_camera`` (4, 4), metres; raises SourceError."""
    form = f"P{camera}: " + " ".join(f"p{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3, 4))
    rows = {row.fields[0]: row for row in read_rows(path, form)}
    row = rows.get(f"P{camera}:")
    if row is None:
        raise SourceError(f"{path}: expected a line P{camera}:, found {', '.join(rows) or 'none'}")
    P = row.numbers(1).reshape(3, 4)
    K = P[:, :3]
    upper = K[1, 0] == 0.0 and (K[2] == [0, 0, 1]).all()
    if not (np.isfinite(P).all() and K[0, 0] > 0.0 and K[1, 1] > 0.0 and upper):
        raise row.refusal()
    T_camera0_camera = np.eye(4)
    T_camera0_camera[:3, 3] = -np.linalg.solve(K, P[:, 3])
    return K, T_camera0_camera
