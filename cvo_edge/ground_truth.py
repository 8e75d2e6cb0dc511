"""Ground-truth poses from files: 7-Scenes ``.pose.txt`` folders and TUM trajectories."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.errors import SourceError
from cvo_edge.estimate import PoseInterval
from cvo_edge.files import read_regular_file
from cvo_edge.input.image_files import frame_name

Array = NDArray[np.float64]

MATRIX_SUFFIX = ".pose.txt"

# Frames match the nearest ground-truth stamp within this bound, as in the TUM tools.
MAX_STAMP_DIFFERENCE_NS = 20_000_000

_MAX_BYTES, _MAX_MATRIX_BYTES = 256 << 20, 1 << 16


def read_pose_matrix(path: Path) -> Array | None:
    """Read a 4x4 camera-to-world matrix in metres -> pose (7,), or None if it is invalid.

    Recordings mark lost tracking by files without 16 numbers or with an invalid matrix (see
    ``matrix_to_pose``).
    """
    try:
        content = read_regular_file(path, _MAX_MATRIX_BYTES, SourceError, links=True)
        T = np.array(content.decode("ascii").split(), dtype=np.float64)
    except (SourceError, ValueError):
        return None
    return matrix_to_pose(T.reshape(4, 4)) if T.size == 16 else None


def matrix_to_pose(T: Array) -> Array | None:
    """Homogeneous matrix (4, 4) in metres -> pose (7,), or None if it is invalid.

    The rotation is made orthonormal (recorded ones deviate by up to 4e-4). A matrix is invalid if
    it is not finite or its rotation part is more than 0.01 away from a rotation.
    """
    if not np.isfinite(T).all():
        return None
    R = geometry.nearest_rotation(T[:3, :3])
    if np.abs(R - T[:3, :3]).max() > 0.01 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        return None
    return np.concatenate([T[:3, 3], geometry.matrix_to_quaternion(R)])


def seconds_to_ns(text: str) -> int:
    """Decimal seconds as text -> integer nanoseconds; raises ValueError if it is not a number."""
    seconds, _, fraction = text.partition(".")
    if seconds.isdecimal() and (fraction.isdecimal() or not fraction):
        # A double resolves present-day stamps only to 200 ns, so the digits are parsed.
        return int(seconds) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))
    try:
        return round(float(text) * 1e9)
    except OverflowError:
        raise ValueError(text) from None


def nearest_stamp(stamps_ns: Sequence[int], stamp_ns: int, bound_ns: int) -> int | None:
    """Return the index of the nearest ascending stamp (the earlier of two), None if too far."""
    right = bisect_left(stamps_ns, stamp_ns)
    nearest = min(
        range(max(0, right - 1), min(right + 1, len(stamps_ns))),
        key=lambda index: abs(stamps_ns[index] - stamp_ns),
        default=None,
    )
    if nearest is None or abs(stamps_ns[nearest] - stamp_ns) > bound_ns:
        return None
    return nearest


class GroundTruth:
    """True poses for comparison with estimates; see ``open_ground_truth``."""

    def __init__(self, by_name: dict[str, Array], stamps_ns: list[int], poses: list[Array]) -> None:
        self._by_name = by_name
        self._stamps_ns = stamps_ns
        self._poses = poses

    def pose_of(self, estimate: PoseInterval) -> Array | None:
        """Return the true ``T_world_camera`` (7,) of an estimate's frame, or None."""
        if self._by_name:
            return self._by_name.get(frame_name(estimate.source))
        if estimate.stamp_ns is None:
            return None
        nearest = nearest_stamp(self._stamps_ns, estimate.stamp_ns, MAX_STAMP_DIFFERENCE_NS)
        return None if nearest is None else self._poses[nearest]


def open_ground_truth(path: Path) -> GroundTruth:
    """Read a folder of ``<frame>.pose.txt`` (matched by name) or a TUM file (matched by stamp).

    Raises SourceError if there is no valid pose.
    """
    if not path.exists():
        raise SourceError(
            f"{path}: no such file; expected a TUM trajectory or a folder of *{MATRIX_SUFFIX}"
        )
    if path.is_dir():
        found = {
            file.name.removesuffix(MATRIX_SUFFIX): read_pose_matrix(file)
            for file in sorted(path.glob("*" + MATRIX_SUFFIX))
        }
        by_name = {name: pose for name, pose in found.items() if pose is not None}
        if not by_name:
            raise SourceError(
                f"{path}: expected files *{MATRIX_SUFFIX} with a pose, found no valid file"
            )
        return GroundTruth(by_name, [], [])
    return GroundTruth({}, *_read_tum(path))


def _read_tum(path: Path) -> tuple[list[int], list[Array]]:
    try:
        content = read_regular_file(path, _MAX_BYTES, SourceError, links=True)
        lines = content.decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise SourceError(f"{path}: expected a TUM trajectory, found {error}") from None
    stamps: list[int] = []
    poses: list[Array] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = line.split()
        try:
            values = np.array(fields, dtype=np.float64)
            stamp = seconds_to_ns(fields[0])
        except ValueError:
            values = np.empty(0)
        if values.size != 8 or not np.isfinite(values).all() or not _is_rotation(values[4:]):
            raise SourceError(
                f"{path}: expected eight numbers stamp tx ty tz qx qy qz qw, found {line!r} "
                f"in line {number}"
            )
        if stamps and stamp <= stamps[-1]:
            raise SourceError(
                f"{path}: expected increasing stamps, found {fields[0]} in line {number}"
            )
        stamps.append(stamp)
        quaternion = geometry.quaternion_normalise(values[4:])
        poses.append(np.concatenate([values[1:4], quaternion]))
    if not stamps:
        raise SourceError(f"{path}: expected a TUM trajectory, found no poses")
    return stamps, poses


def _is_rotation(quaternion: Array) -> bool:
    """Whether a quaternion can be normalised."""
    with np.errstate(over="ignore"):
        return 0.0 < float(quaternion @ quaternion) < np.inf
