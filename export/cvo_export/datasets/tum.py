"""TUM RGB-D (Sturm et al. 2012): images in ``rgb.txt`` and poses in ``groundtruth.txt``, by stamp.

``groundtruth.txt`` is read as ``cvo_edge.trajectories.tum`` describes. The pose is that of the
colour camera (OpenCV), in the frame of the motion capture system. Depth images are not read.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from cvo_edge.camera import Distortion
from cvo_edge.trajectories.tables import read_rows
from cvo_edge.trajectories.tum import MAX_STAMP_DIFFERENCE_NS, read_tum
from cvo_export.datasets.base import Intrinsics, Lens, PoseDataset
from cvo_export.datasets.folders import only_camera, recordings
from cvo_export.datasets.frames import FrameList
from cvo_export.datasets.nearest_poses import add_associated

# Intrinsics and distortion of the colour cameras at 640x480, as calibrated by the data set's
# authors ("File formats", table of intrinsics of the RGB cameras). The images of freiburg3 are
# undistorted.
_RADIAL: Distortion = "radial_tangential"
_CAMERAS = {
    "1": (
        Intrinsics(517.3, 516.5, 318.6, 255.3),
        Lens(_RADIAL, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    ),
    "2": (
        Intrinsics(520.9, 521.0, 325.1, 249.7),
        Lens(_RADIAL, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    ),
    "3": (Intrinsics(535.4, 539.2, 320.1, 247.6), Lens()),
}
_NOMINAL_WIDTH = 640


def open_tum(path: str) -> PoseDataset:
    """Read one sequence folder, or all sequence folders in a folder.

    Only combine sequences that share a world frame: recordings in one room with one set-up of the
    motion capture system. The files do not say, so this is not checked. Each image gets the pose
    with the nearest stamp. Frames with no pose within 0.02 s, an invalid pose or a missing image
    are left out and counted. Intrinsics are set if the folder's name contains freiburg1, 2 or 3
    (or fr1, 2 or 3); they are scaled to the images' width.

    Raises SourceError if a list is missing or malformed, sequences come from different cameras, or
    no frame has a pose.
    """
    root = Path(path)
    folders = recordings(root, "rgb.txt")
    frames = FrameList(root)
    for name, folder in folders.items():
        _add_sequence(frames, name, folder)
    dataset = frames.dataset(root.resolve().name)
    camera = only_camera(root, {name: _camera(name) for name in folders})
    if camera is None:
        return dataset
    intrinsics, lens = camera
    scale = dataset.read_image(0).shape[1] / _NOMINAL_WIDTH
    return replace(dataset, intrinsics=intrinsics.scaled(scale), lens=lens)


def _add_sequence(frames: FrameList, name: str, folder: Path) -> None:
    listed = read_rows(folder / "rgb.txt", "timestamp filename")
    images = [(row.seconds(), folder / row.fields[1]) for row in listed]
    trajectory = read_tum(folder / "groundtruth.txt")
    add_associated(frames, name, images, trajectory, MAX_STAMP_DIFFERENCE_NS)


def _camera(name: str) -> tuple[Intrinsics, Lens] | None:
    found = re.search(r"(?<![a-z0-9])fr(?:eiburg)?([123])(?![a-z0-9])", name)
    return _CAMERAS[found[1]] if found else None
