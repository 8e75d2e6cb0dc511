"""KITTI odometry (Geiger et al. 2012): ``sequences/NN/image_2`` or ``image_0``, ``poses/NN.txt``.

Line i of a pose file, counted from 0, belongs to image i: twelve numbers, the rows of the 3x4
matrix ``T_world_camera0`` in metres. Camera 0 is the left grey camera (OpenCV convention), and the
world frame is its frame at the first image. For each camera, ``calib.txt`` gives the projection
P = K [I | b] from the rectified frame of camera 0: a point has the coordinates
``p_camera = p_camera0 + b``, in metres, in the camera's own frame.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.input.image_files import natural_key
from cvo_edge.trajectories.poses import camera_pose, matrix_to_pose
from cvo_edge.trajectories.tables import Row, read_rows
from cvo_export.datasets.base import Intrinsics, PoseDataset
from cvo_export.datasets.folders import only_world
from cvo_export.datasets.frames import FrameList

Array = NDArray[np.float64]

_CALIBRATION = "calib.txt"
_SUFFIXES = (".png", ".jpg")


def open_kitti(path: str) -> PoseDataset:
    """Read one sequence, ``ROOT/sequences/NN``, with its poses in ``ROOT/poses/NN.txt``.

    SemanticKITTI (Behley et al. 2019) has the same poses in ``ROOT/sequences/NN/poses.txt``.
    Each sequence has its own world frame; ``path`` may be ``ROOT`` if only one sequence has poses.
    Images, poses and intrinsics are those of the left colour camera (``image_2``) or, if it is
    missing, of the left grey camera (``image_0``). Frames with a missing image, a missing pose or
    an invalid pose are left out and counted. The data set is named ``kitti-NN``. ``times.txt`` is
    not read.

    Raises SourceError if there are several sequences, a file is malformed, two images have one
    number, or no frame has a pose.
    """
    root = Path(path).absolute()
    folder = root
    if not (root / _CALIBRATION).is_file():
        found = [file.parent for file in root.glob(f"sequences/*/{_CALIBRATION}")]
        posed = [each for each in found if _pose_file(each).is_file()]
        folder = only_world(root, sorted(posed, key=natural_key), "sequence with poses")
    camera, images = next(
        ((camera, images) for camera in (2, 0) if (images := _images(folder / f"image_{camera}"))),
        (0, {}),
    )
    intrinsics, T_camera0_camera = _calibration(folder / _CALIBRATION, camera)
    form = " ".join(f"r{i}1 r{i}2 r{i}3 t{i}" for i in (1, 2, 3))
    rows = read_rows(_pose_file(folder), form, comments=False)
    matrices = [np.vstack([row.numbers().reshape(3, 4), [0.0, 0.0, 0.0, 1.0]]) for row in rows]
    poses = [camera_pose(matrix_to_pose(T), T_camera0_camera) for T in matrices]
    frames = FrameList(folder)
    frames.add_numbered(folder.name, images, poses)
    return replace(frames.dataset(f"kitti-{folder.name}"), intrinsics=intrinsics)


def _pose_file(folder: Path) -> Path:
    """Return KITTI's file of poses or, without it, SemanticKITTI's in the sequence's folder."""
    own, beside = folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"
    return own if own.is_file() and not beside.is_file() else beside


def _images(folder: Path) -> dict[int, Path]:
    found: dict[int, Path] = {}
    for file in sorted(file for suffix in _SUFFIXES for file in folder.glob("*" + suffix)):
        if not file.stem.isdecimal():
            continue
        first = found.setdefault(int(file.stem), file)
        if first != file:
            raise SourceError(
                f"{folder}: expected one image for each number, found {first.name} and {file.name}"
            )
    return found


def _calibration(path: Path, camera: int) -> tuple[Intrinsics, Array]:
    """Return a camera's intrinsics and its ``T_camera0_camera`` (4, 4), metres."""
    form = f"P{camera}: " + " ".join(f"p{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3, 4))
    rows: dict[str, Row] = {row.fields[0]: row for row in read_rows(path, form)}
    row = rows.get(f"P{camera}:")
    if row is None:
        raise SourceError(f"{path}: expected a line P{camera}:, found {', '.join(rows) or 'none'}")
    P = row.numbers(1).reshape(3, 4)
    K = P[:, :3]
    intrinsics = Intrinsics(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    upper = K[1, 0] == 0.0 and (K[2] == [0, 0, 1]).all()
    if not (np.isfinite(P).all() and intrinsics.possible and upper):
        raise row.refusal()
    T_camera0_camera = np.eye(4)
    T_camera0_camera[:3, 3] = -np.linalg.solve(K, P[:, 3])
    return intrinsics, T_camera0_camera
