"""Frames as a reader finds them: those with an image and a pose are kept, the others counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.input.decoding import decode_image
from cvo_export.datasets.base import PoseDataset, skipped_text

Array = NDArray[np.float64]


class FrameList:
    """What a reader gathers, sequence by sequence and in time order within each."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._images: list[Path] = []
        self._poses: list[Array] = []
        self._sequence: list[int] = []
        # Dictionaries for their order: the number of a sequence is its place.
        self._sequence_names: dict[str, int] = {}
        self._frame_names: dict[str, None] = {}
        self._skipped: Counter[str] = Counter()

    def add(self, sequence: str, name: str, image: Path, pose: Array | None) -> None:
        """Keep a frame with its ``T_world_camera`` (7,), or count why it is left out.

        None stands for an invalid pose; a sequence without a frame does not appear.
        """
        frame = f"{sequence}/{name}"
        if pose is None:
            self.skip("invalid pose")
        elif not image.is_file():
            self.skip("image missing")
        elif frame in self._frame_names:
            self.skip("listed twice")
        else:
            number = self._sequence_names.setdefault(sequence, len(self._sequence_names))
            self._frame_names[frame] = None
            self._images.append(image)
            self._poses.append(pose)
            self._sequence.append(number)

    def add_numbered(
        self, sequence: str, images: Mapping[int, Path], poses: Sequence[Array | None]
    ) -> None:
        """Frame i has the pose i, counted from 0; what has no counterpart is left out."""
        for number in sorted(images.keys() | range(len(poses))):
            if number not in images:
                self.skip("image missing")
            elif number >= len(poses):
                self.skip("no pose")
            else:
                image = images[number]
                self.add(sequence, image.stem.removesuffix("-color"), image, poses[number])

    def skip(self, reason: str) -> None:
        """Count a frame that is left out."""
        self._skipped[reason] += 1

    def dataset(self, name: str) -> PoseDataset:
        """Return what was kept; raises SourceError where that is nothing."""
        if not self._images:
            skipped = f"; {skipped_text(self._skipped)}" if self._skipped else ""
            raise SourceError(f"{self._root}: expected frames with a pose, found none{skipped}")
        return PoseDataset(
            name=name,
            poses=np.array(self._poses),
            sequence=np.array(self._sequence),
            sequence_names=tuple(self._sequence_names),
            frame_names=tuple(self._frame_names),
            read_image=image_reader(self._images),
            skipped=dict(self._skipped),
        )


def image_reader(paths: Sequence[Path]) -> Callable[[int], NDArray[np.uint8]]:
    """Return the ``read_image`` of a data set of image files, colour or grey, all as BGR."""

    def read_image(index: int) -> NDArray[np.uint8]:
        path = paths[index]
        try:
            image = decode_image(path.read_bytes())
        except OSError as error:
            raise SourceError(
                f"{path}: expected an image, found that it cannot be read: {error.strerror}"
            ) from None
        if image is None:
            raise SourceError(f"{path}: expected a whole image, found a damaged one")
        return image

    return read_image
