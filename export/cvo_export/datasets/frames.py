"""Collect frames for a data set: keep those with an image and a pose, count the others."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.input.decoding import decode_image, image_size
from cvo_edge.input.image_files import frame_name, images_in
from cvo_edge.trajectories.poses import pose_matrix_fault, read_pose_matrix
from cvo_edge.trajectories.trajectory import LISTED_TWICE, Skipped, Trajectory
from cvo_edge.vocabulary import Decode
from cvo_export.datasets.base import PoseDataset

Array = NDArray[np.float64]

# Bytes that hold the header of most images, but not of a JPEG, which must be whole.
_HEADER = 4096


class FrameList:
    """The frames that a reader collects, sequence by sequence and in time order."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._images: list[Path] = []
        self._poses: list[Array] = []
        self._sequence: list[int] = []
        self._stamps_ns: list[int | None] = []
        # Dictionaries keep insertion order, which numbers the sequences.
        self._sequence_names: dict[str, int] = {}
        self._frame_names: dict[str, None] = {}
        self._skipped = Skipped()
        self._left_out: Counter[str] = Counter()

    def colour_images(self, folder: Path) -> list[Path]:
        """Return the colour images of a folder, as the runtime chooses them; count the others."""
        listing = images_in(folder)
        self._left_out.update(listing.left_out)
        return listing.images

    def add(
        self,
        sequence: str,
        name: str,
        image: Path,
        pose: Array | None,
        stamp_ns: int | None = None,
        where: str = "",
    ) -> None:
        """Add a frame with its ``T_world_camera`` (7,), or count it as skipped.

        A pose of None is invalid, for the reason and at the place that ``where`` states; a stamp of
        None is unknown. A sequence appears only if at least
        one of its frames is kept.
        """
        frame = f"{sequence}/{name}"
        if pose is None:
            self.skip("invalid pose", where)
        elif not os.path.isfile(image):  # noqa: PTH113 - also of a name too long
            self.skip("image missing")
        elif frame in self._frame_names:
            self.skip(LISTED_TWICE)
        else:
            number = self._sequence_names.setdefault(sequence, len(self._sequence_names))
            self._frame_names[frame] = None
            self._images.append(image)
            self._poses.append(pose)
            self._sequence.append(number)
            self._stamps_ns.append(stamp_ns)

    def add_matrix(self, sequence: str, name: str, image: Path, pose_file: Path) -> None:
        """Add a frame with the 4x4 matrix of a file, or count it as skipped."""
        if not pose_file.is_file():
            self.skip("no pose file")
            return
        pose = read_pose_matrix(pose_file)
        where = "" if pose is not None else f"{pose_file.name}: {pose_matrix_fault(pose_file)}"
        self.add(sequence, name, image, pose, where=where)

    def add_numbered(
        self,
        sequence: str,
        images: Mapping[int, Path],
        trajectory: Trajectory[int],
        stamps_ns: Sequence[int] = (),
    ) -> None:
        """Add images with poses (and stamps) of the same number; skip those without a partner.

        The trajectory has poses 0, 1, ... without a gap.
        """
        poses = trajectory.poses
        for number in sorted(images.keys() | range(len(poses))):
            if number not in images:
                self.skip("image missing")
            elif number >= len(poses):
                self.skip("no pose")
            else:
                image = images[number]
                stamp_ns = stamps_ns[number] if number < len(stamps_ns) else None
                where = trajectory.faults.get(number, "")
                self.add(sequence, frame_name(image.name), image, poses[number], stamp_ns, where)

    def skip(self, reason: str, where: str = "", count: int = 1) -> None:
        """Count skipped frames; ``where`` is the place of the reason, if it has one."""
        self._skipped.add(reason, where, count)

    def dataset(self, name: str) -> PoseDataset:
        """Return the data set of the kept frames; raises SourceError if there are none."""
        if not self._images:
            skipped = f"; {self._skipped}" if self._skipped else ""
            raise SourceError(f"{self._root}: expected frames with a pose, found none{skipped}")
        return PoseDataset(
            name=name,
            poses=np.array(self._poses),
            sequence=np.array(self._sequence),
            sequence_names=tuple(self._sequence_names),
            frame_names=tuple(self._frame_names),
            read_image=image_reader(self._images),
            read_half=image_reader(self._images, "half"),
            image_size=partial(_size_of, tuple(self._images)),
            skipped=self._skipped,
            left_out=dict(self._left_out),
            stamps_ns=None if None in self._stamps_ns else np.array(self._stamps_ns, np.int64),
        )


# Bits that the camera fills in images of 16 bits, while a data set is opened.
BITS: ContextVar[int] = ContextVar("bits", default=16)


def image_reader(
    paths: Sequence[Path], decode: Decode = "full"
) -> Callable[[int], NDArray[np.uint8]]:
    """Return a ``read_image`` for image files; colour and grey images are read as BGR."""
    bits = BITS.get()

    def read_image(index: int) -> NDArray[np.uint8]:
        path = paths[index]
        try:
            image = decode_image(path.read_bytes(), bits, decode)
        except OSError as error:
            raise SourceError(
                f"{path}: expected an image; the file cannot be read: {error.strerror}"
            ) from None
        if image is None:
            kind = "an image" if decode == "full" else "a JPEG image"
            raise SourceError(f"{path}: expected {kind}, found a damaged or incomplete file")
        return image

    return read_image


def _size_of(paths: Sequence[Path], index: int) -> tuple[int, int] | None:
    """Return height and width in the header of an image file, or None."""
    try:
        with paths[index].open("rb") as stream:
            start = stream.read(_HEADER)
            return image_size(start) or image_size(start + stream.read())
    except OSError:
        return None
