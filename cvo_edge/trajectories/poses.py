"""Convert numbers from files to poses, or to None if they are invalid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.errors import SourceError
from cvo_edge.files import read_regular_file
from cvo_edge.pose import Pose
from cvo_edge.trajectories.trajectory import Entry, Trajectory, trajectory_of

Array = NDArray[np.float64]

MATRIX_SUFFIX = ".pose.txt"
_MAX_MATRIX_BYTES = 1 << 16

# Files round quaternions and matrices to a few digits.
TOLERANCE = 0.01
_LAST_ROW = 1e-6
# Squares of quaternions that are divided by their norm are one up to this.
_UNIT = 1e-15
# Further away than the moon: no coordinates of a place. Networks' outputs have the same limit.
FARTHEST_M = 1e9


def quaternion_pose(position_m: Array, q_xyzw: Array) -> Array | None:
    """Return the pose (7,) of a position (3,), metres, and a quaternion (4,); unit, qw >= 0.

    Norms within 0.01 of 1 are normalised. Returns None for other norms, for numbers that are not
    finite and for positions of 1e9 m or more; ``quaternion_fault`` says which it is.
    """
    if quaternion_fault(position_m, q_xyzw) is not None:
        return None
    return np.concatenate([position_m, _unit(q_xyzw)])


def quaternion_poses(positions_m: Array, q_xyzw: Array) -> tuple[list[Array | None], list[str]]:
    """Do the same for positions (n, 3) and quaternions (n, 4); faults are "" for valid poses."""
    with np.errstate(all="ignore"):
        norms = np.linalg.norm(q_xyzw, axis=1)
        valid = (np.abs(norms - 1.0) <= TOLERANCE) & (np.abs(positions_m) < FARTHEST_M).all(axis=1)
        every = np.concatenate([positions_m, _unit(q_xyzw)], axis=1)
    poses = [pose if fine else None for pose, fine in zip(every, valid.tolist(), strict=True)]
    faults = [
        "" if fine else quaternion_fault(position_m, q) or ""
        for position_m, q, fine in zip(positions_m, q_xyzw, valid.tolist(), strict=True)
    ]
    return poses, faults


def _unit(q_xyzw: Array) -> Array:
    """Return quaternions (..., 4) as ``unit_quaternion``, to the last bit."""
    x, y, z, w = np.moveaxis(q_xyzw, -1, 0)
    square = x * x + y * y + z * z + w * w
    norm = np.where(np.abs(square - 1.0) <= _UNIT, 1.0, np.sqrt(square))
    return np.asarray(q_xyzw / (norm * np.where(w < 0.0, -1.0, 1.0))[..., np.newaxis])


def unit_quaternion(q_xyzw: Sequence[float]) -> tuple[float, float, float, float]:
    """Return a quaternion other than zero with a norm of one, qw >= 0.

    One whose norm is as near to one as rounding allows stays as it is, so that poses that were
    read before stay the same.
    """
    x, y, z, w = q_xyzw
    square = x * x + y * y + z * z + w * w
    norm = 1.0 if abs(square - 1.0) <= _UNIT else math.sqrt(square)
    norm = -norm if w < 0.0 else norm
    return x / norm, y / norm, z / norm, w / norm


def quaternion_fault(position_m: Array, q_xyzw: Array) -> str | None:
    """Return why a position and a quaternion are no pose, or None."""
    if not np.isfinite(q_xyzw).all():
        return "a number that is not finite"
    if (fault := _position_fault(position_m)) is not None:
        return fault
    with np.errstate(over="ignore"):
        norm = float(np.linalg.norm(q_xyzw))
    return None if abs(norm - 1.0) <= TOLERANCE else f"a quaternion of norm {norm:.3g}"


def _position_fault(position_m: Array) -> str | None:
    if not np.isfinite(position_m).all():
        return "a number that is not finite"
    most = float(np.abs(position_m).max())
    return None if most < FARTHEST_M else f"a position {most:.3g} m from the origin"


def camera_pose(pose: Array | None, T_body_camera: Array) -> Array | None:
    """Return ``T_world_camera`` (7,) from ``T_world_body`` (7,) and ``T_body_camera`` (4, 4)."""
    if pose is None:
        return None
    return Pose.from_matrix(Pose.from_array(pose).to_matrix() @ T_body_camera).to_array()


def matrix_to_pose(T: Array) -> Array | None:
    """Homogeneous matrix (4, 4) in metres -> pose (7,), or None if it is invalid.

    The rotation is made orthonormal (recorded ones deviate by up to 4e-4). A matrix is invalid if
    it is not finite, its position is 1e9 m or more away, or its rotation part is more than 0.01
    away from a rotation; ``matrix_fault`` says which it is.
    """
    if matrix_fault(T) is not None:
        return None
    R = geometry.nearest_rotation(T[:3, :3])
    return np.concatenate([T[:3, 3], geometry.matrix_to_quaternion(R)])


def matrices_to_poses(T: Array) -> tuple[list[Array | None], list[str]]:
    """Do the same for matrices (n, 4, 4); faults are "" for valid ones."""
    whole = np.asarray(np.isfinite(T).all(axis=(1, 2)))
    R = geometry.nearest_rotation(np.where(whole[:, np.newaxis, np.newaxis], T, 0.0)[:, :3, :3])
    every = np.concatenate([T[:, :3, 3], geometry.matrix_to_quaternion(R)], axis=1)
    with np.errstate(invalid="ignore"):
        off = np.abs(R - T[:, :3, :3]).max(axis=(1, 2))
        near = (np.abs(T[:, :3, 3]) < FARTHEST_M).all(axis=1)
        valid = whole & near & (off <= TOLERANCE)
    valid &= np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) <= _LAST_ROW
    poses = [pose if fine else None for pose, fine in zip(every, valid.tolist(), strict=True)]
    faults = [
        "" if fine else matrix_fault(each) or ""
        for each, fine in zip(T, valid.tolist(), strict=True)
    ]
    return poses, faults


def matrix_fault(T: Array) -> str | None:
    """Return why a matrix (4, 4) is no pose, or None."""
    if not np.isfinite(T).all():
        return "a number that is not finite"
    if (fault := _position_fault(T[:3, 3])) is not None:
        return fault
    off = float(np.abs(geometry.nearest_rotation(T[:3, :3]) - T[:3, :3]).max())
    if off > TOLERANCE:
        return f"a matrix {off:.3g} away from a rotation"
    if np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() > _LAST_ROW:
        return "a last row other than 0 0 0 1"
    return None


def rigid_transform(path: Path, key: str, text: str | None) -> Array:
    """Return the transform (4, 4), metres, of 16 numbers with commas between them.

    Raises SourceError for other text and for None, naming ``path`` and ``key``.
    """
    try:
        T = np.array(text.split(",") if text else [], dtype=np.float64)
    except ValueError:
        T = np.empty(0)
    if T.size != 16 or matrix_to_pose(T.reshape(4, 4)) is None:
        found = "none" if text is None else f"[{' '.join(text.split())}]"[:80]
        raise SourceError(f"{path}: expected {key}, 16 numbers of a rigid transform, found {found}")
    return T.reshape(4, 4)


def read_pose_matrix(path: Path) -> Array | None:
    """Read a 4x4 camera-to-world matrix in metres -> pose (7,), or None if it is invalid.

    Recordings mark lost tracking by files without 16 numbers or with an invalid matrix.
    """
    T = _matrix(path)
    return matrix_to_pose(T) if T.size == 16 else None


def pose_matrix_fault(path: Path) -> str | None:
    """Return why a file holds no pose, or None."""
    T = _matrix(path)
    return matrix_fault(T) if T.size == 16 else f"{T.size or 'no'} numbers instead of 16"


def read_pose_matrices(folder: Path, suffix: str) -> Trajectory[str]:
    """Read the matrices of a folder, by frame name; raises SourceError if none is valid."""
    files = sorted(folder.glob("*" + suffix))
    entries = [matrix_entry(file.name.removesuffix(suffix), file) for file in files]
    return trajectory_of(folder, entries)


def matrix_entry(name: str, path: Path) -> Entry[str]:
    """Read the matrix of the frame with this name."""
    pose = read_pose_matrix(path)
    return Entry(name, pose, path.name, None if pose is not None else pose_matrix_fault(path))


def _matrix(path: Path) -> Array:
    """Return the 16 numbers of a file as (4, 4), or others, or none."""
    try:
        content = read_regular_file(path, _MAX_MATRIX_BYTES, SourceError, links=True)
        T = np.array(content.decode("ascii").split(), dtype=np.float64)
    except (SourceError, ValueError):
        return np.empty(0)
    return T.reshape(4, 4) if T.size == 16 else T
