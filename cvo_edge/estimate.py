"""What the odometer returns for one frame: status, pose and the set that holds the true pose."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import product
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, Struct, UnsetType
from numpy.typing import ArrayLike, NDArray

from cvo_edge.errors import UsageError, printable
from cvo_edge.pose import Chart, Pose, Rotation
from cvo_edge.sets import Bands, ConformalSet, Ellipsoids
from cvo_edge.vocabulary import Scope

Array = NDArray[np.float64]
SixOrUnbounded = tuple[
    float | None, float | None, float | None, float | None, float | None, float | None
]
BandsOrUnbounded = tuple[tuple[tuple[float | None, float | None], ...], ...]


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


class _Strict(Struct, frozen=True, forbid_unknown_fields=True):
    """Immutable; unknown keys are an error."""


class RecordedPose(_Strict, frozen=True):
    """``t_m``: tx ty tz of the camera in the world, metres; ``q_xyzw``: its rotation, unit."""

    t_m: tuple[float, float, float]
    q_xyzw: tuple[float, float, float, float]


class RecordedRegion(_Strict, frozen=True):
    """The region of all six degrees of freedom, as ``Ellipsoids`` describes it."""

    radius: float
    scale: list[list[float]]
    centres: list[list[float]]


class RecordedInterval(_Strict, frozen=True):
    """The conformal set in the chart ``rotation``, m and rad; None (null) is unbounded.

    ``bands`` are given per DoF for methods whose sets may be in pieces. ``region`` is UNSET (no
    such key) unless the run was asked for regions, and None where the region is unbounded.
    """

    confidence: float
    scope: Scope
    rotation: Rotation
    lower: SixOrUnbounded
    upper: SixOrUnbounded
    bounded: bool
    bands: BandsOrUnbounded | None
    region: RecordedRegion | UnsetType | None = UNSET


class Record(_Strict, frozen=True):
    """What is written about one frame: one JSON line, one row of CSV, one line of the table."""

    seq: int
    stamp_ns: int | None
    source: str
    status: Status
    reasons: tuple[Reason, ...]
    pose: RecordedPose | None
    interval: RecordedInterval | None
    latency_ms: dict[str, float]


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

    def to_record(self, *, region: bool = False) -> Record:
        """The record of this frame, with ``interval.region`` set on request."""
        pose, interval = None, None
        if self.pose is not None:
            lower, upper = tuple(self.lower.tolist()), tuple(self.upper.tolist())
            # As ``bounded``, which takes longer for twelve numbers that are lists already.
            bounded, bands = all(map(math.isfinite, lower + upper)), self.bands
            pose = RecordedPose(tuple(self.pose.t_m.tolist()), tuple(self.pose.q_xyzw.tolist()))
            interval = RecordedInterval(
                self.confidence,
                self.scope,
                self.chart.rotation,
                lower if bounded else _null_infinite(lower),
                upper if bounded else _null_infinite(upper),
                bounded,
                bands if bounded or bands is None else _null_bands(bands),
                _recorded_region(self.conformal_set.ellipsoids) if region else UNSET,
            )
        return Record(
            self.seq,
            self.stamp_ns,
            self.source,
            self.status,
            self.reasons,
            pose,
            interval,
            dict(self.latency_ms),
        )

    def to_dict(self, *, region: bool = False) -> dict[str, Any]:
        """The record as ``json.loads`` returns its JSON line: dicts, lists, strings, numbers."""
        decoded: dict[str, Any] = msgspec.json.decode(
            msgspec.json.encode(self.to_record(region=region))
        )
        return decoded

    def __str__(self) -> str:
        """One line: frame, status, reasons, position (m) and half-widths (cm, deg)."""
        line = f"frame {self.seq} {self.status}"
        if self.reasons:
            line += f" ({', '.join(self.reasons)})"
        if self.pose is None:
            return line
        x, y, z = self.pose.t_m.tolist()
        line += f" at {x:.3f} {y:.3f} {z:.3f} m"
        half = 0.5 * (self.upper - self.lower)
        if not np.isfinite(half).any():
            return f"{line}, unbounded"
        cm = " ".join(f"±{value:.1f}" for value in (100.0 * half[:3]).tolist())
        deg = " ".join(f"±{value:.1f}" for value in np.rad2deg(half[3:]).tolist())
        return f"{line}, {cm} cm, {deg} deg ({self.confidence:g} {self.scope})"

    def __repr__(self) -> str:
        """The same line, marked as an object."""
        return f"<PoseInterval {self}>"

    def _repr_html_(self) -> str:
        """Small table for notebooks: lower and upper bound of each degree of freedom."""
        # Only notebooks need it.
        from html import escape

        name = f"frame {self.seq} {printable(self.source)}".rstrip()
        caption = f"{name}: {', '.join([self.status, *self.reasons])}"
        if self.pose is None:
            return f"<p>{escape(caption)}</p>"
        caption += f"; {self.confidence:g} {self.scope}, {self.chart.rotation}"
        rows = "".join(
            f"<tr><td>{dof} ({unit})</td><td>{low * scale:.3f}</td><td>{high * scale:.3f}</td></tr>"
            for dof, unit, scale, low, high in zip(
                self.chart.dof,
                ["m"] * 3 + ["deg"] * 3,
                [1.0] * 3 + [math.degrees(1.0)] * 3,
                self.lower.tolist(),
                self.upper.tolist(),
                strict=True,
            )
        )
        return (
            f"<table><caption>{escape(caption)}</caption>"
            f"<tr><th>DoF</th><th>lower</th><th>upper</th></tr>{rows}</table>"
        )


def _null_infinite(values: Iterable[float]) -> tuple[Any, ...]:
    return tuple(value if math.isfinite(value) else None for value in values)


def _null_bands(bands: Bands) -> BandsOrUnbounded:
    return tuple(tuple(_null_infinite(band) for band in row) for row in bands)


def _recorded_region(ellipsoids: Ellipsoids | None) -> RecordedRegion | None:
    if ellipsoids is None:
        return None
    return RecordedRegion(ellipsoids.radius, ellipsoids.scale.tolist(), ellipsoids.centres.tolist())
