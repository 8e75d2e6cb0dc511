"""What a message for other programs may say of a frame, and the messages of ROS 2.

A filter takes a number for a measurement, whatever it was meant to say: an infinite variance ends
in NaN, a variance of zero in certainty, and a pose that nobody vouches for in a wrong map. So every
sink for other programs asks ``spoken``, and nothing else decides:

| frame | pose and covariance | its status and reasons |
|---|---|---|
| ``ok``, bounded | as estimated | yes |
| ``ok``, unbounded | none, or with a stated large variance | yes |
| ``degraded`` | none, or with a stated large variance | yes |
| ``invalid`` | none | yes |

There is no ``nav_msgs/Odometry``: it holds a twist, and a filter would fuse its zeros as standing
still. The motion of an estimator follows the same table: its velocity has a covariance, and only an
``ok`` step has one (``cvo_edge.motion.messages``). Messages are nested dicts with the fields of the
ROS definitions, so that they can be built and tested without ROS.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.output.records import Header
from cvo_edge.pose import Pose
from cvo_edge.record import Status

Array = NDArray[np.float64]
Content = dict[str, Any]

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSE_ALONE = "geometry_msgs/msg/PoseStamped"
TRANSFORM = "tf2_msgs/msg/TFMessage"
MARKERS = "visualization_msgs/msg/MarkerArray"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
IMAGE = "sensor_msgs/msg/CompressedImage"

_LARGEST_SECOND = 2**31
_CUBE, _ADD, _DELETE_ALL = 1, 0, 3
_COLOUR = {"r": 0.1, "g": 0.5, "b": 1.0, "a": 0.3}
LEVELS = {Status.OK: 0, Status.DEGRADED: 1, Status.INVALID: 2}


@dataclass(frozen=True, eq=False)
class Placement:
    """Where the estimates are to be seen from, and what is said of a frame without bounds.

    Attributes
    ----------
    frame_id, child_frame_id
        Names of the frames that a pose maps to and from.
    T_camera_base, T_map_world
        Pose of ``child_frame_id`` in the camera, and of the world in ``frame_id``; None: the same.
    unknown_variance
        Variance (m^2 and rad^2) that a pose without bounds is given; None: no pose is given.
    """

    frame_id: str
    child_frame_id: str
    T_camera_base: Pose | None = None
    T_map_world: Pose | None = None
    unknown_variance: float | None = None

    @classmethod
    def of(cls, header: Header) -> Placement:
        """Return the frames of a header: the camera in its world."""
        return cls(header.frame_id, header.child_frame_id)

    def __post_init__(self) -> None:
        """Raise UsageError for a variance that a filter would take for something else."""
        variance = self.unknown_variance
        if variance is not None and not 1.0 <= variance <= 1e12:
            raise UsageError(
                f"variance: expected a number from 1 to 1e12 for frames without bounds, found "
                f"{variance:g}"
            )


class Spoken(NamedTuple):
    """A pose ``T_map_base`` that may be given, and its finite covariance (6, 6) in the map."""

    pose: Pose
    covariance: Array


def spoken(estimate: PoseInterval, placement: Placement) -> Spoken | None:
    """Return the pose that a message may give, by the table of this module, or None."""
    if estimate.status is Status.INVALID or estimate.pose is None:
        return None
    base, outer = placement.T_camera_base, placement.T_map_world
    pose = estimate.pose_of(base, outer)
    if estimate.vouched:
        covariance = estimate.covariance(T_camera_base=base, T_map_world=outer)
        # A degree of freedom without width would be taken for certain.
        if np.isfinite(covariance).all() and np.all(np.diag(covariance) > 0.0):
            return Spoken(pose, covariance)
    if placement.unknown_variance is None:
        return None
    return Spoken(pose, np.diag(np.full(6, placement.unknown_variance)))


class Message(NamedTuple):
    """A topic, the type of its messages, and the content of one."""

    topic: str
    type: str
    content: Content


def ros_messages(estimate: PoseInterval, placement: Placement, shared: Header) -> Iterator[Message]:
    """Yield the messages of one frame; the diagnostics come first.

    Raises UsageError for a frame without a stamp, or with one that ROS cannot hold.
    """
    header = ros_header(estimate, placement.frame_id)
    yield Message("/diagnostics", DIAGNOSTICS, _diagnostics(estimate, header, shared))
    said = spoken(estimate, placement)
    yield Message("/cvo/box", MARKERS, _box(estimate, header, placement, drawn=said is not None))
    if said is None:
        return
    position, orientation = vector(said.pose.t_m), quaternion(said.pose.q_xyzw)
    pose = {"position": position, "orientation": orientation}
    covariance = {"pose": pose, "covariance": said.covariance.ravel().tolist()}
    yield Message("/cvo/pose", POSE, {"header": header, "pose": covariance})
    yield Message("/cvo/pose_alone", POSE_ALONE, {"header": header, "pose": pose})
    transform = {
        "header": header,
        "child_frame_id": placement.child_frame_id,
        "transform": {"translation": position, "rotation": orientation},
    }
    yield Message("/tf", TRANSFORM, {"transforms": [transform]})


class StoredImage(NamedTuple):
    """An image as it is stored; ``encoding`` is ``jpeg`` or ``png``."""

    encoding: str
    data: bytes


def ros_image(estimate: PoseInterval, placement: Placement, image: StoredImage) -> Message:
    """Return the frame's image as it is stored."""
    header = ros_header(estimate, placement.child_frame_id)
    content = {"header": header, "format": image.encoding, "data": image.data}
    return Message("/cvo/image", IMAGE, content)


def ros_header(estimate: PoseInterval, frame_id: str) -> Content:
    """Return a ``std_msgs/Header`` with the frame's stamp.

    Raises UsageError for a frame without a stamp, or with one that ROS cannot hold.
    """
    where = estimate.source or f"frame {estimate.seq}"
    if estimate.stamp_ns is None:
        raise UsageError(
            f"stamp: expected one for every frame, {where} has none; give --fps or --stamps"
        )
    return stamped(estimate.stamp_ns, frame_id, where)


def stamped(stamp_ns: int, frame_id: str, where: str) -> Content:
    """Return a ``std_msgs/Header``; raises UsageError for a stamp that ROS cannot hold."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    # A node must answer an image with any stamp that ROS gives it, which may be below zero.
    if not -_LARGEST_SECOND <= seconds < _LARGEST_SECOND:
        raise UsageError(
            f"stamp: expected one from 1901 to 2038, as ROS holds them, found {stamp_ns} ns at "
            f"{where}"
        )
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame_id}


def _diagnostics(estimate: PoseInterval, header: Content, shared: Header) -> Content:
    values = {"seq": str(estimate.seq), "source": estimate.source}
    values["stamps"] = shared.stamps or "source"
    values |= {f"{stage}_ms": f"{value:.3f}" for stage, value in estimate.latency_ms.items()}
    if estimate.drift.state != "unknown":
        values["drift"] = estimate.drift.state
    if estimate.novelty is not None:
        values["novelty"] = f"{estimate.novelty:.4f}"
    unbounded = estimate.status is Status.OK and not estimate.bounded
    said = [*estimate.reasons, *(["unbounded"] if unbounded else [])]
    level = 1 if unbounded else LEVELS[estimate.status]
    message = ", ".join(said) or str(estimate.status)
    return diagnostics(header, shared.bundle, level, message, values)


def diagnostics(
    header: Content, name: str, level: int, message: str, values: Mapping[str, str]
) -> Content:
    """Return a ``diagnostic_msgs/DiagnosticArray`` with one status."""
    status = {
        "level": level,
        "name": f"cvo-edge: {name}",
        "message": message,
        "hardware_id": "",
        "values": [{"key": key, "value": value} for key, value in values.items()],
    }
    return {"header": header, "status": [status]}


def _box(estimate: PoseInterval, header: Content, placement: Placement, *, drawn: bool) -> Content:
    """Return markers that replace those of the frame before by the set of the camera's position."""
    outer = placement.T_map_world or Pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    markers = [_marker(header, 0, _DELETE_ALL, outer, np.zeros(3))]
    if drawn and estimate.bounded:
        for number, (low, high) in enumerate(estimate.position_boxes().transpose(0, 2, 1)):
            centre = outer.then(Pose(0.5 * (low + high), np.array([0.0, 0.0, 0.0, 1.0])))
            markers.append(_marker(header, number, _ADD, centre, high - low))
    return {"markers": markers}


def _marker(header: Content, number: int, action: int, pose: Pose, size: Array) -> Content:
    return {
        "header": header,
        "ns": "position of the camera",
        "id": number,
        "type": _CUBE,
        "action": action,
        "pose": {"position": vector(pose.t_m), "orientation": quaternion(pose.q_xyzw)},
        "scale": vector(size),
        "color": _COLOUR,
    }


def vector(values: Array) -> Content:
    """Return a ``geometry_msgs/Vector3`` or ``Point``."""
    return dict(zip("xyz", values.tolist(), strict=True))


def quaternion(q_xyzw: Array) -> Content:
    """Return a ``geometry_msgs/Quaternion``."""
    return dict(zip("xyzw", q_xyzw.tolist(), strict=True))
