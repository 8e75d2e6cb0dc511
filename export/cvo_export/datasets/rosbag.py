"""ROS bags: a topic of images, and poses from a topic or from ``/tf``.

``PATH[,image=TOPIC][,pose=TOPIC][,camera=TOPIC][,world=FRAME][,frame=FRAME][,body=FRAME]``
``[,extrinsics=FILE]``. Without an option, the bag must leave one choice; errors list the
candidates. ``pose`` is a topic of ``PoseStamped``, ``PoseWithCovarianceStamped``,
``TransformStamped`` or ``Odometry``, or ``/tf``.

With ``/tf``, the pose is that of ``frame``, the camera's optical frame (by default the
``frame_id`` of the images), in ``world`` (by default the topmost frame).

A topic gives the poses of the frame that its messages name (``child_frame_id``) or ``body`` names;
the transforms in the bag lead from that frame to the camera. Messages that name no frame are taken
as the camera's. ``extrinsics`` is a file with the 4x4 matrix ``T_body_camera`` (metres) for what
the bag does not know; ``none`` takes the poses as the camera's.

Images and poses are compared by the stamps in their headers.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.pose import Pose
from cvo_edge.trajectories.poses import matrix_to_pose, read_pose_matrix
from cvo_edge.trajectories.tum import MAX_STAMP_DIFFERENCE_NS
from cvo_export.datasets.bag import Bag, find_bags
from cvo_export.datasets.bag_images import bag_camera, image_topic, message_image, message_size
from cvo_export.datasets.bag_poses import (
    TF,
    Transforms,
    frame_name,
    pose_topic,
    read_poses,
)
from cvo_export.datasets.base import PoseDataset, skipped_text
from cvo_export.datasets.folders import only_camera, path_options

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

_OPTIONS = ("image", "pose", "camera", "world", "frame", "body", "extrinsics")


class _Image(NamedTuple):
    """Where an image is: its bag, topic, and time and number of receipt; height and width."""

    bag: Bag
    topic: str
    received_ns: int
    number: int
    size: tuple[int, int]


class _Poses(NamedTuple):
    """``T_world_camera`` (n, 4, 4), whether a stamp was near, the world's frame, what was read."""

    T: Array
    near: NDArray[np.bool_]
    world: str
    text: str
    span: str


def open_rosbag(path: str) -> PoseDataset:
    """Read one bag, or all bags in a folder, which become sequences and must share a world frame.

    The poses beside an image's stamp are interpolated. Frames whose nearest pose is more than
    0.02 s away, with an invalid pose, an unreadable image or the stamp of another frame are left
    out and counted. Headers without a stamp count with the time of receipt.

    Raises UsageError for unknown options and SourceError if a bag is damaged, a topic is missing or
    ambiguous, bags have different cameras or worlds, or no frame has a pose.
    """
    place, options = path_options("rosbag", path, _OPTIONS)
    root = Path(place)
    images: list[_Image] = []
    poses: list[Array] = []
    stamps: list[int] = []
    names: list[str] = []
    sequence: list[str] = []
    skipped: Counter[str] = Counter()
    cameras, worlds, spans = {}, {}, []
    chosen = ""
    for name, bag_path in find_bags(root).items():
        bag = Bag(bag_path)
        topic = image_topic(bag, options.get("image"))
        found, stamps_ns, frame = _index(bag, topic, skipped)
        cameras[name] = bag_camera(bag, options.get("camera"), topic, frame, found[0].size)
        frame = frame_name(options.get("frame", frame))
        posed = _poses(bag, options, frame, stamps_ns)
        worlds[name] = posed.world
        chosen = chosen or f"images {topic}; poses {posed.text}"
        spans.append(f"images at {_span(stamps_ns)}, poses at {posed.span}")
        for image, stamp, T, near in zip(found, stamps_ns.tolist(), *posed[:2], strict=True):
            frame_id = f"{name}/{stamp // 10**9}.{stamp % 10**9:09d}"
            pose = matrix_to_pose(T) if near else None
            if not near:
                skipped[f"no pose within {MAX_STAMP_DIFFERENCE_NS / 1e9:g} s"] += 1
            elif pose is None:
                skipped["invalid pose"] += 1
            elif names and names[-1] == frame_id:
                skipped["stamp twice"] += 1
            else:
                images.append(image)
                poses.append(pose)
                stamps.append(stamp)
                names.append(frame_id)
                sequence.append(name)
    if not images:
        raise SourceError(
            f"{root}: expected frames with a pose, found none; {spans[0]}; {skipped_text(skipped)}"
        )
    if len(set(worlds.values())) > 1:
        listed = ", ".join(f"{world} in {name}" for name, world in worlds.items())
        raise SourceError(f"{root}: expected poses in one world frame, found {listed}")
    sequence_names = tuple(dict.fromkeys(sequence))
    dataset = PoseDataset(
        name=root.resolve().stem,
        poses=np.array(poses),
        sequence=np.array([sequence_names.index(each) for each in sequence]),
        sequence_names=sequence_names,
        frame_names=tuple(names),
        read_image=lambda index: _read(images[index]),
        image_size=lambda index: images[index].size,
        skipped=dict(skipped),
        stamps_ns=np.array(stamps),
        chosen=chosen,
    )
    camera = only_camera(root, cameras)
    return dataset if camera is None else replace(dataset, intrinsics=camera[0], lens=camera[1])


def _index(bag: Bag, topic: str, skipped: Counter[str]) -> tuple[list[_Image], Stamps, str]:
    """Return where the readable images are, their stamps in ascending order, and their frame."""
    rows: list[tuple[int, _Image]] = []
    frame = ""
    for message in bag.messages(topic):
        size = message_size(message.content)
        if size is None:
            skipped["unreadable image"] += 1
            continue
        frame = frame or frame_name(message.content.header.frame_id)
        place = _Image(bag, topic, message.received_ns, message.number, size)
        rows.append((message.stamp_ns, place))
    rows.sort(key=lambda row: row[0])
    return [image for _, image in rows], np.array([stamp for stamp, _ in rows]), frame


def _poses(bag: Bag, options: dict[str, str], frame: str, stamps_ns: Stamps) -> _Poses:
    bound = MAX_STAMP_DIFFERENCE_NS
    transforms = Transforms(bag)
    wanted = options.get("pose", TF if "world" in options else None)
    topic = pose_topic(bag, wanted, tf=transforms.move)
    if topic != TF:
        return _topic_poses(bag, topic, options, frame, stamps_ns, transforms)
    world = frame_name(options.get("world", transforms.root(frame)))
    T, near = transforms.between(world, frame, stamps_ns, bound)
    if not transforms.moves(world, frame):
        raise SourceError(
            f"{bag.path}: expected a camera that moves, found transforms from {world} to {frame} "
            f"that never change; name world= and frame= among {transforms.frames}"
        )
    text = f"{TF}, {world} to {frame}"
    if "extrinsics" in options:
        T, text = _with_extrinsics(T, options["extrinsics"], text)
    return _Poses(T, near, world, text, _span(transforms.span(world, frame)))


def _topic_poses(
    bag: Bag,
    topic: str,
    options: dict[str, str],
    frame: str,
    stamps_ns: Stamps,
    transforms: Transforms,
) -> _Poses:
    found = read_poses(bag, topic)
    T, near = found.track.at(stamps_ns, MAX_STAMP_DIFFERENCE_NS)
    body = frame_name(options.get("body", found.body))
    text = f"{topic}{f' of {body}' if body else ''}"
    if "extrinsics" in options:
        T, text = _with_extrinsics(T, options["extrinsics"], text)
    elif body and body != frame:
        if not transforms.joins(body, frame):
            raise SourceError(
                f"{bag.path}: expected transforms from {body}, which {topic} tracks, to the camera "
                f"{frame or '(unnamed)'}, found none; extrinsics=FILE gives the 4x4 matrix "
                "T_body_camera, extrinsics=none takes the poses as the camera's"
            )
        T_body_camera, close = transforms.between(body, frame, stamps_ns, MAX_STAMP_DIFFERENCE_NS)
        T, near, text = T @ T_body_camera, near & close, f"{text}, transformed to {frame}"
    return _Poses(T, near, found.world, text, _span(found.track.stamps_ns))


def _with_extrinsics(T_world_body: Array, name: str, text: str) -> tuple[Array, str]:
    if name == "none":
        return T_world_body, f"{text}, taken as the camera's"
    file = Path(name)
    if not file.is_file():
        raise SourceError(f"{file}: expected a file with a 4x4 matrix T_body_camera, found none")
    pose = read_pose_matrix(file)
    if pose is None:
        raise SourceError(
            f"{file}: expected a 4x4 matrix T_body_camera (rotation, metres), found other text"
        )
    return T_world_body @ Pose.from_array(pose).to_matrix(), f"{text}, extrinsics {file.name}"


def _read(image: _Image) -> NDArray[np.uint8]:
    found = message_image(image.bag.message(image.topic, image.received_ns, image.number))
    if found is None:
        raise SourceError(
            f"{image.bag.path}: expected an image in {image.topic} at {image.received_ns} ns, "
            "found a damaged one"
        )
    return found


def _span(stamps_ns: Stamps) -> str:
    return f"{stamps_ns[0] / 1e9:.3f} .. {stamps_ns[-1] / 1e9:.3f} s"
