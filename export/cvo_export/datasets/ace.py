"""DSAC* and ACE (Brachmann et al. 2021, 2023): folders ``train`` and ``test``, one file an item.

In each, ``rgb``, ``poses`` and ``calibration`` hold one file a frame, in the same sorted order. A
pose is the 4x4 camera-to-world matrix in metres, for an OpenCV camera. A calibration is the focal
length in pixels, with the principal point in the middle of the image, or a 3x3 matrix.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from cvo_edge.errors import SourceError
from cvo_edge.input.image_files import frame_name, natural_key
from cvo_export.datasets.base import Intrinsics, PoseDataset
from cvo_export.datasets.camera_matrices import matrix_intrinsics, read_numbers
from cvo_export.datasets.frames import FrameList

_PARTS = ("train", "test")
_KINDS = ("rgb", "poses", "calibration")
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
    parts = {part: root / part for part in _PARTS if (root / part / _KINDS[0]).is_dir()}
    if not parts and (root / _KINDS[0]).is_dir():
        parts = {root.resolve().name: root}
    if not parts:
        raise SourceError(f"{root}: expected folders train/rgb or test/rgb, or rgb, found none")
    frames = FrameList(root)
    calibrations: list[Path] = []
    for part, folder in parts.items():
        for image, pose_file, calibration in _together(folder):
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
        for part in _PARTS
    ]
    return replace(dataset, intrinsics=intrinsics, chosen=chosen, own_train=own[0], own_test=own[1])


def _together(folder: Path) -> list[tuple[Path, Path, Path]]:
    """Return image, pose and calibration of each frame, in natural order of the images."""
    found = [_files(folder / kind) for kind in _KINDS]
    images, *others = found
    for kind, files in zip(_KINDS[1:], others, strict=True):
        if len(files) != len(images):
            raise SourceError(
                f"{folder}: expected as many files in {kind} as in rgb, found {len(files)} and "
                f"{len(images)}; delete what is left over of incomplete frames"
            )
        numbers = {_numbers(file) for file in files}
        for image, file in zip(images, files, strict=True):
            # Names may differ in everything, but not if the number stands at another place.
            if _numbers(image) != _numbers(file) and _numbers(image) in numbers:
                raise SourceError(
                    f"{folder}: expected files of one frame at the same place of the sorted names, "
                    f"found rgb/{image.name} and {kind}/{file.name}; delete incomplete frames"
                )
    return sorted(zip(*found, strict=True), key=lambda files: natural_key(files[0]))


def _files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise SourceError(f"{folder}: expected a folder with one file a frame, found none")
    return sorted(file for file in folder.iterdir() if not file.name.startswith("."))


def _numbers(file: Path) -> tuple[str, ...]:
    return tuple(re.findall(r"\d+", file.name.partition(".")[0]))


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
