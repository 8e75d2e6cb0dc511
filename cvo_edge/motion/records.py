"""What is written of a pose: its motions over the calibrated horizons, each with an interval."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from enum import StrEnum
from typing import Literal

import numpy as np
from msgspec import UNSET, Struct, UnsetType
from numpy.typing import NDArray

from cvo_edge.estimate import RecordedPose, SixOrUnbounded, Status
from cvo_edge.motion.covariance import Shape, in_fixed_axes
from cvo_edge.motion.intervals import Intervals, Level, MotionCalibration
from cvo_edge.motion.trace import Rows
from cvo_edge.vocabulary import VERSION, MotionCovariance, MotionRule, Scope

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


class MotionReason(StrEnum):
    """Remarks on a pose; the comments give the status that goes with each of them."""

    POSE_MISSING = "pose_missing"  # invalid: the estimator gave no pose
    STAMP_NOT_LATER = "stamp_not_later"  # invalid: not later than the pose before; it is not used
    TRAJECTORY_STARTED = "trajectory_started"  # degraded: nothing came before
    GAP = "gap"  # degraded: too long after the pose before
    JUMP = "jump"  # degraded: further or more turned than the robot can move since the pose before
    MOTION_UNFAMILIAR = "motion_unfamiliar"  # degraded: faster or rougher than any calibrated drive
    RATE_DIFFERS = "rate_differs"  # ok: not the calibration's rate; horizons in frames lapse


class _Strict(Struct, frozen=True, forbid_unknown_fields=True):
    """Immutable; unknown keys are an error."""


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


class SinceAnchor(_Strict, frozen=True):
    """The tube of one window at this pose; all but the name are null without an anchor.

    Attributes
    ----------
    window
        As calibrated, e.g. ``10s``.
    anchor_seq, seconds, metres
        The anchor, a pose that is taken as known, and how far it is back.
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


def records_of(
    calibration: MotionCalibration,
    level: Level,
    rows: Rows,
    numbers: Sequence[int],
    reasons: Sequence[tuple[MotionReason, ...]],
    anchors: Integers,
    novelties: Sequence[float | None],
    ends: Integers,
    *,
    frames: bool,
    covariance: MotionCovariance | None = None,
    factors: Sequence[Array] | None = None,
) -> Iterator[MotionRecord]:
    """Yield the records of some rows.

    Parameters
    ----------
    calibration, level
        What to state.
    rows, numbers
        The trajectory, and the number of each row in its stream.
    reasons, anchors, novelties, ends
        Remarks, the row of the anchor (-1 without one), D over its limit (``drift``) and the row of
        each record, (m,).
    frames
        Whether horizons in frames apply.
    covariance
        What covariance to add.
    factors
        For each horizon what labels have made of its thresholds, (8,).
    """
    motions = []
    for index, each in enumerate(calibration.horizons):
        applies = frames or each.horizon.unit != "f"
        factor = None if factors is None else factors[index]
        found = each.intervals(rows, level, ends, factor) if applies else None
        shape = each.shape if covariance == "interval" else None
        motions.append(_motions(rows, numbers, each.spec.horizon, found, shape, factor))
    tubes = [
        _tube(
            rows, numbers, each.spec.window, anchors, ends, each.radii(rows, anchors, ends, level)
        )
        for each in calibration.windows
    ]
    steps: list[list[float]] | None = None
    if covariance == "integrated":
        steps = calibration.step_covariances(rows, ends).reshape(-1, 36).tolist()
    nothing = [MotionInterval(each.spec.horizon) for each in calibration.horizons]
    stamps, poses = rows.stamps_ns[ends].tolist(), rows.poses[ends].tolist()
    without = tuple(nothing)
    for place, (end, stamp, pose, why, novelty) in enumerate(
        zip(ends.tolist(), stamps, poses, reasons, novelties, strict=True)
    ):
        own = tuple(found.get(end, none) for found, none in zip(motions, nothing, strict=True))
        tube = tuple(each[place] for each in tubes)
        step = None if steps is None or not frames else _known(steps[place])
        if novelty is not None and novelty > 1.0:
            own, why = without, (MotionReason.MOTION_UNFAMILIAR, *why)
            tube = tuple(SinceAnchor(each.spec.window) for each in calibration.windows)
            step = None
        known = pose[0] == pose[0]
        yield MotionRecord(
            numbers[end],
            stamp,
            _status(known, own),
            why,
            RecordedPose(tuple(pose[:3]), tuple(pose[3:])) if known else None,
            own,
            tube,
            None if novelty is None else round(novelty, 4),
            UNSET if steps is None else step,
        )


def _known(values: list[float]) -> tuple[float, ...] | None:
    return tuple(values) if values[0] == values[0] else None


def _tube(
    rows: Rows,
    numbers: Sequence[int],
    name: str,
    anchors: Integers,
    ends: Integers,
    radii: Array,
) -> list[SinceAnchor]:
    """Return the tube of one window at each row."""
    seconds = 1e-9 * (rows.stamps_ns[ends] - rows.stamps_ns[anchors])
    metres = rows.path_m[ends] - rows.path_m[anchors]
    same = (anchors >= 0) & (rows.part[anchors] == rows.part[ends])
    return [
        SinceAnchor(name, numbers[anchor], time_s, path_m, *_finite(radius), radius[0] < math.inf)
        if known
        else SinceAnchor(name)
        for known, anchor, time_s, path_m, radius in zip(
            same.tolist(),
            anchors.tolist(),
            seconds.tolist(),
            metres.tolist(),
            radii.tolist(),
            strict=True,
        )
    ]


def _finite(values: list[float]) -> tuple[float | None, float | None]:
    position, rotation = (value if value < math.inf else None for value in values)
    return position, rotation


def _status(known: bool, motion: tuple[MotionInterval, ...]) -> Status:
    if not known:
        return Status.INVALID
    return Status.OK if any(each.bounded for each in motion) else Status.DEGRADED


def _motions(
    rows: Rows,
    numbers: Sequence[int],
    name: str,
    found: Intervals | None,
    shape: Shape | None,
    factor: Array | None,
) -> dict[int, MotionInterval]:
    """Return the motions over one horizon by the row at which they end."""
    if found is None:
        return {}
    seconds = 1e-9 * (rows.stamps_ns[found.end] - rows.stamps_ns[found.start])
    metres = rows.path_m[found.end] - rows.path_m[found.start]
    columns = (found.end, found.start, seconds, metres, found.moved, found.lower, found.upper)
    covariances: list[tuple[float, ...] | UnsetType] = [UNSET] * len(found.end)
    if shape is not None:
        fixed = in_fixed_axes(shape.covariance(found.scale), found.moved[:, 3:])
        covariances = [tuple(each) for each in fixed.reshape(-1, 36).tolist()]
    adapted = UNSET if factor is None else tuple(factor.tolist())
    motions: dict[int, MotionInterval] = {}
    for (end, start, time_s, path_m, moved, lower, upper), (position, rotation) in zip(
        zip(*(column.tolist() for column in columns), strict=True),
        found.radii.tolist(),
        strict=True,
    ):
        bounded = max(*upper, position, rotation) < math.inf
        motions[end] = MotionInterval(
            name,
            numbers[start],
            time_s,
            path_m,
            tuple(moved[:3]),
            tuple(moved[3:]),
            _six(lower),
            _six(upper),
            position if position < math.inf else None,
            rotation if rotation < math.inf else None,
            bounded,
            covariances[len(motions)],
            adapted,
        )
    return motions


def _six(values: list[float]) -> SixOrUnbounded:
    a, b, c, d, e, f = values
    if abs(a + b + c + d + e + f) < math.inf:
        return a, b, c, d, e, f
    finite = [value if math.isfinite(value) else None for value in values]
    return finite[0], finite[1], finite[2], finite[3], finite[4], finite[5]
