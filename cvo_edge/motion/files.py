"""Read trajectories of estimators and ground truths from files.

============  ====================================================================================
format        lines
============  ====================================================================================
``tum``       ``timestamp tx ty tz qx qy qz qw``; more columns need a line ``# timestamp tx ...``
              before them that names every one
``openvins``  the same with ``Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 Pt11 Pt12 Pt13 Pt22 Pt23 Pt33``: the
              upper triangles of the covariances of rotation and position (ov_eval)
``euroc``     ``timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z,...``: integer nanoseconds
``kitti``     the twelve numbers of a 3x4 matrix, one line a frame
============  ====================================================================================

Poses are those of the body that the file tracks. KITTI files have no times: a list of times in
seconds, one a line (``times.txt``), or a rate gives them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.trajectories import euroc, kitti, tum
from cvo_edge.trajectories.tables import first_line, read_rows, read_text
from cvo_edge.trajectories.trajectory import Trajectory
from cvo_edge.vocabulary import TrajectoryFormat

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_COVARIANCES = "Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 Pt11 Pt12 Pt13 Pt22 Pt23 Pt33"
OPENVINS_FORM = f"{tum.FORM} {_COVARIANCES}"
_WIDTHS: dict[int, TrajectoryFormat] = {
    len(tum.FORM.split()): "tum",
    len(OPENVINS_FORM.split()): "openvins",
    len(kitti.FORM.split()): "kitti",
}
_FORMS = (
    f"tum ({tum.FORM}), openvins (20 columns), kitti (12 numbers) or euroc (columns with commas)"
)
# Steps without a scale are rounded to a few digits.
_LEAST_STEP, _STEP_TOLERANCE = 1e-6, 0.05
# Deviations of position and rotation by OpenVINS' covariances: names of columns to scale by.
_DEVIATIONS = ("position_deviation", "rotation_deviation")


class Poses(NamedTuple):
    """Poses with stamps.

    Attributes
    ----------
    path
        Where they were read.
    stamps_ns, poses
        Shape (n,), ascending, and (n, 7): ``T_world_body``; NaN where the pose is invalid.
    columns
        Shape (n,) each: other columns by name.
    skipped
        What the file holds without giving a pose, as text.
    timed
        Whether the stamps were given, as the file has none.
    unscaled
        Whether steps have no length, by a comment ``# scale: none``; see ``direction``.
    """

    path: Path
    stamps_ns: Integers
    poses: Array
    columns: dict[str, Array]
    skipped: str
    timed: bool
    unscaled: bool = False


@dataclass(frozen=True, eq=False)
class PoseFile:
    """The poses of a file.

    Attributes
    ----------
    path, format
        Where they were read.
    own_stamps_ns
        Shape (n,), ascending; None for a file without times.
    poses
        Shape (n, 7): ``T_world_body``; NaN where the file's pose is invalid.
    columns
        Shape (n,) each: other columns by name.
    skipped
        What the file holds without giving a pose, as text.
    unscaled
        As for ``Poses``.
    """

    path: Path
    format: TrajectoryFormat
    own_stamps_ns: Integers | None
    poses: Array
    columns: dict[str, Array]
    skipped: str
    unscaled: bool = False

    def stamped(self, times: Path | None = None, fps: float | None = None) -> Poses:
        """Return the poses with stamps, from a list or a rate if the file has none of its own.

        Raises SourceError if the list does not fit, and UsageError if none is given.
        """
        stamps = self._stamps(times, fps)
        timed = self.own_stamps_ns is None
        return Poses(
            self.path, stamps, self.poses, self.columns, self.skipped, timed, self.unscaled
        )

    def _stamps(self, times: Path | None, fps: float | None) -> Integers:
        if self.own_stamps_ns is not None:
            return self.own_stamps_ns
        n = len(self.poses)
        if times is not None:
            rows = read_rows(times, "time")
            stamps = np.array([row.seconds() for row in rows], np.int64)
            if len(stamps) != n:
                raise SourceError(
                    f"{times}: expected a time for each of {n} poses of {self.path}, found "
                    f"{len(stamps)}"
                )
            if (np.diff(stamps) <= 0).any():
                line = rows[int(np.argmax(np.diff(stamps) <= 0)) + 1].number
                raise SourceError(
                    f"{times}: expected ascending times, found another in line {line}"
                )
            return stamps
        if fps is None:
            raise UsageError(
                f"{self.path}: expected --times FILE or --fps for poses without times "
                f"({self.format}), found neither"
            )
        return np.asarray(np.rint(np.arange(n) * (1e9 / fps)).astype(np.int64))


def read_poses(path: Path, format: TrajectoryFormat | None = None) -> PoseFile:
    """Read a file in a format, or in the one that its first line shows.

    Raises SourceError if the file cannot be read, is of none of these formats, has a malformed
    line, or has no valid pose.
    """
    number, line = first_line(read_text(path, _FORMS))
    if not line:
        raise SourceError(f"{path}: expected poses: {_FORMS}, found no line")
    found = format or _format(path, line)
    if found is None:
        raise SourceError(
            f"{path}: expected {_FORMS}, found {len(line.split())} columns in line {number}: "
            f"{line[:80]!r}"
        )
    if found == "euroc":
        return _read(path, found, euroc.read_euroc(path, np.eye(4)), {})
    if found == "kitti":
        return _read(path, found, kitti.read_kitti(path, np.eye(4)), {})
    names = OPENVINS_FORM.split() if found == "openvins" else (_named(path) or tum.FORM.split())
    trajectory, others = tum.read_tum_columns(path, " ".join(names))
    columns = dict(zip(names[len(tum.FORM.split()) :], others.T, strict=True))
    if found == "openvins":
        columns = _deviations(columns)
    read = _read(path, found, trajectory, columns)
    unscaled = any(map(says_unscaled, _comments(path)))
    if unscaled:
        _check_steps(path, read.poses)
    return replace(read, unscaled=unscaled)


def _format(path: Path, line: str) -> TrajectoryFormat | None:
    if "," in line:
        return "euroc"
    return "tum" if _named(path) else _WIDTHS.get(len(line.split()))


def _named(path: Path) -> list[str]:
    """Return the names of more columns than TUM's, from the comment before the first row."""
    names: list[str] = []
    for line in _comments(path):
        names = tum_names(line) or names
    return names if " ".join(names) != OPENVINS_FORM else []


def _comments(path: Path) -> Iterator[str]:
    """Yield the lines before the first row."""
    for line in read_text(path, _FORMS).splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            return
        yield line


def says_unscaled(comment: str) -> bool:
    """Whether a comment says that steps have no length: ``# scale: none``."""
    words = comment.lstrip(" #").replace(",", " ").split()
    return words[:2] == ["scale:", "none"]


def _check_steps(path: Path, poses: Array) -> None:
    """Raise SourceError for poses (n, 7) without a scale whose usual step is not of length 1."""
    steps = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    steps = steps[steps > _LEAST_STEP]
    usual = float(np.median(steps)) if len(steps) else 1.0
    if abs(usual - 1.0) > _STEP_TOLERANCE:
        raise SourceError(
            f"{path}: expected steps of length 1, or 0 without a direction, after # scale: none, "
            f"found a median of {usual:.3g}; divide each step by its length"
        )


def tum_names(comment: str) -> list[str]:
    """Return the names of all columns of a comment that names more than TUM's; else none."""
    names = comment.replace("timestamp(s)", "timestamp").lstrip(" #").split()
    fixed = tum.FORM.split()
    return names if len(names) > len(fixed) and names[: len(fixed)] == fixed else []


def _deviations(columns: dict[str, Array]) -> dict[str, Array]:
    """Return the standard deviations that OpenVINS reports: square roots of the two traces."""
    variances = [
        sum(np.maximum(columns[f"P{half}{k}{k}"], 0.0) for k in (1, 2, 3)) for half in ("t", "r")
    ]
    return dict(zip(_DEVIATIONS, map(np.sqrt, variances), strict=True))


def _read(
    path: Path, format: TrajectoryFormat, trajectory: Trajectory[int], columns: dict[str, Array]
) -> PoseFile:
    missing = np.full(7, np.nan)
    poses = np.array([missing if pose is None else pose for pose in trajectory.poses])
    stamps = None if format == "kitti" else np.array(trajectory.keys, np.int64)
    return PoseFile(path, format, stamps, poses, columns, str(trajectory.skipped))
