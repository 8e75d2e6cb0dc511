"""What the odometer returns for one frame: status, pose and the set that holds the true pose."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvo_edge.errors import UsageError
from cvo_edge.pose import Chart, Pose
from cvo_edge.sets import Bands, ConformalSet
from cvo_edge.vocabulary import Scope

Array = NDArray[np.float64]


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
    conformal_set
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
    conformal_set: ConformalSet
    confidence: float
    scope: Scope
    chart: Chart
    latency_ms: Mapping[str, float] = field(default_factory=dict)

    @property
    def lower(self) -> Array:
        """Shape (6,): tx ty tz (m), three rotation numbers (rad); -inf where unbounded."""
        return self.conformal_set.lower

    @property
    def upper(self) -> Array:
        """Shape (6,), as ``lower``; +inf where unbounded."""
        return self.conformal_set.upper

    @property
    def bands(self) -> Bands | None:
        """Disjoint intervals per DoF, or None where the set is its hull."""
        return self.conformal_set.bands

    def position_boxes(self) -> Array:
        """Shape (boxes, 3, 2): the set of the position, as disjoint boxes [low, high], metres.

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
        return self.conformal_set.covers(self._coordinates(pose))

    def contains(self, pose: Pose | ArrayLike) -> bool:
        """Whether the set holds this pose in all six degrees of freedom at once.

        In the joint scope of MCQR that is the region itself, which is smaller than its hull; else
        whether ``covers`` is true of all six, and the errors are its.
        """
        return self.conformal_set.contains(self._coordinates(pose))

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
            ellipsoids = self.conformal_set.ellipsoids
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
