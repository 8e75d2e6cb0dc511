"""Associate images and poses by time stamp: each image gets the pose with the nearest stamp."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.ground_truth import nearest_stamp
from cvo_export.datasets.frames import FrameList

Array = NDArray[np.float64]


def add_associated(
    frames: FrameList,
    sequence: str,
    images: Sequence[tuple[int, Path]],
    stamps_ns: Sequence[int],
    pose_of: Callable[[int], Array | None],
    bound_ns: int,
) -> None:
    """Add a sequence to ``frames``, in the order of its images' stamps.

    Parameters
    ----------
    frames
        The list to add to.
    sequence
        Name of the sequence.
    images
        Stamp in nanoseconds and file of each image.
    stamps_ns
        Stamps of the poses, in any order.
    pose_of
        Maps an index in ``stamps_ns`` to the pose (7,), or None if it is invalid.
    bound_ns
        Largest distance between the stamps of an image and its pose; images without a pose within
        it are left out and counted.
    """
    order = sorted(range(len(stamps_ns)), key=stamps_ns.__getitem__)
    ascending = [stamps_ns[place] for place in order]
    for stamp_ns, image in sorted(images, key=lambda image: image[0]):
        nearest = nearest_stamp(ascending, stamp_ns, bound_ns)
        if nearest is None:
            frames.skip(f"no pose within {bound_ns / 1e9:g} s")
        else:
            frames.add(sequence, image.stem, image, pose_of(order[nearest]), stamp_ns)
