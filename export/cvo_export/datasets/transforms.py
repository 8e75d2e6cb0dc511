"""nerfstudio and instant-ngp: ``transforms.json`` with images, poses and a camera.

Poses are read as ``cvo_edge.trajectories.transforms`` describes. Principal points give the centre
of the first pixel the coordinates (0.5, 0.5), this project (0, 0).
"""

from __future__ import annotations

import math
import os
from collections import Counter
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import Camera
from cvo_edge.errors import SourceError
from cvo_edge.trajectories.transforms import FILE, frame_poses, read_document
from cvo_export.datasets.base import PoseDataset
from cvo_export.datasets.colmap_cameras import camera_of
from cvo_export.datasets.folders import only_camera
from cvo_export.datasets.frames import FrameList
from cvo_export.datasets.sizes import with_camera

Array = NDArray[np.float64]

# Files of the Blender data sets leave the suffix out.
_SUFFIXES = ("", ".png", ".jpg", ".jpeg")


def open_nerfstudio(path: str) -> PoseDataset:
    """Read a ``transforms.json``, or a folder that contains it.

    Frames are in the file's order; images in several folders are one sequence a folder. The camera
    is stated for all frames or for each (``fl_x``, ``fl_y``, ``cx``, ``cy`` or ``camera_angle_x``,
    with ``k1 k2 p1 p2`` or, for ``OPENCV_FISHEYE``, ``k1 k2 k3 k4``). Frames with an invalid pose
    or a missing image are left out and counted.

    Raises SourceError if the file is malformed, frames have different cameras, or no frame has a
    pose.
    """
    given = Path(path)
    file = given if given.is_file() else given / FILE
    document = read_document(file)
    root = file.absolute().parent
    frames = FrameList(file)
    listed: dict[PurePosixPath, list[tuple[str, Path, Array | None, str]]] = {}
    for name, pose, where, fault in frame_poses(file, document):
        place = PurePosixPath(name)
        tried = [root / (name + suffix) for suffix in _SUFFIXES]
        image = next((each for each in tried if os.path.isfile(each)), tried[0])  # noqa: PTH113
        fault_at = f"{where}: {fault}" if pose is None else ""
        entry = (place.stem if image == tried[0] else place.name, image, pose, fault_at)
        listed.setdefault(place.parent, []).append(entry)
    shared = Counter(folder.name for folder in listed)
    for folder, entries in listed.items():
        # Of cam0/images and cam1/images, the last part is no name.
        sequence = (str(folder) if shared[folder.name] > 1 else folder.name) or root.name
        for stem, image, pose, fault_at in entries:
            frames.add(sequence, stem, image, pose, where=fault_at)
    dataset = frames.dataset(root.name)
    height, width = dataset.read_image(0).shape[:2]
    cameras = {
        f"frame {number}": _camera(file, {**document, **frame}, (width, height))
        for number, frame in enumerate(document["frames"])
    }
    camera = only_camera(file, cameras)
    if camera is None:
        return dataset
    return with_camera(dataset, str(file), camera)


def _camera(file: Path, values: dict[str, Any], size: tuple[int, int]) -> Camera | None:
    """Return the camera that a frame states, with the document's values; None without one."""
    try:
        width, height = int(values.get("w", size[0])), int(values.get("h", size[1]))
        angles = [values.get(f"camera_angle_{axis}") for axis in "xy"]
        by_angle = [
            0.5 * length / math.tan(0.5 * float(angle)) if angle else None
            for angle, length in zip(angles, (width, height), strict=True)
        ]
        fx = values.get("fl_x", by_angle[0])
        if fx is None:
            return None
        fy = values.get("fl_y", by_angle[1] or fx)
        fisheye = values.get("camera_model") == "OPENCV_FISHEYE" or values.get("is_fisheye")
        names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
        lens = [float(values.get(name, 0.0)) for name in names]
        centre = values.get("cx", width / 2), values.get("cy", height / 2)
        numbers = [float(value) for value in (fx, fy, *centre)]
        k3 = 0.0 if fisheye else float(values.get("k3", 0.0))
    except (TypeError, ValueError, ArithmeticError) as error:
        raise SourceError(f"{file}: expected the numbers of a camera, found {error}") from None
    model = str(values.get("camera_model", "OPENCV_FISHEYE" if fisheye else "OPENCV"))
    if fisheye or any(lens) or k3:
        numbers += lens
        if k3:
            numbers, model = [*numbers, k3, 0.0, 0.0, 0.0], "FULL_OPENCV"
        elif model in ("PINHOLE", "SIMPLE_PINHOLE"):
            model = "OPENCV"
    elif model in ("OPENCV", "SIMPLE_PINHOLE", "PERSPECTIVE"):
        model = "PINHOLE"
    return camera_of(str(file), model, (width, height), numbers)
