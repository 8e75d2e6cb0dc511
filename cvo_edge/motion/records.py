"""What is written of a pose: its motions over the calibrated horizons, each with an interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Literal

import numpy as np
from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace
from numpy.typing import NDArray

from cvo_edge.motion.intervals import Level, MotionCalibration
from cvo_edge.record import RecordedPose, SixOrUnbounded, Status
from cvo_edge.vocabulary import VERSION, MotionRule, Scope

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


# A motion of an estimator without a scale that is shorter has no direction, in steps.
LEAST_STEPS = 0.5


class MotionReason(StrEnum):
    """Remarks on a pose; the comments give the status that goes with each of them."""

    POSE_MISSING = "pose_missing"  # invalid: the estimator gave no pose
    STAMP_NOT_LATER = "stamp_not_later"  # invalid: not later than the pose before; it is not used
    TRAJECTORY_STARTED = "trajectory_started"  # degraded: nothing came before
    GAP = "gap"  # degraded: too long after the pose before
    JUMP = "jump"  # degraded: further or more turned than the robot can move since the pose before
    MOTION_UNFAMILIAR = "motion_unfamiliar"  # degraded: faster or rougher than any calibrated drive
    RATE_DIFFERS = "rate_differs"  # ok: not the calibration's rate; horizons in frames lapse


class _Strict(Struct, frozen=True, forbid_unknown_fields=True, gc=False):
    """Immutable; unknown keys are an error. Without cycles, so that nobody need look for them."""


class MotionDirection(_Strict, frozen=True):
    """Where a motion leads.

    ``xyz``: unit vector in the frame where the motion starts; ``radius``: angle (rad) around it
    within which the true direction is, null if unbounded.
    """

    xyz: tuple[float, float, float]
    radius: float | None


class MotionInterval(_Strict, frozen=True):
    """The motion over one horizon; all but the name are null if there is none.

    Attributes
    ----------
    horizon
        As calibrated, e.g. ``5s``.
    since_seq, seconds, metres
        Where the motion starts, and how long it is in time and along the path.
    t_m, q_xyzw
        The estimated motion dE = T_start^-1 T_end.
    lower, upper
        Bounds of x = (t, Log R) of dE^-1 dG, m and rad, in the body frame at the end of dE; dG is
        the true motion.
    position, rotation
        Radii of balls around the middle of the bounds that hold t (m) and Log R (rad).
    bounded
        Whether all these are numbers.
    factor
        No key unless thresholds adapt: what labels have made of those of the six degrees of
        freedom, of position and of rotation; 1 as calibrated, more is wider.
    covariance
        No key unless asked for (``interval``): of the motion in the frame where it starts, x y z
        and rotations about its fixed axes, row by row, m^2, m rad and rad^2.
    direction
        No key unless the estimator has no scale; then ``metres``, ``t_m``, ``position`` and the
        bounds of t are null. null if the motion has no direction.
    """

    horizon: str
    since_seq: int | None = None
    seconds: float | None = None
    metres: float | None = None
    t_m: tuple[float, float, float] | None = None
    q_xyzw: tuple[float, float, float, float] | None = None
    lower: SixOrUnbounded | None = None
    upper: SixOrUnbounded | None = None
    position: float | None = None
    rotation: float | None = None
    bounded: bool = False
    covariance: tuple[float, ...] | UnsetType | None = UNSET
    factor: tuple[float, ...] | UnsetType = UNSET
    direction: MotionDirection | UnsetType | None = UNSET


class SinceAnchor(_Strict, frozen=True):
    """The tube of one window at this pose; all but the name are null without an anchor.

    Attributes
    ----------
    window
        As calibrated, e.g. ``10s``.
    anchor_seq, seconds, metres
        The anchor, a pose that is taken as known, and how far it is back.
    lower, upper
        Bounds of x, as in ``MotionInterval``, of the motion since the anchor: all six hold at every
        pose of the window at once, in both scopes. null beyond the window.
    position, rotation
        Radii around the estimated motion since the anchor that hold the true one, m and rad: at
        every pose of the window at once. null beyond the window.
    bounded
        Whether they are numbers.
    """

    window: str
    anchor_seq: int | None = None
    seconds: float | None = None
    metres: float | None = None
    lower: SixOrUnbounded | None = None
    upper: SixOrUnbounded | None = None
    position: float | None = None
    rotation: float | None = None
    bounded: bool = False


class MotionRecord(_Strict, frozen=True):
    """The output for one pose: one JSON line.

    Attributes
    ----------
    seq, stamp_ns, status, reasons, pose
        As in the records of ``run``; ``pose`` is ``T_world_body``.
    motion, since_anchor
        One entry for each calibrated horizon, and one for each window.
    novelty
        How fast and rough the motion is, as a share of the limit (see ``drift``); null within a
        second after a break.
    covariance
        No key unless asked for (``integrated``): of the step that ends here, in the body frame, for
        a filter that adds steps up; null without a step.
    """

    seq: int
    stamp_ns: int
    status: Status
    reasons: tuple[MotionReason, ...]
    pose: RecordedPose | None
    motion: tuple[MotionInterval, ...]
    since_anchor: tuple[SinceAnchor, ...]
    novelty: float | None
    covariance: tuple[float, ...] | UnsetType | None = UNSET


class MotionHeader(
    Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="motion", tag_field="kind"
):
    """Data shared by all records that follow.

    Attributes
    ----------
    schema_version, software
        Version of this format, and the program that wrote it.
    calibration, digest
        Name and digest of ``motion.json``.
    horizons, windows
        The calibrated horizons and windows.
    confidence, rule, scope, statement
        What the intervals are stated with, and what that means in words.
    """

    schema_version: Literal[1] = 1
    software: str = f"cvo-edge {VERSION}"
    calibration: str
    digest: str
    horizons: tuple[str, ...]
    windows: tuple[str, ...]
    confidence: float
    rule: MotionRule
    scope: Scope
    statement: str


def motion_header(calibration: MotionCalibration, level: Level) -> MotionHeader:
    """Return the header for records at one level."""
    file = calibration.file
    return MotionHeader(
        calibration=file.name,
        digest=file.digest,
        horizons=tuple(spec.horizon for spec in file.horizons),
        windows=tuple(spec.window for spec in file.windows),
        confidence=level.confidence,
        rule=level.rule,
        scope=level.scope,
        statement=calibration.statement(level),
    )


def recorded(values: Sequence[float]) -> RecordedPose | None:
    """Return seven numbers as the pose of a record; None for a pose that is missing."""
    x, y, z, a, b, c, d = values
    return RecordedPose((x, y, z), (a, b, c, d)) if x == x else None


def six(values: Sequence[float]) -> SixOrUnbounded:
    """Return six bounds; None for those that are infinite."""
    a, b, c, d, e, f = (value if math.isfinite(value) else None for value in values)
    return a, b, c, d, e, f


def nothing_of(calibration: MotionCalibration) -> tuple[MotionInterval, ...]:
    """Return what is written of each horizon where there is no motion."""
    direction = None if calibration.pointed else UNSET
    names = [each.spec.horizon for each in calibration.horizons]
    return tuple(MotionInterval(name, direction=direction) for name in names)


def pointed(motion: MotionInterval) -> MotionInterval:
    """Return a motion of an estimator without a scale, with its direction instead of metres."""
    if motion.t_m is None or motion.lower is None or motion.upper is None:
        return replace(motion, direction=None)
    length = math.hypot(*motion.t_m)
    direction = None
    if length >= LEAST_STEPS:
        x, y, z = (each / length for each in motion.t_m)
        direction = MotionDirection((x, y, z), motion.position)
    lower, upper = (None,) * 3 + motion.lower[3:], (None,) * 3 + motion.upper[3:]
    bounded = None not in (*lower[3:], *upper[3:], motion.rotation)
    bounded &= direction is None or direction.radius is not None
    return replace(
        motion,
        metres=None,
        t_m=None,
        lower=lower,
        upper=upper,
        position=None,
        bounded=bounded,
        direction=direction,
    )


def finite(value: float) -> float | None:
    """Return a radius; None if it is infinite."""
    return value if value < math.inf else None


def with_tube(since: SinceAnchor, widths: Array) -> SinceAnchor:
    """Return what is known of an anchor with half-widths and the two radii (8,) of its tube."""
    *upper, position, rotation = widths.tolist()
    return SinceAnchor(
        since.window,
        since.anchor_seq,
        since.seconds,
        since.metres,
        six([-value for value in upper]),
        six(upper),
        finite(position),
        finite(rotation),
        max(*upper, position, rotation) < math.inf,
    )
