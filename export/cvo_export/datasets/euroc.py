"""EuRoC MAV (Burri et al. 2016) in the ASL layout: images and ground truth under ``mav0``.

``cam0/data.csv`` lists ``timestamp,filename`` of the images in ``cam0/data``.
``state_groundtruth_estimate0/data.csv`` is read as ``cvo_edge.trajectories.euroc`` describes, with
``T_BS`` of ``cam0/sensor.yaml``.

Images are grey and returned as BGR. Lens distortion is read, not corrected.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.trajectories.euroc import (
    MAX_STAMP_DIFFERENCE_NS,
    read_body_camera,
    read_euroc,
)
from cvo_edge.trajectories.tables import read_rows
from cvo_export.datasets.base import PoseDataset
from cvo_export.datasets.folders import only_camera, recordings
from cvo_export.datasets.frames import FrameList
from cvo_export.datasets.nearest_poses import add_associated
from cvo_export.datasets.yaml_cameras import Pinhole, pinhole, read_document

Array = NDArray[np.float64]

_IMAGES = "mav0/cam0/data.csv"
_CAMERA = "mav0/cam0/sensor.yaml"
_POSES = "mav0/state_groundtruth_estimate0/data.csv"
# TUM-VI has the same folders of images.
_OF_TUM_VI = ("mav0/mocap0", "dso")


def open_euroc(path: str) -> PoseDataset:
    """Read one recording (the folder that contains ``mav0``), or all recordings in a folder.

    Only combine recordings that share a world frame, as those from one room do (``V1_01`` to
    ``V1_03``, ``V2_01`` to ``V2_03``); the files do not say, so this is not checked. Each image
    gets the pose with the nearest stamp. Frames with no pose within 5 ms, an invalid pose or a
    missing image are left out and counted. Intrinsics are set if ``sensor.yaml`` describes a
    pinhole camera with radial-tangential or equidistant distortion.

    Raises SourceError if a file is missing or malformed, recordings come from different cameras,
    or no frame has a pose.
    """
    root = Path(path)
    frames = FrameList(root)
    cameras: dict[str, Pinhole | None] = {}
    for name, folder in recordings(root, _IMAGES).items():
        other = next((each for each in _OF_TUM_VI if (folder / each).is_dir()), None)
        if other and not (folder / _POSES).is_file():
            raise SourceError(
                f"{folder}: expected {_POSES}, found {other} of TUM-VI; read it as tum-vi:{path}"
            )
        cameras[name], T_body_camera = _read_camera(folder / _CAMERA)
        _add_recording(frames, name, folder, T_body_camera)
    dataset = frames.dataset(root.resolve().name)
    camera = only_camera(root, cameras)
    if camera is None:
        return dataset
    return camera.of(dataset, f"{root}: {_CAMERA}")


def _add_recording(frames: FrameList, name: str, folder: Path, T_body_camera: Array) -> None:
    listed = read_rows(folder / _IMAGES, "timestamp,filename", separator=",")
    image_folder = (folder / _IMAGES).with_name("data")
    images = [(row.nanoseconds(), image_folder / row.fields[1]) for row in listed]
    trajectory = read_euroc(folder / _POSES, T_body_camera)
    add_associated(frames, name, images, trajectory, MAX_STAMP_DIFFERENCE_NS)


def _read_camera(path: Path) -> tuple[Pinhole | None, Array]:
    """Return the intrinsics with the lens, and ``T_body_camera``, shape (4, 4), metres."""
    document = read_document(path, "T_BS")
    return pinhole(path, document, "distortion_coefficients"), read_body_camera(path)
