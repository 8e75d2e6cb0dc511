"""Camera poses, and charts that map a pose to six numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvo_edge import geometry
from cvo_edge.errors import UsageError

Array = NDArray[np.float64]
Rotation = Literal["euler_zyx", "tangent_predicted", "tangent_reference"]

_TRANSLATION = ("tx", "ty", "tz")
_NO_TURN = np.zeros(3)
_NO_TURN.setflags(write=False)


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera pose ``T_world_camera``: ``p_world = R p_camera + t``.

    Attributes
    ----------
    t_m
        Shape (3,): tx ty tz, metres, the camera's centre in the world frame.
    q_xyzw
        Shape (4,): unit quaternion of the camera's rotation, qw >= 0.
    """

    t_m: Array
    q_xyzw: Array

    @classmethod
    def from_array(cls, pose: ArrayLike) -> Pose:
        """Shape (7,): tx ty tz qx qy qz qw -> Pose; raises UsageError for invalid values."""
        try:
            values = np.asarray(pose, dtype=np.float64)
        except (TypeError, ValueError):
            values = np.empty(0)
        if values.shape != (7,) or not np.isfinite(values).all() or not values[3:].any():
            raise UsageError(
                f"pose: expected 7 finite numbers tx ty tz qx qy qz qw, found {str(pose)[:80]}"
            )
        return cls(values[:3].copy(), geometry.quaternion_normalise(values[3:]))

    @classmethod
    def from_matrix(cls, T_world_camera: ArrayLike) -> Pose:
        """Shape (4, 4) homogeneous matrix -> Pose; the rotation part is made orthonormal."""
        T = np.asarray(T_world_camera, dtype=np.float64)
        if T.shape != (4, 4) or not np.isfinite(T).all():
            raise UsageError(f"pose: expected a finite 4x4 matrix, found shape {T.shape}")
        R = geometry.nearest_rotation(T[:3, :3])
        return cls(T[:3, 3].copy(), geometry.matrix_to_quaternion(R))

    def then(self, other: Pose) -> Pose:
        """Return the pose of what has the pose ``other`` in the frame that this one places."""
        t = self.t_m + geometry.quaternion_to_matrix(self.q_xyzw) @ other.t_m
        q = geometry.quaternion_multiply(self.q_xyzw, other.q_xyzw)
        return Pose(t, geometry.quaternion_normalise(q))

    def to_array(self) -> Array:
        """Shape (7,): tx ty tz qx qy qz qw."""
        return np.concatenate([self.t_m, self.q_xyzw])

    def to_matrix(self) -> Array:
        """Shape (4, 4): the homogeneous matrix ``T_world_camera``."""
        T = np.eye(4)
        T[:3, :3] = geometry.quaternion_to_matrix(self.q_xyzw)
        T[:3, 3] = self.t_m
        return T


def as_pose(given: Pose | ArrayLike) -> Pose:
    """Return a pose as it is, or seven numbers as a pose; raises UsageError."""
    return given if isinstance(given, Pose) else Pose.from_array(given)


def about(poses: Array, origin_m: Sequence[float] | None) -> Array:
    """World poses (..., 7) -> poses with positions relative to an origin; None changes nothing."""
    if origin_m is None:
        return poses
    return np.concatenate([poses[..., :3] - np.asarray(origin_m), poses[..., 3:]], axis=-1)


@dataclass(frozen=True, eq=False)
class Chart:
    """Map from a pose to six numbers: tx ty tz in metres, then three rotation numbers in rad.

    ``tangent_reference``: Log(R_reference^T R). ``tangent_predicted``: Log(R_predicted^T R), the
    offset from the prediction. ``euler_zyx``: roll, pitch, yaw, each on the branch nearest to the
    prediction's, so that an interval across +-pi stays one interval.
    """

    rotation: Rotation
    reference_q_xyzw: Array | None = None

    @property
    def dof(self) -> tuple[str, str, str, str, str, str]:
        """Names of the six degrees of freedom, in the order used everywhere."""
        turns = ("roll", "pitch", "yaw") if self.rotation == "euler_zyx" else ("rx", "ry", "rz")
        return (*_TRANSLATION, *turns)

    @property
    def _about_prediction(self) -> bool:
        return self.rotation == "tangent_predicted"

    def coordinates(self, pose: ArrayLike, predicted: ArrayLike) -> Array:
        """Poses (..., 7) and predictions (..., 7) -> coordinates of the poses (..., 6)."""
        p = np.asarray(pose, dtype=np.float64)
        origin = np.asarray(predicted, dtype=np.float64)
        if self.rotation == "euler_zyx":
            at_origin = geometry.quaternion_to_euler_zyx(origin[..., 3:])
            turn = geometry.quaternion_to_euler_zyx(p[..., 3:])
            turn = at_origin + geometry.wrap_angle(turn - at_origin)
        else:
            q_base = self.reference_q_xyzw
            if self._about_prediction or q_base is None:
                q_base = origin[..., 3:]
            q_base_inverse = geometry.quaternion_conjugate(q_base)
            turn = geometry.quaternion_log(geometry.quaternion_multiply(q_base_inverse, p[..., 3:]))
        return np.concatenate(np.broadcast_arrays(p[..., :3], turn), axis=-1)

    def turn_centre(self, point: Array) -> Array:
        """Return the three coordinates from which every rotation is within half a turn; point (6,).

        The prediction's own for ``euler_zyx``, zero for a tangent chart.
        """
        return point[3:] if self.rotation == "euler_zyx" else _NO_TURN

    def point(self, pose: Array) -> Array:
        """Return ``coordinates(pose, pose)`` of one pose (7,), in a tenth of the time.

        It runs once per frame; for so few numbers, calling numpy takes longer than the arithmetic.
        """
        if self.rotation == "euler_zyx":
            return self.coordinates(pose, pose)
        tx, ty, tz, x, y, z, w = pose.tolist()
        if self._about_prediction or self.reference_q_xyzw is None:
            return np.array((tx, ty, tz, 0.0, 0.0, 0.0))
        a, b, c, d = self.reference_q_xyzw.tolist()
        # Vector and scalar part of conj(reference) * q; the log takes the shorter rotation.
        rx = d * x - a * w - b * z + c * y
        ry = d * y + a * z - b * w - c * x
        rz = d * z - a * y + b * x - c * w
        rw = d * w + a * x + b * y + c * z
        sine = math.sqrt(rx * rx + ry * ry + rz * rz)
        angle = 2.0 * math.atan2(sine, abs(rw))
        factor = math.copysign(angle / sine if sine > 1e-8 else 2.0, rw)
        return np.array((tx, ty, tz, factor * rx, factor * ry, factor * rz))
