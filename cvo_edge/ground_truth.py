"""Ground-truth poses from files, matched with the frames of a run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.estimate import PoseInterval
from cvo_edge.input.image_files import frame_name
from cvo_edge.trajectories.poses import MATRIX_SUFFIX, read_pose_matrices
from cvo_edge.trajectories.trajectory import Skipped, Trajectory, nearest_stamp
from cvo_edge.trajectories.tum import MAX_STAMP_DIFFERENCE_NS, read_tum

Array = NDArray[np.float64]
Key = int | str


@dataclass(frozen=True)
class GroundTruth:
    """True poses for comparison with estimates; see ``open_ground_truth``.

    Attributes
    ----------
    path
        What was read.
    by
        Whether the keys of ``trajectory`` are the stamps of frames or their names.
    trajectory
        The poses ``T_world_camera``.
    bound_ns
        Largest difference between the stamps of a frame and its pose.
    """

    path: Path
    by: Literal["stamp", "name"]
    trajectory: Trajectory[Any]
    bound_ns: int = MAX_STAMP_DIFFERENCE_NS

    def pose_of(self, estimate: PoseInterval) -> Array | None:
        """Return the true ``T_world_camera`` (7,) of an estimate's frame, or None."""
        key = self.key_of(estimate)
        if key is None:
            return None
        if self.by == "stamp":
            index = nearest_stamp(self.trajectory.keys, int(key), self.bound_ns)
        else:
            index = self._index.get(key)
        return None if index is None else self.trajectory.poses[index]

    def key_of(self, estimate: PoseInterval) -> Key | None:
        """Return what a pose must have in common with an estimate's frame; None if it is unknown.

        This is the stamp in nanoseconds, or the name.
        """
        return estimate.stamp_ns if self.by == "stamp" else frame_name(estimate.source)

    @property
    def skipped(self) -> Skipped:
        """What the file holds without giving a pose."""
        return self.trajectory.skipped

    def spans(self, first: Key | None, last: Key | None) -> str:
        """Return the keys of frames, given the first and the last one, beside those of the poses.

        None means that the frames have no keys.
        """
        keys = self.trajectory.keys
        poses = f"poses {_span(self.by, keys[0], keys[-1])}"
        if first is None or last is None:
            return f"frames without a {self.by}, {poses}"
        return f"frames {_span(self.by, first, last)}, {poses}"

    @cached_property
    def _index(self) -> dict[Key, int]:
        return {key: index for index, key in enumerate(self.trajectory.keys)}


def open_ground_truth(path: Path) -> GroundTruth:
    """Read a folder of ``<frame>.pose.txt`` (matched by name) or a TUM file (matched by stamp).

    Raises SourceError if there is no valid pose.
    """
    if not path.exists():
        raise SourceError(
            f"{path}: no such file; expected a TUM trajectory or a folder of *{MATRIX_SUFFIX}"
        )
    if path.is_dir():
        return GroundTruth(path, "name", read_pose_matrices(path))
    return GroundTruth(path, "stamp", read_tum(path))


def _span(by: str, first: Key, last: Key) -> str:
    if by == "stamp":
        return f"at {int(first) / 1e9:.3f} .. {int(last) / 1e9:.3f} s"
    return f"{first} .. {last}"
