"""DSAC* and ACE (Brachmann et al. 2021, 2023): folders ``train`` and ``test``, one file an item.

``cvo_edge.trajectories.ace`` says which files belong together. A calibration is the focal length in
pixels, with the principal point in the middle of the image, or a 3x3 matrix.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from cvo_edge.errors import SourceError
from cvo_edge.input.image_files import frame_name
from cvo_edge.trajectories.ace import KINDS, PARTS, together
from cvo_export.datasets.base import Intrinsics, PoseDataset
from cvo_export.datasets.camera_matrices import matrix_intrinsics, read_numbers
from cvo_export.datasets.frames import FrameList

# Names of converted data sets: seq-03-frame-000000.color.png, seq1_frame00001.png.
_RECORDING = re.compile(r"(.+?)[-_.]*frame")
# Phones refocus, which changes the focal length from frame to frame.
_MOST_SPREAD = 0.01


def open_ace(path: str) -> PoseDataset:
    """Read a scene with ``train`` and ``test`` (or one of them), or a single such part.

    Frames of a part are one sequence, ``train`` or ``test``; if their names begin with a recording,
    e.g. ``seq-03-frame-000000``, each recording is one, ``train/seq-03``. Frames with an invalid
    pose are left out and counted. One camera is set, the median of the frames' calibrations if they
    differ by at most 1 %; ``chosen`` says so.

    Raises SourceError if the folders hold different numbers of files or files of different frames,
    a calibration is malformed, the calibrations differ by more, or no frame has a pose.
    """
    root = Path(path)
    parts = {part: root / part for part in PARTS if (root / part / KINDS[0]).is_dir()}
    if not parts and (root / KINDS[0]).is_dir():
        parts = {root.resolve().name: root}
    if not parts:
        raise SourceError(f"{root}: expected folders train/rgb or test/rgb, or rgb, found none")
    frames = FrameList(root)
    calibrations: list[Path] = []
    for part, folder in parts.items():
        for image, pose_file, calibration in together(folder):
            name = frame_name(image.name)
            recording = _RECORDING.match(name)
            sequence = f"{part}/{recording[1]}" if recording else part
            frames.add_matrix(sequence, name, image, pose_file)
            calibrations.append(calibration)
    dataset = frames.dataset(root.resolve().name)
    intrinsics, chosen = _camera(calibrations, dataset)
    own = [
        frozenset(
            index
            for index, name in enumerate(dataset.sequence_names)
            if name.partition("/")[0] == part
        )
        for part in PARTS
    ]
    return replace(dataset, intrinsics=intrinsics, chosen=chosen, own_train=own[0], own_test=own[1])


def _camera(calibrations: list[Path], dataset: PoseDataset) -> tuple[Intrinsics, str]:
    """Return the camera of all frames, and what is to be said of it."""
    height, width = dataset.read_image(0).shape[:2]
    cameras = np.array([_intrinsics(path, (width, height)) for path in calibrations])
    median = np.median(cameras, axis=0)
    focal_px = cameras[:, 0]
    least, most = calibrations[int(focal_px.argmin())], calibrations[int(focal_px.argmax())]
    spread = np.abs(cameras / median - 1.0).max()
    lengths = f"focal lengths {focal_px.min():.1f} to {focal_px.max():.1f} px"
    if spread > _MOST_SPREAD:
        raise SourceError(
            f"{least.parent}: expected calibrations of one camera, within {_MOST_SPREAD:.0%}, "
            f"found {lengths} in {least.name} and {most.name}; leave the frames of other cameras "
            "out"
        )
    return Intrinsics(*median.tolist()), f"the median of {lengths}" if spread else ""


def _intrinsics(path: Path, size: tuple[int, int]) -> Intrinsics:
    values = read_numbers(path, (1, 9), "a focal length or the nine numbers of a 3x3 matrix")
    if len(values) == 1:
        focal_px, (width, height) = values[0], size
        values = [focal_px, 0.0, width / 2, 0.0, focal_px, height / 2, 0.0, 0.0, 1.0]
    return matrix_intrinsics(str(path), values)
