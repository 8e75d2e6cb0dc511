"""What is written of each step: JSON lines, or a trajectory in the form of TUM."""

from __future__ import annotations

import math
from typing import Literal

import msgspec
import numpy as np
from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from cvo_edge import geometry
from cvo_edge.camera import Camera
from cvo_edge.frontend.steps import Step, StepReason
from cvo_edge.motion.records import MotionHeader, MotionInterval, MotionReason, MotionRecord
from cvo_edge.output.sinks import tum_line
from cvo_edge.record import Status
from cvo_edge.trajectories.tum import FORM
from cvo_edge.vocabulary import VERSION

# Columns of the trajectory, by which intervals may be scaled.
COLUMNS = ("inliers", "parallax", "rotation_deviation", "direction_deviation")
# Of a pose without a step before it.
_NO_STEP = (1.0, 1.0, math.pi, math.pi)


class StepHeader(
    Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="odometry", tag_field="kind"
):
    """Data shared by all records that follow.

    Attributes
    ----------
    schema_version, software
        Version of this format, and the program that wrote it.
    camera
        The camera.
    scale
        The trajectory that lengths of steps come from; null: steps have none.
    motion
        No key without ``--motion``: the calibration of the intervals, and what they promise.
    """

    schema_version: Literal[1] = 1
    software: str = f"cvo-edge {VERSION}"
    camera: Camera
    scale: str | None
    motion: MotionHeader | UnsetType = UNSET


class StepRecord(Struct, frozen=True, forbid_unknown_fields=True):
    """The motion of the camera from the frame before to this one: one JSON line.

    Attributes
    ----------
    seq, stamp_ns, source, status
        As in the records of ``run``.
    reasons
        Remarks on the step.
    q_xyzw
        Rotation that takes vectors of this camera frame to the one before; null for a lost step.
    direction
        The camera's position in the frame before, as a unit vector; null without parallax.
    length_m
        Length of the step; null unless ``--scale`` gives it.
    parallax_px
        Median length of what a rotation alone leaves of the points' motion, pixels.
    tracks, inliers
        Points that both images share, and those that agree with the motion.
    rotation_deviation, direction_deviation
        Standard deviations (rad) by the curvature of the loss: too small by factors, but larger
        where errors are larger.
    motion, novelty
        No keys without ``--motion``: intervals on the motion over each calibrated horizon, as
        ``annotate`` gives them for the steps added up.
    """

    seq: int
    stamp_ns: int | None
    source: str
    status: Status
    reasons: tuple[StepReason | MotionReason, ...]
    q_xyzw: tuple[float, float, float, float] | None
    direction: tuple[float, float, float] | None
    length_m: float | None
    parallax_px: float | None
    tracks: int
    inliers: int
    rotation_deviation: float | None
    direction_deviation: float | None
    motion: tuple[MotionInterval, ...] | UnsetType = UNSET
    novelty: float | UnsetType | None = UNSET


# The front end says itself that a step is lost or the first one.
_SAID = (MotionReason.POSE_MISSING, MotionReason.TRAJECTORY_STARTED)


def with_intervals(record: StepRecord, found: MotionRecord) -> StepRecord:
    """Return a record with the intervals on the motions that end at its frame."""
    more = tuple(each for each in found.reasons if each not in _SAID)
    return replace(
        record,
        status=found.status,
        reasons=(*record.reasons, *more),
        motion=found.motion,
        novelty=found.novelty,
    )


def columns_of(step: Step) -> dict[str, float]:
    """Return the columns of a step, by which intervals may be scaled; nan for a lost one."""
    numbers: tuple[float, ...] = _NO_STEP
    if (motion := step.motion) is not None:
        numbers = (float(motion.inliers), motion.parallax_px, *motion.deviations)
    elif np.isnan(step.pose[0]):
        numbers = (math.nan,) * len(COLUMNS)
    return dict(zip(COLUMNS, numbers, strict=True))


def record_of(step: Step) -> StepRecord:
    """Return the record of a step."""
    motion = step.motion
    common = (step.seq, step.stamp_ns, step.source, step.status, step.reasons)
    if motion is None:
        return StepRecord(*common, None, None, None, None, step.tracks, 0, None, None)
    a, b, c, d = geometry.matrix_to_quaternion(motion.R).tolist()
    direction, deviation = None, None
    if motion.direction is not None:
        x, y, z = motion.direction.tolist()
        direction, deviation = (x, y, z), motion.deviations[1]
    return StepRecord(
        *common,
        (a, b, c, d),
        direction,
        step.length_m,
        motion.parallax_px,
        step.tracks,
        motion.inliers,
        motion.deviations[0],
        deviation,
    )


def json_heading(camera: Camera, scale: str | None, motion: MotionHeader | UnsetType) -> bytes:
    """Return the first of JSON lines."""
    return json_line(StepHeader(camera=camera, scale=scale, motion=motion))


def json_line(record: StepHeader | StepRecord) -> bytes:
    """Return a JSON line."""
    return msgspec.json.encode(record) + b"\n"


def tum_heading(camera: Camera, scale: str | None) -> bytes:
    """Return the comments before a trajectory; the last one names the columns."""
    header = msgspec.json.encode(camera).decode()
    return (
        f"# software: cvo-edge {VERSION}\n# camera: {header}\n"
        f"# scale: {'none, steps with a direction count as 1' if scale is None else scale}\n"
        f"# {FORM} {' '.join(COLUMNS)}\n"
    ).encode()


def tum_row(step: Step) -> bytes:
    """Return the line of a step with a stamp; its pose is nan if the step is lost."""
    columns = " ".join(f"{number:.6g}" for number in columns_of(step).values())
    line = tum_line(step.stamp_ns or 0, step.pose).decode().rstrip("\n")
    return f"{line} {columns}\n".encode()
