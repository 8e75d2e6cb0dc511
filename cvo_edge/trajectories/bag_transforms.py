"""The transforms of ROS bags: the tree of coordinate frames in ``/tf`` and ``/tf_static``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.trajectories.bag import Bag, stamp_ns
from cvo_edge.trajectories.interpolation import Mask, Stamps, Track
from cvo_edge.trajectories.poses import quaternion_pose

Array = NDArray[np.float64]

TF, _TF_STATIC = "/tf", "/tf_static"
_TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_INVALID = np.full(7, np.nan)


class Chain(NamedTuple):
    """The transforms between two frames.

    Each side leads from one of the frames up to the first frame that is above both; transforms that
    never change are matrices (4, 4).
    """

    above_world: Sequence[Track | Array]
    above_frame: Sequence[Track | Array]

    @property
    def tracks(self) -> list[Track]:
        """The transforms that change."""
        both = (*self.above_world, *self.above_frame)
        return [each for each in both if isinstance(each, Track)]

    def at(self, stamps_ns: Stamps, bound_ns: int) -> tuple[Array, Mask]:
        """Return ``T_world_frame`` (m, 4, 4) at stamps (m,), and whether all stamps are near."""
        near = np.ones(len(stamps_ns), dtype=bool)
        sides = []
        for side in self:
            T = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
            for each in side:
                edge = each
                if isinstance(each, Track):
                    edge, close = each.at(stamps_ns, bound_ns)
                    near &= close
                T = edge @ T
            sides.append(T)
        return _rigid_inverse(sides[0]) @ sides[1], near


class Transforms:
    """The tree of coordinate frames in a bag."""

    def __init__(self, bag: Bag) -> None:
        """Read ``/tf`` and ``/tf_static``.

        Raises SourceError if a frame has two parents.
        """
        self._bag = bag
        self._parents: dict[str, str] = {}
        self._edges: dict[str, Track | Array] = {}
        found: dict[str, tuple[list[int], list[Array]]] = {}
        for topic in (TF, _TF_STATIC):
            if bag.topics.get(topic) not in _TF_TYPES:
                continue
            for message in bag.messages(topic):
                for each in message.content.transforms:
                    frame = self._add(each)
                    pose = pose_of(each.transform.translation, each.transform.rotation)
                    if topic == _TF_STATIC:
                        self._edges[frame] = _matrix(pose)
                        continue
                    stamps, poses = found.setdefault(frame, ([], []))
                    stamps.append(stamp_ns(each.header) or message.received_ns)
                    poses.append(pose)
        for frame, (stamps, poses) in found.items():
            # Some publishers repeat transforms that never change, with stamps of their own.
            if np.array_equal(poses, np.tile(poses[0], (len(poses), 1))):
                self._edges.setdefault(frame, _matrix(poses[0]))
            else:
                self._edges[frame] = Track.of(stamps, poses)

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
        return any(isinstance(edge, Track) for edge in self._edges.values())

    def root(self, frame: str) -> str:
        """Return the topmost frame above a frame: itself if it has no parent."""
        return self._up(frame)[-1]

    def joins(self, world: str, frame: str) -> bool:
        """Whether transforms join two frames."""
        return world == frame or self.root(world) == self.root(frame)

    def between(self, world: str, frame: str) -> Chain:
        """Return the transforms from a frame to a world; raises SourceError if none join them."""
        if not self.joins(world, frame):
            raise SourceError(
                f"{self._bag.path}: expected transforms from {world} to {frame}, found none; "
                f"frames in {TF}: {self.frames}"
            )
        up, down = self._up(world), self._up(frame)
        return Chain(
            [self._edges[each] for each in up if each not in down],
            [self._edges[each] for each in down if each not in up],
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


def frame_name(frame: str) -> str:
    """Return a frame's name without the slash that ROS 1 may put before it."""
    return str(frame).lstrip("/")


def _rigid_inverse(T: Array) -> Array:
    """Return the inverse of rigid transforms (..., 4, 4)."""
    inverse = np.zeros_like(T)
    inverse[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, 3:] = -inverse[..., :3, :3] @ T[..., :3, 3:]
    inverse[..., 3, 3] = 1.0
    return inverse


def pose_of(position: Any, rotation: Any) -> Array:
    """Return the pose (7,) of a message's position and quaternion, NaN if it is invalid."""
    t = np.array([position.x, position.y, position.z])
    q = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    found = quaternion_pose(t, q)
    return _INVALID if found is None else found


def _matrix(pose: Array) -> Array:
    T, _ = Track.of([0], [pose]).at(np.zeros(1, np.int64), 0)
    return np.asarray(T[0], np.float64)
