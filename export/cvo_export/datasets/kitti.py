"""KITTI odometry (Geiger et al. 2012): ``sequences/NN/image_2`` or ``image_0``, ``poses/NN.txt``.

Poses and ``calib.txt`` are read as ``cvo_edge.trajectories.kitti`` describes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cvo_edge.errors import SourceError
from cvo_edge.files import natural_key
from cvo_edge.trajectories.kitti import CALIBRATION, pose_file, read_calibration, read_kitti
from cvo_export.datasets.base import Intrinsics, PoseDataset
from cvo_export.datasets.folders import only_world
from cvo_export.datasets.frames import FrameList

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
    if not (root / CALIBRATION).is_file():
        found = [file.parent for file in root.glob(f"sequences/*/{CALIBRATION}")]
        posed = [each for each in found if pose_file(each).is_file()]
        folder = only_world(root, sorted(posed, key=natural_key), "sequence with poses")
    camera, images = next(
        ((camera, images) for camera in (2, 0) if (images := _images(folder / f"image_{camera}"))),
        (0, {}),
    )
    K, T_camera0_camera = read_calibration(folder / CALIBRATION, camera)
    trajectory = read_kitti(pose_file(folder), T_camera0_camera)
    frames = FrameList(folder)
    frames.add_numbered(folder.name, images, trajectory)
    intrinsics = Intrinsics(*(float(K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2))))
    return replace(frames.dataset(f"kitti-{folder.name}"), intrinsics=intrinsics)


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
