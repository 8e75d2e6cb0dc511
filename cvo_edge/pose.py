"""Poses, conformal sets and what the odometer returns for one frame."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvo_edge import geometry
from cvo_edge.errors import UsageError

Array = NDArray[np.float64]
Scope = Literal["marginal", "joint"]
Rotation = Literal["euler_zyx", "tangent_predicted", "tangent_reference"]
Bands = tuple[tuple[tuple[float, float], ...], ...]

_TRANSLATION = ("tx", "ty", "tz")


class Status(StrEnum):
    """What a frame's estimate is worth."""

    OK = "ok"
    DEGRADED = "degraded"
    INVALID = "invalid"


class Reason(StrEnum):
    """The closed list of remarks on a frame; the comment says which status each one goes with."""

    IMAGE_UNREADABLE = "image_unreadable"  # invalid: the file or stream gave no whole image
    IMAGE_UNSUPPORTED = "image_unsupported"  # invalid: not a 2-D or 3-channel 8- or 16-bit image
    OUTPUT_NOT_FINITE = "output_not_finite"  # invalid: the network gave NaN or infinity
    OUTPUT_ABSURD = "output_absurd"  # invalid: the network gave numbers of no sensible size
    POSE_IMPLAUSIBLE = "pose_implausible"  # invalid: outside the bundle's pose limits
    IMAGE_BLACK = "image_black"  # degraded: hardly any light, as behind a lens cap
    IMAGE_SATURATED = "image_saturated"  # degraded: more than half of it is white
    IMAGE_FLAT = "image_flat"  # degraded: of one colour, without contrast
    IMAGE_SIZE_CHANGED = "image_size_changed"  # degraded: not the size of the stream's first frame
    FRAME_REPEATED = "frame_repeated"  # degraded: an image that was there before, as if frozen
    FRAME_STALE = "frame_stale"  # degraded: it waited for more than a second
    STAMP_NOT_LATER = "stamp_not_later"  # degraded: not after the stamp of the frame before
    BOUNDS_CROSSED = "bounds_crossed"  # ok: a negative correction emptied a set; its middle stands
    PITCH_NEAR_90 = "pitch_near_90"  # ok: |pitch| > 80 deg, roll and yaw are ill-defined


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
        """Shape (7,): tx ty tz qx qy qz qw -> Pose; raises UsageError where it is none."""
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

    def to_array(self) -> Array:
        """Shape (7,): tx ty tz qx qy qz qw."""
        return np.concatenate([self.t_m, self.q_xyzw])

    def to_matrix(self) -> Array:
        """Shape (4, 4): the homogeneous matrix ``T_world_camera``."""
        T = np.eye(4)
        T[:3, :3] = geometry.quaternion_to_matrix(self.q_xyzw)
        T[:3, 3] = self.t_m
        return T


@dataclass(frozen=True, eq=False)
class Chart:
    """How a pose becomes six numbers: tx ty tz in metres, then three rotation numbers in rad.

    ``tangent_reference``: Log(R_reference^T R). ``tangent_predicted``: Log(R_predicted^T R), an
    offset about the prediction. ``euler_zyx``: roll, pitch, yaw, each on the branch nearest to
    the prediction's (so that an interval across +-pi stays one interval).
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
        """Six numbers of poses (..., 7) as seen from predictions (..., 7) -> (..., 6)."""
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

    def point(self, pose: Array) -> Array:
        """``coordinates(pose, pose)`` of one pose (7,), in a tenth of the time.

        On the way of every frame, where a call into numpy costs more than the arithmetic in it.
        """
        if self.rotation == "euler_zyx":
            return self.coordinates(pose, pose)
        tx, ty, tz, x, y, z, w = pose.tolist()
        if self._about_prediction or self.reference_q_xyzw is None:
            return np.array((tx, ty, tz, 0.0, 0.0, 0.0))
        a, b, c, d = self.reference_q_xyzw.tolist()
        # Vector and scalar part of conj(reference) * q; the log takes the shorter way round.
        rx = d * x - a * w - b * z + c * y
        ry = d * y + a * z - b * w - c * x
        rz = d * z - a * y + b * x - c * w
        rw = d * w + a * x + b * y + c * z
        sine = math.sqrt(rx * rx + ry * ry + rz * rz)
        angle = 2.0 * math.atan2(sine, abs(rw))
        factor = math.copysign(angle / sine if sine > 1e-8 else 2.0, rw)
        return np.array((tx, ty, tz, factor * rx, factor * ry, factor * rz))


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """A region of all six degrees of freedom: a union of ellipsoids of one shape.

    It holds y where min_j |scale^-1 (y - centres_j)| <= radius.

    Attributes
    ----------
    centres
        Shape (J, 6), in the bundle's chart, m and rad.
    scale
        Shape (6, 6), lower triangular, in units of the chart.
    radius
        In units of the scale, at least 0.
    """

    centres: NDArray[Any]
    scale: Array
    radius: float

    def distance(self, coordinates: ArrayLike) -> float:
        """Scaled distance of six coordinates (6,) to the nearest centre."""
        return float(scaled_distance(self.centres, self.scale, np.asarray(coordinates, np.float64)))

    def contains(self, coordinates: ArrayLike) -> bool:
        """Whether six coordinates (6,) lie in the region."""
        return self.distance(coordinates) <= self.radius

    def to_dict(self) -> dict[str, Any]:
        """The record's ``region``."""
        return {
            "radius": self.radius,
            "scale": self.scale.tolist(),
            "centres": self.centres.tolist(),
        }


def scaled_distance(centres: NDArray[Any], scale: NDArray[Any], y: Array) -> Array:
    """Return min_j |scale^-1 (y - centres_j)|.

    Centres (..., J, 6), lower triangular scale (..., 6, 6) and y (..., 6) -> (...). Infinite where
    the scale has no inverse: what has no extent holds nothing.
    """
    difference = y[..., np.newaxis, :] - centres.astype(np.float64)
    rows = scale.astype(np.float64)[..., np.newaxis, :, :]
    solved = np.empty_like(difference)
    squared = np.zeros(difference.shape[:-1])
    # Forward substitution, one row after the other.
    with np.errstate(all="ignore"):
        for d in range(difference.shape[-1]):
            known = (rows[..., d, :d] * solved[..., :d]).sum(axis=-1)
            solved[..., d] = (difference[..., d] - known) / rows[..., d, d]
            squared += solved[..., d] ** 2
        nearest = np.sqrt(np.nan_to_num(squared, nan=np.inf, posinf=np.inf)).min(axis=-1)
    return np.asarray(nearest)


@dataclass(frozen=True, eq=False)
class ConformalSet:
    """The set that holds each degree of freedom with the stated confidence.

    Attributes
    ----------
    lower, upper
        Shape (6,): its hull in the bundle's chart, m and rad; infinite where unbounded.
    bands
        For methods whose sets may have gaps: per DoF the disjoint intervals (low, high) in
        ascending order; None where the set is its hull.
    crossed
        Whether a correction emptied the set of some DoF, so that its middle stands for it.
    ellipsoids
        For a method with a region of all six together, in the joint scope: that region, of which
        lower and upper are the hull; None where the set is the product of its DoF's sets.
    """

    lower: Array
    upper: Array
    bands: Bands | None = None
    crossed: bool = False
    ellipsoids: Ellipsoids | None = None

    def covers(self, coordinates: ArrayLike) -> NDArray[np.bool_]:
        """Which of six coordinates (6,) lie in the set, shape (6,); gaps count as outside."""
        y = np.asarray(coordinates, dtype=np.float64)
        if self.bands is None:
            return np.asarray((self.lower <= y) & (y <= self.upper))
        return np.array(
            [
                any(low <= value <= high for low, high in row)
                for value, row in zip(y.tolist(), self.bands, strict=True)
            ]
        )

    def contains(self, coordinates: ArrayLike) -> bool:
        """Whether six coordinates (6,) lie in the region, where there is one, else in all sets."""
        if self.ellipsoids is not None:
            return self.ellipsoids.contains(coordinates)
        return bool(self.covers(coordinates).all())

    def within(self, lowest: Array, highest: Array) -> ConformalSet:
        """Return the set with its unbounded sides put at these limits, (6,) each."""
        # A finite side beyond the limit of the other one leaves a set without width.
        lower = np.where(np.isfinite(self.lower), self.lower, np.minimum(lowest, self.upper))
        upper = np.where(np.isfinite(self.upper), self.upper, np.maximum(highest, self.lower))
        bands = self.bands
        if bands is not None:
            bands = tuple(
                row if math.isfinite(row[-1][1] - row[0][0]) else ((low, high),)
                for row, low, high in zip(bands, lower.tolist(), upper.tolist(), strict=True)
            )
        return replace(self, lower=lower, upper=upper, bands=bands)

    def width(self) -> Array:
        """Measure of the set per DoF, (6,): of the union of its bands, not of their hull."""
        if self.bands is None:
            return self.upper - self.lower
        return np.array([sum(high - low for low, high in row) for row in self.bands])

    def distance(self, coordinates: ArrayLike) -> Array:
        """Distance of six coordinates (6,) to the nearest point of the set per DoF; 0 inside."""
        y = np.asarray(coordinates, dtype=np.float64)
        if self.bands is None:
            return np.asarray(np.maximum(np.maximum(self.lower - y, y - self.upper), 0.0))
        return np.array(
            [
                min(max(low - value, value - high, 0.0) for low, high in row)
                for value, row in zip(y.tolist(), self.bands, strict=True)
            ]
        )


_UNBOUNDED = ConformalSet(np.full(6, -np.inf), np.full(6, np.inf))
_UNBOUNDED.lower.setflags(write=False)
_UNBOUNDED.upper.setflags(write=False)


def unbounded_set() -> ConformalSet:
    """The set that holds everything: what is known where a check failed."""
    return _UNBOUNDED


@dataclass(frozen=True, eq=False)
class PoseInterval:
    """One frame's estimate: the pose and the set that holds the true pose.

    Attributes
    ----------
    seq, stamp_ns, source
        Number of the frame in its stream, time in integer nanoseconds (None where the source gives
        none) and the source's name for it.
    status, reasons
        ``ok``; ``degraded`` (a pose, but nothing may be claimed: all bounds infinite); ``invalid``
        (no pose either). Remarks from the closed list ``Reason``.
    pose
        The point estimate, None where invalid.
    region
        The conformal set; everything (infinite) unless the status is ``ok``.
    confidence, scope
        The stated probability, and whether it holds for each DoF (``marginal``) or for all six at
        once (``joint``).
    chart
        What the six numbers mean.
    latency_ms
        Milliseconds per stage: read, preprocess, model, conformal, total.
    """

    seq: int
    stamp_ns: int | None
    source: str
    status: Status
    reasons: tuple[Reason, ...]
    pose: Pose | None
    region: ConformalSet
    confidence: float
    scope: Scope
    chart: Chart
    latency_ms: Mapping[str, float] = field(default_factory=dict)

    @property
    def lower(self) -> Array:
        """Shape (6,): tx ty tz (m), three rotation numbers (rad); -inf where unbounded."""
        return self.region.lower

    @property
    def upper(self) -> Array:
        """Shape (6,), as ``lower``; +inf where unbounded."""
        return self.region.upper

    @property
    def bands(self) -> Bands | None:
        """Disjoint intervals per DoF, or None where the set is its hull."""
        return self.region.bands

    def position_boxes(self) -> Array:
        """Shape (boxes, 3, 2): the region of the position, as disjoint boxes [low, high], metres.

        The product of the bands of tx, ty and tz; a single box for a method without gaps. With the
        joint scope the true position lies in one of them with the stated probability.
        """
        bands = self.bands or tuple(
            ((low, high),) for low, high in zip(self.lower, self.upper, strict=True)
        )
        return np.array(list(product(*bands[:3])), dtype=np.float64)

    @property
    def bounded(self) -> bool:
        """Whether all twelve bounds are finite."""
        return bool(np.isfinite(self.lower).all() and np.isfinite(self.upper).all())

    def covers(self, pose: Pose | ArrayLike) -> NDArray[np.bool_]:
        """Say per DoF, shape (6,), whether the set holds a ``T_world_camera`` (Pose or shape (7,)).

        Raises UsageError for an invalid frame: there is no set to ask.
        """
        return self.region.covers(self._coordinates(pose))

    def contains(self, pose: Pose | ArrayLike) -> bool:
        """Whether the set holds this pose in all six degrees of freedom at once.

        In the joint scope of MCQR that is the region itself, which is smaller than its hull; else
        whether ``covers`` is true of all six, and the errors are its.
        """
        return self.region.contains(self._coordinates(pose))

    def _coordinates(self, pose: Pose | ArrayLike) -> Array:
        if self.pose is None:
            raise UsageError(f"frame {self.seq} is invalid: it has no set that could hold a pose")
        other = pose if isinstance(pose, Pose) else Pose.from_array(pose)
        return self.chart.coordinates(other.to_array(), self.pose.to_array())

    def covariance(self) -> Array:
        """Shape (6, 6), diagonal: (half-width / z)^2 in m^2 and rad^2, infinite where unbounded.

        z is the normal quantile of the marginal confidence. A convention for filters that want a
        covariance; the guarantee is that of the interval alone.
        """
        # Not for every start: it brings in fractions and decimals.
        from statistics import NormalDist

        z = NormalDist().inv_cdf(0.5 + 0.5 * self.confidence)
        return np.diag(((self.upper - self.lower) / (2.0 * z)) ** 2)

    def to_dict(self, *, region: bool = False) -> dict[str, Any]:
        """The JSON record of this frame, as the README specifies it; on request with the region."""
        pose: dict[str, Any] | None = None
        interval: dict[str, Any] | None = None
        if self.pose is not None:
            lower, upper = self.lower.tolist(), self.upper.tolist()
            bounded = self.bounded
            pose = {"t_m": self.pose.t_m.tolist(), "q_xyzw": self.pose.q_xyzw.tolist()}
            interval = {
                "confidence": self.confidence,
                "scope": self.scope,
                "rotation": self.chart.rotation,
                "lower": lower if bounded else _null_infinite(lower),
                "upper": upper if bounded else _null_infinite(upper),
                "bounded": bounded,
                "bands": self.bands if bounded or self.bands is None else _null_bands(self.bands),
            }
        if region and interval is not None:
            ellipsoids = self.region.ellipsoids
            interval["region"] = None if ellipsoids is None else ellipsoids.to_dict()
        return {
            "seq": self.seq,
            "stamp_ns": self.stamp_ns,
            "source": self.source,
            "status": self.status,
            "reasons": self.reasons,
            "pose": pose,
            "interval": interval,
            "latency_ms": self.latency_ms,
        }


def _null_infinite(values: Iterable[float]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values]


def _null_bands(bands: Bands) -> list[list[list[float | None]]]:
    return [[_null_infinite(band) for band in row] for row in bands]
