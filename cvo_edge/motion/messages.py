"""Messages of ROS 2 for the motion of an estimator, from records of ``annotate``.

A filter can take the motion of one step as a velocity: the residual of a step does not depend on
where the estimator believes to be, and its covariance ``integrated`` is made for adding up. The
estimator's pose has no covariance of ours, so that it is given without one, for viewers. The table
of ``cvo_edge.output.messages`` decides as it does of frames: a step that is not ``ok`` gives
neither.

The velocity is constant over the step dE of T seconds, xi = Log(dE) / T in SE(3), and the same in
the body frame at any time of the step. With a residual x of covariance Q at its end, dE Exp(x), it
has to first order the covariance

    J Q J^T / T^2,  J = I + ad/2 + ad^2/12 - ad^4/720

with ad that of Log(dE) = (rho, w): the inverse right Jacobian (Sola, Deray and Atchuthan 2018,
eq. 143 for SO(3); its series holds for SE(3)).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.motion.records import MotionHeader, MotionReason, MotionRecord
from cvo_edge.motion.relative import motion
from cvo_edge.output.messages import (
    DIAGNOSTICS,
    LEVELS,
    POSE_ALONE,
    Content,
    Message,
    diagnostics,
    quaternion,
    stamped,
    vector,
)
from cvo_edge.record import Status

Array = NDArray[np.float64]

TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
FRAME_ID, CHILD_FRAME_ID = "odom", "base_link"
_SMALL = 1e-4


class Velocity(NamedTuple):
    """Linear (m/s) and angular (rad/s) velocity in the body frame (6,), and its covariance."""

    twist: Array
    covariance: Array


def velocity_of(step: Array, seconds: float, covariance: Array) -> Velocity:
    """Return the velocity of a step (7,) and its covariance, from that of the step (6, 6)."""
    w = geometry.quaternion_log(step[3:])
    W, angle = _cross(w), float(np.linalg.norm(w))
    # (1 - (a/2) cot(a/2)) / a^2.
    share = 1.0 / 12.0
    if angle > _SMALL:
        share = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2
    rho = (np.eye(3) - 0.5 * W + share * W @ W) @ step[:3]
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = W
    ad[:3, 3:] = _cross(rho)
    square = ad @ ad
    J = np.eye(6) + ad / 2.0 + square / 12.0 - square @ square / 720.0
    return Velocity(np.concatenate([rho, w]) / seconds, J @ covariance @ J.T / seconds**2)


def motion_messages(
    records: Iterable[MotionRecord], header: MotionHeader, frame_id: str, child_frame_id: str
) -> Iterator[tuple[MotionRecord, list[Message]]]:
    """Yield each record with its messages; the diagnostics come first.

    Raises UsageError for records without the covariances of steps, and for stamps that ROS cannot
    hold.
    """
    before: MotionRecord | None = None
    for record in records:
        if record.covariance is msgspec.UNSET:
            raise UsageError(
                "motion: expected records with the covariances of steps, found none; annotate with "
                "--covariance integrated"
            )
        at = stamped(record.stamp_ns, frame_id, f"pose {record.seq}")
        found = [Message("/diagnostics", DIAGNOSTICS, _diagnostics(record, at, header))]
        if record.status is Status.OK and record.pose is not None:
            place = {
                "position": vector(np.array(record.pose.t_m)),
                "orientation": quaternion(np.array(record.pose.q_xyzw)),
            }
            found.append(Message("/cvo/pose_alone", POSE_ALONE, {"header": at, "pose": place}))
            if before is not None and record.covariance is not None:
                found.append(_velocity(before, record, child_frame_id))
        yield record, found
        if record.pose is not None and MotionReason.STAMP_NOT_LATER not in record.reasons:
            before = record


def _velocity(before: MotionRecord, record: MotionRecord, frame_id: str) -> Message:
    poses = [
        np.array([*each.pose.t_m, *each.pose.q_xyzw])
        for each in (before, record)
        if each.pose is not None
    ]
    covariance = np.array(record.covariance).reshape(6, 6)
    seconds = 1e-9 * (record.stamp_ns - before.stamp_ns)
    found = velocity_of(motion(*poses), seconds, covariance)
    twist = {"linear": vector(found.twist[:3]), "angular": vector(found.twist[3:])}
    content = {"twist": twist, "covariance": found.covariance.ravel().tolist()}
    header = stamped(record.stamp_ns, frame_id, f"pose {record.seq}")
    return Message("/cvo/twist", TWIST, {"header": header, "twist": content})


def _diagnostics(record: MotionRecord, at: Content, header: MotionHeader) -> Content:
    values = {"seq": str(record.seq)}
    if record.novelty is not None:
        values["novelty"] = f"{record.novelty:.4f}"
    for each in record.motion:
        if each.position is not None and each.rotation is not None:
            values[f"{each.horizon} position_m"] = f"{each.position:.6g}"
            values[f"{each.horizon} rotation_rad"] = f"{each.rotation:.6g}"
    said = ", ".join(record.reasons) or str(record.status)
    return diagnostics(at, header.calibration, LEVELS[record.status], said, values)


def _cross(v: Array) -> Array:
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


class _Kind(msgspec.Struct):
    kind: str | None = None


_HEADER, _RECORD = msgspec.json.Decoder(MotionHeader), msgspec.json.Decoder(MotionRecord)


def motion_header_of(path: str | os.PathLike[str]) -> MotionHeader | None:
    """Return the header of a file with records of motion; None for any other file.

    Raises SourceError for a header that is damaged.
    """
    try:
        with Path(path).open("rb") as stream:
            line = stream.readline()
        if msgspec.json.decode(line, type=_Kind).kind != "motion":
            return None
        return _HEADER.decode(line)
    except msgspec.ValidationError as error:
        raise SourceError(f"{path!s}: line 1 is not a header of motion: {error}") from None
    # Whoever reads the file as another kind says what is wrong.
    except (OSError, ValueError):
        return None


def read_motion_records(path: str | os.PathLike[str]) -> Iterator[MotionRecord]:
    """Yield the records after the header; an incomplete last line is skipped.

    Raises SourceError with the number of a line that is no record.
    """
    try:
        with Path(path).open("rb") as stream:
            for number, line in enumerate(stream, start=1):
                if not line.endswith(b"\n"):
                    return
                try:
                    if number > 1:
                        yield _RECORD.decode(line)
                except (msgspec.MsgspecError, UnicodeDecodeError) as error:
                    raise SourceError(
                        f"{path!s}: line {number} is not a record of motion: {error}"
                    ) from None
    except OSError as error:
        raise SourceError(f"{path!s}: cannot be read: {error.strerror}") from None
