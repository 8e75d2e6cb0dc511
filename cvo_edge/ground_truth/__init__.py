"""Ground-truth poses from files, matched with the frames of a run."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.estimate import PoseInterval
from cvo_edge.ground_truth.bags import bag_options
from cvo_edge.ground_truth.detect import find_poses
from cvo_edge.ground_truth.found import Found, Key
from cvo_edge.input.image_files import frame_name
from cvo_edge.trajectories.trajectory import Skipped

Array = NDArray[np.float64]

# Digits of a frame's number; longer names are stamps.
_LONGEST = 10


@dataclass(frozen=True)
class GroundTruth:
    """True poses for comparison with estimates; see ``open_ground_truth``."""

    found: Found

    def pose_of(self, estimate: PoseInterval) -> Array | None:
        """Return the true ``T_world_camera`` (7,) of an estimate's frame, or None."""
        key = self.key_of(estimate)
        return None if key is None else self.found.at(key)

    def key_of(self, estimate: PoseInterval) -> Key | None:
        """Return what a pose must have in common with an estimate's frame; None if it is unknown.

        This is the stamp in nanoseconds, the name, or the number: that which is the file's name, as
        in KITTI, or else the place in the source, from 0.
        """
        if self.found.by == "stamp":
            return estimate.stamp_ns
        name = frame_name(estimate.source)
        if self.found.by == "name":
            return name
        return int(name) if name.isdecimal() and len(name) < _LONGEST else estimate.seq

    @property
    def skipped(self) -> Skipped:
        """What the file holds without giving a pose."""
        return self.found.skipped

    def spans(self, first: Key | None, last: Key | None) -> str:
        """Return the keys of frames, given the first and the last one, beside those of the poses.

        None means that the frames have no keys.
        """
        poses = f"poses {self._span(self.found.first, self.found.last)}"
        if first is None or last is None:
            return f"frames without a stamp, {poses}; --stamps or --fps stamps frames"
        return f"frames {self._span(first, last)}, {poses}"

    def _span(self, first: Key, last: Key) -> str:
        if self.found.by == "stamp":
            return f"at {int(first) / 1e9:.3f} .. {int(last) / 1e9:.3f} s"
        return f"{first} .. {last}"


def named_files(path: str | None) -> list[Path]:
    """Return the files and folders that a value of ``open_ground_truth`` names."""
    if path is None:
        return []
    place, options = bag_options(path) or (Path(path), {})
    return [place, *(Path(options[name]) for name in options.keys() & {"extrinsics"})]


def open_ground_truth(
    path: str | os.PathLike[str], source: str | os.PathLike[str] = ""
) -> GroundTruth:
    """Read true poses in any format of ``cvo_edge.ground_truth.detect``.

    Parameters
    ----------
    path
        File or folder; for a ROS bag also ``rosbag:PATH,option=value...``, as in training.
    source
        Folder, glob or file of the frames, whose place in a recording says which camera's or which
        part's poses are wanted.

    Raises SourceError if the format is unknown, a file is malformed, what leads to the camera is
    missing, or no pose is valid; UsageError for unknown options, and for a bag if the library
    ``rosbags`` is not installed.
    """
    # The names of the folders above count, also of `.`.
    given = Path(source).absolute()
    folder = os.path.isdir(source)  # noqa: PTH112 - also of a name too long
    return GroundTruth(find_poses(os.fspath(path), given if folder else given.parent))
