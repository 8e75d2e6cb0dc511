"""The odometer's result for one frame: status, pose and the set that holds the true pose."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import ArrayLike, NDArray

from cvo_edge.errors import UsageError, printable
from cvo_edge.pose import Chart, Pose, as_pose
from cvo_edge.record import (
    BandsOrUnbounded,
    Reason,
    Record,
    RecordedInterval,
    RecordedPose,
    RecordedRegion,
    Status,
)
from cvo_edge.sets import Bands, ConformalSet, Ellipsoids
from cvo_edge.vocabulary import Scope

Array = NDArray[np.float64]


class Drift(NamedTuple):
    """Whether the images of a stream are still like those of the calibration.

    ``state``: ``unknown`` if the bundle cannot tell. ``reason`` and ``since``: why, and the number
    of the first frame, during an alarm. ``false_alarms``: proven bound of the probability that a
    known frame is beyond the limits, or that a new recording raises an alarm, as ``inspect`` says;
    None if nothing is proven.
    """

    state: Literal["clear", "alarm", "unknown"]
    reason: Reason | None = None
    since: int | None = None
    false_alarms: float | None = None


_UNKNOWN = Drift("unknown")


@dataclass(frozen=True, eq=False)
class PoseInterval:
    """One frame's estimate: the pose and the set that holds the true pose.

    Attributes
    ----------
    seq, stamp_ns, source
        Number of the frame in its stream, time in integer nanoseconds (None if the source gives no
        time) and the source's name for the frame.
    status, reasons
        ``ok``, ``degraded`` (a pose without a guarantee: all bounds are infinite) or ``invalid``
        (no pose); remarks from ``Reason``.
    pose
        The point estimate; None if the status is ``invalid``.
    conformal_set
        The conformal set; unbounded unless the status is ``ok``.
    confidence, scope
        The stated probability, and whether it holds for each DoF (``marginal``) or for all six at
        once (``joint``).
    chart
        Meaning of the six numbers.
    latency_ms
        Milliseconds per stage: read, preprocess, model, conformal, total.
    factor
        What labels have made of the thresholds: 1 as calibrated, more is wider. One number in the
        joint scope, six in the marginal one (twelve for methods with two thresholds per DoF: lower,
        then upper); None if the odometer does not adapt.
    drift, novelty
        State of the stream, and how much this frame differs from calibrated ones, as a share of
        what is still taken for one of them; None for a frame without outputs or without an alarm.
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
    factor: tuple[float, ...] | None = None
    drift: Drift = _UNKNOWN
    novelty: float | None = None

    @property
    def lower(self) -> Array:
        """Shape (6,): tx ty tz (m), three rotation numbers (rad); -inf where unbounded."""
        return self.conformal_set.lower

    @property
    def upper(self) -> Array:
        """Shape (6,), in the order of ``lower``; +inf where unbounded."""
        return self.conformal_set.upper

    @property
    def bands(self) -> Bands | None:
        """Disjoint intervals per DoF, or None if the set equals its hull."""
        return self.conformal_set.bands

    def position_boxes(self) -> Array:
        """Return the position's set as disjoint boxes [low, high], metres, shape (boxes, 3, 2).

        The boxes are the product of the bands of tx, ty and tz; a set without gaps gives one box.
        In the joint scope the true position lies in one of them with the stated probability.
        """
        bands = self.bands or tuple(
            ((low, high),) for low, high in zip(self.lower, self.upper, strict=True)
        )
        return np.array(list(product(*bands[:3])), dtype=np.float64)

    @property
    def bounded(self) -> bool:
        """Whether all twelve bounds are finite."""
        return bool(np.isfinite(self.lower).all() and np.isfinite(self.upper).all())

    @property
    def vouched(self) -> bool:
        """Whether the pose may be shown or passed on as one that an interval stands behind.

        True for a frame of status ``ok`` whose set is bounded.
        """
        return self.status is Status.OK and self.pose is not None and self.bounded

    def about_pose(self) -> Bands:
        """Return the disjoint intervals of each degree of freedom minus its estimate, m and rad.

        Raises UsageError for an invalid frame.
        """
        point = self.chart.point(self._known_pose().to_array()).tolist()
        rows = self.bands or tuple(
            ((low, high),)
            for low, high in zip(self.lower.tolist(), self.upper.tolist(), strict=True)
        )
        return tuple(
            tuple((low - x, high - x) for low, high in row)
            for row, x in zip(rows, point, strict=True)
        )

    def covers(self, pose: Pose | ArrayLike) -> NDArray[np.bool_]:
        """Tell per DoF, (6,), whether the set holds a ``T_world_camera`` (Pose or shape (7,)).

        Raises UsageError for an invalid frame, which has no set.
        """
        return self.conformal_set.covers(self._coordinates(pose))

    def contains(self, pose: Pose | ArrayLike) -> bool:
        """Whether the set holds this pose in all six degrees of freedom at once.

        In the joint scope of a method with a region, the test uses it instead of its hull;
        otherwise all six values of ``covers`` must be true. Raises as ``covers``.
        """
        return self.conformal_set.contains(self._coordinates(pose))

    def _coordinates(self, pose: Pose | ArrayLike) -> Array:
        return self.chart.coordinates(as_pose(pose).to_array(), self._known_pose().to_array())

    def covariance(
        self,
        frame: Literal["world", "chart"] = "world",
        *,
        T_camera_base: Pose | ArrayLike | None = None,
        T_map_world: Pose | ArrayLike | None = None,
    ) -> Array:
        """Return second moments of the error of ``pose``, (6, 6) in m^2, m rad and rad^2.

        A convention for filters, see ``cvo_edge.covariance``; the guarantee is that of the set.
        ``world``: x y z, then rotations about the fixed axes of the header's frame, as in
        ``geometry_msgs/PoseWithCovariance``; ``chart``: in the six numbers of the set. Without a
        bounded set, the diagonal is infinite, which no filter takes: ask ``bounded`` first.

        Parameters
        ----------
        frame
            Axes of the result.
        T_camera_base, T_map_world
            Pose or shape (7,): where the robot's base is in the camera, and the world in the map;
            the result is that of ``pose_of`` with the same two, for ``world`` only.

        Raises UsageError for an invalid frame, and for a base or map with ``chart``.
        """
        # Imported here because it also loads fractions and decimal, which few programs need.
        from cvo_edge import covariance

        if frame not in ("world", "chart"):
            raise UsageError(f"frame: expected world or chart, found {frame!r}")
        if frame == "chart" and (T_camera_base is not None or T_map_world is not None):
            raise UsageError("frame: expected world with T_camera_base or T_map_world, found chart")
        pose = self._known_pose()
        point = self.chart.point(pose.to_array())
        found = covariance.in_chart(self.conformal_set, point, self.confidence, self.scope)
        if frame == "chart":
            return found
        found = covariance.in_world(found, self.chart, pose, point)
        base, outer = (None if T is None else as_pose(T) for T in (T_camera_base, T_map_world))
        if base is None and outer is None:
            return found
        lever = np.zeros(3) if base is None else pose.to_matrix()[:3, :3] @ base.t_m
        R = np.eye(3) if outer is None else outer.to_matrix()[:3, :3]
        return covariance.moved(found, lever, R)

    def pose_of(
        self,
        T_camera_base: Pose | ArrayLike | None = None,
        T_map_world: Pose | ArrayLike | None = None,
    ) -> Pose:
        """Return ``T_map_base``, the pose of the robot's base in the map.

        Parameters as for ``covariance``; raises UsageError for an invalid frame.
        """
        found = self._known_pose()
        if T_camera_base is not None:
            found = found.then(as_pose(T_camera_base))
        return found if T_map_world is None else as_pose(T_map_world).then(found)

    def _known_pose(self) -> Pose:
        if self.pose is None:
            raise UsageError(f"frame {self.seq} is invalid: it has no pose and no set")
        return self.pose

    def to_record(self, *, region: bool = False) -> Record:
        """Return the record of this frame, with ``interval.region`` on request."""
        pose, interval = None, None
        if self.pose is not None:
            lower, upper = tuple(self.lower.tolist()), tuple(self.upper.tolist())
            # Equal to ``self.bounded``, but faster on twelve Python floats.
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
            UNSET if self.factor is None else self.factor,
            *_recorded_drift(self.drift, self.novelty),
        )

    def to_dict(self, *, region: bool = False) -> dict[str, Any]:
        """Return the record as ``json.loads`` reads it: dicts, lists, strings and numbers."""
        decoded: dict[str, Any] = msgspec.json.decode(
            msgspec.json.encode(self.to_record(region=region))
        )
        return decoded

    def draw(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        """Return a BGR copy of the frame's image with what this estimate says, for a screen.

        A frame that is ``vouched`` shows its position, the axes of the world, and one bar for each
        degree of freedom: its set about the pose, with half the width of its hull in cm or degrees.
        Any other frame shows its status and reasons on a dark grey image.

        Parameters
        ----------
        image
            Shape (height, width) or (height, width, 1, 3 or 4), grey, BGR or BGRA, 8 or 16 bits;
            bars need 160 x 120 pixels. It is not changed.

        Raises UsageError for anything that is no such image.
        """
        # Imported here because it loads OpenCV.
        from cvo_edge import overlay

        vouched = None
        if self.pose is not None and self.vouched:
            R = self.pose.to_matrix()[:3, :3]
            vouched = overlay.Vouched(self.chart.dof, self.about_pose(), R.T)
        return overlay.draw(image, self.to_record(), vouched)

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
        """Return the line of ``str`` in angle brackets."""
        return f"<PoseInterval {self}>"

    def _repr_html_(self) -> str:
        """Return a table for notebooks: lower and upper bound of each degree of freedom."""
        # Imported here because only notebooks need it.
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


def _recorded_drift(
    drift: Drift, novelty: float | None
) -> tuple[float | UnsetType | None, Literal["clear", "alarm"] | UnsetType]:
    if drift.state == "unknown":
        return UNSET, UNSET
    return recorded_novelty(novelty), drift.state


def recorded_novelty(novelty: float | None) -> float | None:
    """Return the novelty as a record gives it: four digits, None for a frame not judged."""
    return None if novelty is None else round(novelty, 4)


def _null_infinite(values: Iterable[float]) -> tuple[Any, ...]:
    return tuple(value if math.isfinite(value) else None for value in values)


def _null_bands(bands: Bands) -> BandsOrUnbounded:
    return tuple(tuple(_null_infinite(band) for band in row) for row in bands)


def _recorded_region(ellipsoids: Ellipsoids | None) -> RecordedRegion | None:
    if ellipsoids is None:
        return None
    return RecordedRegion(ellipsoids.radius, ellipsoids.scale.tolist(), ellipsoids.centres.tolist())
