"""7-Scenes (Shotton et al. 2013): ``seq-NN/frame-NNNNNN.color.png`` with ``.pose.txt``.

A pose file contains the 4x4 camera-to-world matrix in metres, for an OpenCV camera.
``TrainSplit.txt`` and ``TestSplit.txt`` list ``sequenceN``. A folder with the frames of a single
sequence can be read too.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from cvo_edge.errors import SinkError, SourceError
from cvo_edge.files import natural_key
from cvo_edge.input.image_files import frame_name
from cvo_edge.pose import Pose
from cvo_edge.trajectories.poses import MATRIX_SUFFIX
from cvo_export.datasets.base import Intrinsics, PoseDataset
from cvo_export.datasets.camera_matrices import matrix_intrinsics, read_numbers
from cvo_export.datasets.frames import FrameList

# Files of a scene of 12-Scenes, whose frames have the same names.
_TWELVE_SCENES = ("info.txt", "split.txt")

# The Kinect's nominal focal length at 640x480, as stated by the data set's authors.
_NOMINAL_FOCAL_PX, _NOMINAL_WIDTH = 585.0, 640


def open_seven_scenes(path: str) -> PoseDataset:
    """Read a scene folder with ``seq-NN`` folders, or a single ``seq-NN`` folder.

    Frames with a missing pose file or an invalid pose (lost tracking) are left out and counted.
    Intrinsics come from ``camera-intrinsics.txt`` (a 3x3 matrix) if it exists, otherwise from the
    data set's nominal focal length, scaled to the images' width.

    Raises SourceError if no frame has a pose, or for a scene of 12-Scenes.
    """
    root = Path(path)
    if not root.is_dir():
        raise SourceError(f"{root}: expected a 7-Scenes folder, found no folder")
    folders = sorted(root.glob("seq-*"), key=natural_key)
    folders = [folder for folder in folders if folder.is_dir()] or [root]
    for scene in (root, root.absolute().parent):
        if folders == [root] and all((scene / name).is_file() for name in _TWELVE_SCENES):
            raise SourceError(
                f"{root}: expected a 7-Scenes folder, found {' and '.join(_TWELVE_SCENES)} of "
                f"12-Scenes in {scene}; read it as 12scenes:{scene}"
            )
    frames = FrameList(root)
    for folder in folders:
        for image in frames.colour_images(folder):
            name = frame_name(image.name)
            frames.add_matrix(folder.name, name, image, folder / (name + MATRIX_SUFFIX))
    dataset = frames.dataset(root.resolve().name)
    return replace(
        dataset,
        intrinsics=_intrinsics(root, dataset.read_image(0).shape),
        own_train=_own_list(root / "TrainSplit.txt", dataset.sequence_names),
        own_test=_own_list(root / "TestSplit.txt", dataset.sequence_names),
    )


def write_sequence(dataset: PoseDataset, sequence: int, folder: Path, frames: int | None) -> int:
    """Write the first ``frames`` frames of a sequence in this layout and return their number.

    Images are JPEG files of quality 92. Raises SinkError if the folder exists or cannot be written.
    """
    indices = np.flatnonzero(dataset.sequence == sequence)[:frames]
    try:
        folder.mkdir(parents=True)
        for number, index in enumerate(indices.tolist()):
            stem = f"frame-{number:06d}"
            image = dataset.read_image(index)
            encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
            (folder / f"{stem}.color.jpg").write_bytes(encoded.tobytes())
            matrix = Pose.from_array(dataset.poses[index]).to_matrix()
            rows = "\n".join("\t".join(f"{value:.9e}" for value in row) for row in matrix)
            (folder / (stem + MATRIX_SUFFIX)).write_text(rows + "\n", "ascii")
    except FileExistsError:
        raise SinkError(f"{folder}: expected a new folder, found an existing one") from None
    except OSError as error:
        raise SinkError(f"{folder}: cannot be written: {error.strerror}") from None
    return int(indices.size)


def _own_list(path: Path, names: tuple[str, ...]) -> frozenset[int]:
    """Return the indices of the sequences on disk that a split file lists."""
    if not path.is_file():
        return frozenset()
    numbers = {int(number) for number in re.findall(r"\d+", path.read_text("utf-8-sig", "replace"))}
    return frozenset(
        index
        for index, name in enumerate(names)
        if re.fullmatch("seq-[0-9]+", name) and int(name.removeprefix("seq-")) in numbers
    )


def _intrinsics(root: Path, shape: tuple[int, ...]) -> Intrinsics:
    height, width = shape[:2]
    path = root / "camera-intrinsics.txt"
    if not path.is_file():
        focal = _NOMINAL_FOCAL_PX * width / _NOMINAL_WIDTH
        return Intrinsics(focal, focal, width / 2, height / 2)
    return matrix_intrinsics(
        str(path), read_numbers(path, (9,), "the nine numbers of a 3x3 matrix")
    )
