"""TUM-VI (Schubert et al. 2018): poses of the IMU, and the way from there to a camera.

``mav0/mocap0/data.csv`` lists ``timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z``: integer nanoseconds,
metres and a quaternion, scalar first. This is the pose of the IMU in the frame of the motion
capture system, 120 a second; ``dso/gt_imu.csv`` has the same columns. ``T_cam_imu`` in
``dso/camchain.yaml`` (Kalibr) maps points from the IMU's frame to the camera's, so

    T_world_camera = T_world_imu @ inverse(T_cam_imu)

Poses are interpolated, because the cameras do not run with the motion capture system.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.trajectories.euroc import read_euroc
from cvo_edge.trajectories.interpolation import Track
from cvo_edge.trajectories.poses import rigid_transform
from cvo_edge.trajectories.tables import read_text
from cvo_edge.trajectories.trajectory import Skipped

POSES = ("mav0/mocap0/data.csv", "dso/gt_imu.csv")
CAMERA = "dso/camchain.yaml"

# More than half a period of the motion capture system (120 Hz).
MAX_STAMP_DIFFERENCE_NS = 5_000_000

_INVALID = np.full(7, np.nan)

# A comment of YAML, the key of a camera, that of the transform, any key, and the mark of an item.
_COMMENT = re.compile(r"(?:^|[ \t])#.*", re.MULTILINE)
_CAMERA = re.compile(r"(?:^|[\s{,])[\"']?(cam[0-9]+)[\"']?\s*:", re.MULTILINE)
_TRANSFORM = re.compile(r"(?:^|[\s{,])[\"']?T_cam_imu[\"']?\s*:")
_KEY = re.compile(r"[\"']?[A-Za-z_]\w*[\"']?\s*:")
_ITEM = re.compile(r"(?<=\s)-\s")


def read_imu_track(path: Path) -> tuple[Track, Skipped]:
    """Read a list of poses of the IMU, and what in it gives no pose.

    Raises SourceError if the file cannot be read, a line is malformed, or no pose is valid.
    """
    # The columns are EuRoC's, and here the body is the IMU.
    trajectory = read_euroc(path, np.eye(4))
    poses = [_INVALID if pose is None else pose for pose in trajectory.poses]
    return Track.of(trajectory.keys, poses), trajectory.skipped


def read_imu_camera(path: Path, camera: str = "cam0") -> NDArray[np.float64]:
    """Read ``T_imu_camera`` (4, 4), metres, of a camera in Kalibr's ``camchain.yaml``.

    The file is read without YAML's library: the transform is the 16 numbers after its key, as a
    list or as rows, in brackets or one item a line. Raises SourceError for others.
    """
    text = _COMMENT.sub("", read_text(path, f"{camera} with T_cam_imu"))
    _, *parts = _CAMERA.split(text)
    cameras = dict(zip(parts[::2], parts[1::2], strict=True))
    if camera not in cameras:
        listed = ", ".join(cameras) or "no camera"
        raise SourceError(f"{path}: expected {camera} with T_cam_imu, found {listed}")
    _, *values = _TRANSFORM.split(cameras[camera], maxsplit=1)
    numbers = None
    if values:
        value = _KEY.split(values[0], maxsplit=1)[0]
        listed = re.sub(r"[\[\]{}\n]", " ", _ITEM.sub(",", f"\n{value}"))
        numbers = ",".join(part for part in listed.split(",") if part.strip())
    T_camera_imu = rigid_transform(path, f"T_cam_imu of {camera}", numbers)
    return np.asarray(np.linalg.inv(T_camera_imu), np.float64)
