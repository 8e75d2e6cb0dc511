"""Poses of ROS bags: topics of poses, and the transforms of ``/tf`` and ``/tf_static``."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.trajectories.interpolation import Mask, Stamps, Track
from cvo_edge.trajectories.poses import quaternion_pose
from cvo_export.datasets.bag import Bag, stamp_ns

Array = NDArray[np.float64]

TF, _TF_STATIC = "/tf", "/tf_static"
_TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
_INVALID = np.full(7, np.nan)


class Transforms:
    """The tree of coordinate frames in a bag."""

    def __init__(self, bag: Bag) -> None:
        """Read ``/tf`` and ``/tf_static``.

        Raises SourceError if a frame has two parents.
        """
        self._bag = bag
        self._parents: dict[str, str] = {}
        self._static: dict[str, Array] = {}
        self._tracks: dict[str, Track] = {}
        found: dict[str, tuple[list[int], list[Array]]] = {}
        for topic in (TF, _TF_STATIC):
            if bag.topics.get(topic) not in _TF_TYPES:
                continue
            for message in bag.messages(topic):
                for each in message.content.transforms:
                    frame = self._add(each)
                    pose = _pose(each.transform.translation, each.transform.rotation)
                    if topic == _TF_STATIC:
                        self._static[frame] = pose
                        continue
                    stamps, poses = found.setdefault(frame, ([], []))
                    stamps.append(stamp_ns(each.header) or message.received_ns)
                    poses.append(pose)
        for frame, (stamps, poses) in found.items():
            # Some publishers repeat transforms that never change, with stamps of their own.
            if np.array_equal(poses, np.tile(poses[0], (len(poses), 1))):
                self._static.setdefault(frame, poses[0])
            else:
                self._tracks[frame] = Track.of(stamps, poses)

    def _add(self, transform: Any) -> str:
        parent = frame_name(transform.header.frame_id)
        frame = frame_name(transform.child_frame_id)
        if self._parents.setdefault(frame, parent) != parent:
            raise SourceError(
                f"{self._bag.path}: expected one parent of each frame in {TF}, found {parent} and "
                f"{self._parents[frame]} for {frame}"
            )
        return frame

    @property
    def move(self) -> bool:
        """Whether any transform changes."""
        return bool(self._tracks)

    def root(self, frame: str) -> str:
        """Return the topmost frame above a frame: itself if it has no parent."""
        return self._up(frame)[-1]

    def moves(self, world: str, frame: str) -> bool:
        """Whether the transform between two joined frames changes."""
        up, down = self._paths(world, frame)
        return any(each in self._tracks for each in (*up, *down))

    def joins(self, world: str, frame: str) -> bool:
        """Whether transforms join two frames."""
        return world == frame or self.root(world) == self.root(frame)

    def between(
        self, world: str, frame: str, stamps_ns: Stamps, bound_ns: int
    ) -> tuple[Array, Mask]:
        """Return ``T_world_frame`` (m, 4, 4) at stamps (m,), and whether all stamps are near.

        Raises SourceError if no transforms join the frames.
        """
        if not self.joins(world, frame):
            raise SourceError(
                f"{self._bag.path}: expected transforms from {world} to {frame}, found none; "
                f"frames in {TF}: {self.frames}"
            )
        near = np.ones(len(stamps_ns), dtype=bool)
        sides = []
        for path in self._paths(world, frame):
            T = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
            for each in path:
                if each in self._tracks:
                    edge, close = self._tracks[each].at(stamps_ns, bound_ns)
                    near &= close
                else:
                    edge, _ = Track.of([0], [self._static[each]]).at(np.zeros(1, np.int64), 0)
                T = edge @ T
            sides.append(T)
        above_world, above_frame = sides
        return rigid_inverse(above_world) @ above_frame, near

    def span(self, world: str, frame: str) -> Stamps:
        """Return the first and the last stamp of the transforms between two joined frames."""
        up, down = self._paths(world, frame)
        tracks = [self._tracks[each] for each in (*up, *down) if each in self._tracks]
        return np.array(
            [max(each.stamps_ns[0] for each in tracks), min(each.stamps_ns[-1] for each in tracks)]
        )

    @property
    def frames(self) -> str:
        """All frames, as text."""
        return ", ".join(sorted({*self._parents, *self._parents.values()})) or "none"

    def _up(self, frame: str) -> list[str]:
        path = [frame]
        while (parent := self._parents.get(path[-1])) is not None:
            if parent in path:
                raise SourceError(
                    f"{self._bag.path}: expected a tree of frames in {TF}, found a circle at "
                    f"{parent}"
                )
            path.append(parent)
        return path

    def _paths(self, world: str, frame: str) -> tuple[list[str], list[str]]:
        """Return the frames from each one up to their first common frame, without that."""
        up, down = self._up(world), self._up(frame)
        return [each for each in up if each not in down], [each for each in down if each not in up]


class BodyPoses(NamedTuple):
    """The poses of a topic: their track, the world's frame and the moving frame, or ``""``."""

    track: Track
    world: str
    body: str


def pose_topic(bag: Bag, wanted: str | None, tf: bool) -> str:
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


def read_poses(bag: Bag, topic: str) -> BodyPoses:
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
            poses.append(_pose(content.transform.translation, content.transform.rotation))
        else:
            pose = getattr(content.pose, "pose", content.pose)
            poses.append(_pose(pose.position, pose.orientation))
    if len(frames) > 1:
        listed = ", ".join(" to ".join(filter(None, pair)) for pair in frames)
        raise SourceError(
            f"{bag.path}: expected poses of one frame in one world in {topic}, found {listed}"
        )
    ((world, body),) = frames
    return BodyPoses(Track.of(stamps, poses), world, body)


def frame_name(frame: str) -> str:
    """Return a frame's name without the slash that ROS 1 may put before it."""
    return str(frame).lstrip("/")


def rigid_inverse(T: Array) -> Array:
    """Return the inverse of rigid transforms (..., 4, 4)."""
    inverse = np.zeros_like(T)
    inverse[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, 3:] = -inverse[..., :3, :3] @ T[..., :3, 3:]
    inverse[..., 3, 3] = 1.0
    return inverse


def _pose(position: Any, rotation: Any) -> Array:
    t = np.array([position.x, position.y, position.z])
    q = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    found = quaternion_pose(t, q)
    return _INVALID if found is None else found
