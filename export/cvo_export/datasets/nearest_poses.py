"""Associate images and poses by time stamp: each image gets the pose with the nearest stamp."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cvo_edge.trajectories.trajectory import LISTED_TWICE, Trajectory, nearest_stamp
from cvo_export.datasets.frames import FrameList


def add_associated(
    frames: FrameList,
    sequence: str,
    images: Sequence[tuple[int, Path]],
    trajectory: Trajectory[int],
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
    trajectory
        Poses by stamp.
    bound_ns
        Largest distance between the stamps of an image and its pose; images without a pose within
        it are left out and counted.
    """
    if repeated := trajectory.skipped.get(LISTED_TWICE):
        frames.skip(LISTED_TWICE, trajectory.skipped.first[LISTED_TWICE], repeated)
    for stamp_ns, image in sorted(images, key=lambda image: image[0]):
        nearest = nearest_stamp(trajectory.keys, stamp_ns, bound_ns)
        if nearest is None:
            frames.skip(f"no pose within {bound_ns / 1e9:g} s")
        else:
            where = trajectory.faults.get(nearest, "")
            frames.add(sequence, image.stem, image, trajectory.poses[nearest], stamp_ns, where)
