"""ROS bags: a topic of images, and poses from a topic or from ``/tf``.

``PATH[,image=TOPIC][,pose=TOPIC][,camera=TOPIC][,world=FRAME][,frame=FRAME][,body=FRAME]``
``[,extrinsics=FILE]``. Without an option, the bag must leave one choice; errors list the
candidates. ``cvo_edge.trajectories.bag_poses`` describes the options of poses.

Images and poses are compared by the stamps in their headers.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.input.bag_images import image_topic
from cvo_edge.input.ros_images import message_image, message_size
from cvo_edge.trajectories.bag import Bag, find_bags
from cvo_edge.trajectories.bag_poses import OPTIONS, camera_poses
from cvo_edge.trajectories.bag_transforms import frame_name
from cvo_edge.trajectories.interpolation import Stamps
from cvo_edge.trajectories.path_options import path_options
from cvo_edge.trajectories.poses import matrix_to_pose
from cvo_edge.trajectories.trajectory import Skipped
from cvo_edge.trajectories.tum import MAX_STAMP_DIFFERENCE_NS
from cvo_edge.vocabulary import Decode
from cvo_export.datasets.bag_cameras import bag_camera
from cvo_export.datasets.base import PoseDataset, skipped_text
from cvo_export.datasets.folders import only_camera
from cvo_export.datasets.frames import BITS

Array = NDArray[np.float64]


class _Image(NamedTuple):
    """Where an image is: its bag, topic, and time and number of receipt; height and width; bits."""

    bag: Bag
    topic: str
    received_ns: int
    number: int
    size: tuple[int, int]
    bits: int


def open_rosbag(path: str) -> PoseDataset:
    """Read one bag, or all bags in a folder, which become sequences and must share a world frame.

    The poses beside an image's stamp are interpolated. Frames whose nearest pose is more than
    0.02 s away, with an invalid pose, an unreadable image or the stamp of another frame are left
    out and counted. Headers without a stamp count with the time of receipt.

    Raises UsageError for unknown options and SourceError if a bag is damaged, a topic is missing or
    ambiguous, bags have different cameras or worlds, or no frame has a pose.
    """
    place, options = path_options("rosbag", path, OPTIONS)
    root = Path(place)
    images: list[_Image] = []
    poses: list[Array] = []
    stamps: list[int] = []
    names: list[str] = []
    sequence: list[str] = []
    skipped = Skipped()
    cameras, worlds, spans = {}, {}, []
    chosen = ""
    for name, bag_path in find_bags(root).items():
        bag = Bag(bag_path)
        topic = image_topic(bag, options.get("image"))
        found, stamps_ns, frame = _index(bag, topic, skipped)
        cameras[name] = bag_camera(bag, options.get("camera"), topic, frame, found[0].size)
        posed = camera_poses(bag, options, partial(frame_name, frame))
        worlds[name] = posed.world
        chosen = chosen or f"images {topic}; poses {posed.text}"
        spans.append(f"images at {_span(stamps_ns)}, poses at {_span(posed.span_ns)}")
        located = posed.at(stamps_ns)
        for image, stamp, T, near in zip(found, stamps_ns.tolist(), *located, strict=True):
            frame_id = f"{name}/{stamp // 10**9}.{stamp % 10**9:09d}"
            pose = matrix_to_pose(T) if near else None
            if not near:
                skipped.add(f"no pose within {MAX_STAMP_DIFFERENCE_NS / 1e9:g} s")
            elif pose is None:
                skipped.add("invalid pose", f"{bag.path.name}, image at {frame_id}")
            elif names and names[-1] == frame_id:
                skipped.add("stamp twice")
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
        read_half=lambda index: _read(images[index], "half"),
        image_size=lambda index: images[index].size,
        skipped=skipped,
        stamps_ns=np.array(stamps),
        chosen=chosen,
    )
    camera = only_camera(root, cameras)
    return dataset if camera is None else replace(dataset, intrinsics=camera[0], lens=camera[1])


def _index(bag: Bag, topic: str, skipped: Skipped) -> tuple[list[_Image], Stamps, str]:
    """Return where the readable images are, their stamps in ascending order, and their frame."""
    rows: list[tuple[int, _Image]] = []
    frame = ""
    for message in bag.messages(topic):
        size = message_size(message.content)
        if size is None:
            skipped.add("unreadable image")
            continue
        frame = frame or frame_name(message.content.header.frame_id)
        place = _Image(bag, topic, message.received_ns, message.number, size, BITS.get())
        rows.append((message.stamp_ns, place))
    rows.sort(key=lambda row: row[0])
    return [image for _, image in rows], np.array([stamp for stamp, _ in rows]), frame


def _read(image: _Image, decode: Decode = "full") -> NDArray[np.uint8]:
    message = image.bag.message(image.topic, image.received_ns, image.number)
    found = message_image(message, image.bits, decode)
    if found is None:
        raise SourceError(
            f"{image.bag.path}: expected an image in {image.topic} at {image.received_ns} ns, "
            "found a damaged one"
        )
    return found


def _span(stamps_ns: Stamps) -> str:
    return f"{stamps_ns[0] / 1e9:.3f} .. {stamps_ns[-1] / 1e9:.3f} s"
