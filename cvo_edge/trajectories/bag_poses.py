"""Poses of a camera in ROS bags: from a topic of poses, or from ``/tf``.

The options are those of a data set, ``rosbag:PATH[,pose=TOPIC][,world=FRAME][,frame=FRAME]``
``[,body=FRAME][,extrinsics=FILE]``. Without an option, the bag must leave one choice; errors list
the candidates. ``pose`` is a topic of ``PoseStamped``, ``PoseWithCovarianceStamped``,
``TransformStamped`` or ``Odometry``, or ``/tf``.

With ``/tf``, the pose is that of ``frame``, the camera's optical frame (by default the
``frame_id`` of the images), in ``world`` (by default the topmost frame).

A topic gives the poses of the frame that its messages name (``child_frame_id``) or ``body`` names;
the transforms in the bag lead from that frame to the camera. Messages that name no frame are taken
as the camera's. ``extrinsics`` is a file with the 4x4 matrix ``T_body_camera`` (metres) for what
the bag does not know; ``none`` takes the poses as the camera's.

Poses are interpolated, and compared with images by the stamps in their headers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.pose import Pose
from cvo_edge.trajectories.bag import Bag
from cvo_edge.trajectories.bag_transforms import TF, Transforms, frame_name, pose_of
from cvo_edge.trajectories.interpolation import Mask, Stamps, Track
from cvo_edge.trajectories.poses import read_pose_matrix
from cvo_edge.trajectories.tum import MAX_STAMP_DIFFERENCE_NS

Array = NDArray[np.float64]

# Those of a data set: image and camera choose what its images and its camera are.
OPTIONS = ("image", "pose", "camera", "world", "frame", "body", "extrinsics")

_POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)


class CameraPoses(NamedTuple):
    """Poses of a camera over time.

    ``at`` maps stamps (m,) to ``T_world_camera`` (m, 4, 4) and whether a pose is near; ``world`` is
    the world's frame, ``text`` says what was read, and ``tracks`` are the motions in it.
    """

    at: Callable[[Stamps], tuple[Array, Mask]]
    world: str
    text: str
    tracks: list[Track]

    @property
    def span_ns(self) -> Stamps:
        """The first and the last stamp (2,) at which all motions have begun and none has ended."""
        first = max(track.stamps_ns[0] for track in self.tracks)
        return np.array([first, min(track.stamps_ns[-1] for track in self.tracks)])


def camera_poses(bag: Bag, options: Mapping[str, str], camera: Callable[[], str]) -> CameraPoses:
    """Read the poses of a camera; ``camera`` names its frame, unless the options do.

    Raises SourceError if there are no such poses, more than one choice, or nothing that leads to
    the camera, and what ``camera`` raises.
    """

    def frame() -> str:
        return frame_name(options["frame"]) if "frame" in options else camera()

    transforms = Transforms(bag)
    wanted = options.get("pose", TF if "world" in options else None)
    topic = _pose_topic(bag, wanted, tf=transforms.move)
    if topic == TF:
        found = _tf_poses(bag, options, frame(), transforms)
    else:
        found = _topic_poses(bag, topic, options, frame, transforms)
    if "extrinsics" not in options:
        return found
    T_body_camera, text = _extrinsics(options["extrinsics"])
    at = partial(_moved, found.at, T_body_camera)
    return found._replace(at=at, text=f"{found.text}, {text}")


def _tf_poses(
    bag: Bag, options: Mapping[str, str], frame: str, transforms: Transforms
) -> CameraPoses:
    world = frame_name(options.get("world", transforms.root(frame)))
    chain = transforms.between(world, frame)
    if not chain.tracks:
        raise SourceError(
            f"{bag.path}: expected a camera that moves, found transforms from {world} to {frame} "
            f"that never change; name world= and frame= among {transforms.frames}"
        )
    at = partial(chain.at, bound_ns=MAX_STAMP_DIFFERENCE_NS)
    return CameraPoses(at, world, f"{TF}, {world} to {frame}", chain.tracks)


def _topic_poses(
    bag: Bag,
    topic: str,
    options: Mapping[str, str],
    camera: Callable[[], str],
    transforms: Transforms,
) -> CameraPoses:
    found = _read_poses(bag, topic)
    at = partial(found.track.at, bound_ns=MAX_STAMP_DIFFERENCE_NS)
    body = frame_name(options.get("body", found.body))
    text = f"{topic}{f' of {body}' if body else ''}"
    poses = CameraPoses(at, found.world, text, [found.track])
    if "extrinsics" in options or not body or body == (frame := camera()):
        return poses
    if not transforms.joins(body, frame):
        raise SourceError(
            f"{bag.path}: expected transforms from {body}, which {topic} tracks, to the camera "
            f"{frame or '(unnamed)'}, found none; extrinsics=FILE gives the 4x4 matrix "
            "T_body_camera, extrinsics=none takes the poses as the camera's"
        )
    chain = transforms.between(body, frame)

    def to_camera(stamps_ns: Stamps) -> tuple[Array, Mask]:
        T, near = at(stamps_ns)
        T_body_camera, close = chain.at(stamps_ns, MAX_STAMP_DIFFERENCE_NS)
        return T @ T_body_camera, near & close

    return poses._replace(at=to_camera, text=f"{text}, transformed to {frame}")


def _moved(
    at: Callable[[Stamps], tuple[Array, Mask]], T_body_camera: Array, stamps_ns: Stamps
) -> tuple[Array, Mask]:
    T, near = at(stamps_ns)
    return T @ T_body_camera, near


def _extrinsics(name: str) -> tuple[Array, str]:
    """Return ``T_body_camera`` (4, 4), and what is to be said of it."""
    if name == "none":
        return np.eye(4), "taken as the camera's"
    file = Path(name)
    if not file.is_file():
        raise SourceError(f"{file}: expected a file with a 4x4 matrix T_body_camera, found none")
    pose = read_pose_matrix(file)
    if pose is None:
        raise SourceError(
            f"{file}: expected a 4x4 matrix T_body_camera (rotation, metres), found other text"
        )
    return Pose.from_array(pose).to_matrix(), f"extrinsics {file.name}"


class _BodyPoses(NamedTuple):
    """The poses of a topic: their track, the world's frame and the moving frame, or ``""``."""

    track: Track
    world: str
    body: str


def _pose_topic(bag: Bag, wanted: str | None, tf: bool) -> str:
    """Return the wanted topic of poses, the only one, or ``/tf`` if there is none and it moves.

    Raises SourceError if there is none or more than one, naming the candidates.
    """
    topics = bag.of_types(_POSE_TYPES)
    named = [*topics, *([TF] if tf else [])]
    listed = ", ".join(named) or "none"
    if wanted is not None:
        if wanted not in named:
            raise SourceError(
                f"{bag.path}: expected poses in {wanted}, found none; topics with poses: {listed}"
            )
        return wanted
    if len(topics) > 1:
        raise SourceError(
            f"{bag.path}: expected one topic of poses, found {listed}; choose one, e.g. "
            f"pose={named[0]}"
        )
    if not named:
        raise SourceError(
            f"{bag.path}: expected poses (PoseStamped, PoseWithCovarianceStamped, "
            f"TransformStamped, Odometry, or {TF} that moves), found none"
        )
    return named[0]


def _read_poses(bag: Bag, topic: str) -> _BodyPoses:
    """Read a topic of poses; raises SourceError if its frames change."""
    stamps: list[int] = []
    poses: list[Array] = []
    frames: dict[tuple[str, str], None] = {}
    for message in bag.messages(topic):
        content = message.content
        child = frame_name(getattr(content, "child_frame_id", ""))
        frames[frame_name(content.header.frame_id), child] = None
        stamps.append(message.stamp_ns)
        if hasattr(content, "transform"):
            poses.append(pose_of(content.transform.translation, content.transform.rotation))
        else:
            pose = getattr(content.pose, "pose", content.pose)
            poses.append(pose_of(pose.position, pose.orientation))
    if len(frames) > 1:
        listed = ", ".join(" to ".join(filter(None, pair)) for pair in frames)
        raise SourceError(
            f"{bag.path}: expected poses of one frame in one world in {topic}, found {listed}"
        )
    ((world, body),) = frames
    return _BodyPoses(Track.of(stamps, poses), world, body)
