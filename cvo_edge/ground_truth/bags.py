"""Poses in ROS bags for the frames of a run, which are elsewhere and have stamps."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from cvo_edge.errors import SourceError
from cvo_edge.ground_truth.found import Found, interpolated
from cvo_edge.input.bag_images import image_topic
from cvo_edge.trajectories.bag import Bag, find_bags, is_bag
from cvo_edge.trajectories.bag_poses import OPTIONS, camera_poses
from cvo_edge.trajectories.bag_transforms import frame_name
from cvo_edge.trajectories.path_options import path_options
from cvo_edge.trajectories.trajectory import Skipped

_FORMAT = "rosbag:"


def bag_options(given: str) -> tuple[Path, dict[str, str]] | None:
    """Return the path and the options of a bag, or None for what names none.

    ``given`` is ``rosbag:PATH,option=value...`` as in training, also without ``rosbag:``. Raises
    UsageError for unknown options.
    """
    text = given
    if given.startswith(_FORMAT) and not os.path.exists(given):  # noqa: PTH110 - of any length
        text = given.removeprefix(_FORMAT)
    elif not (is_bag(Path(given)) or is_bag(Path(given.partition(",")[0]))):
        return None
    place, options = path_options("rosbag", text, OPTIONS)
    return Path(place), options


def find_bag_poses(place: Path, options: Mapping[str, str]) -> Found:
    """Read the poses of the camera in a bag, or in the only bag of a folder.

    Raises
    ------
    UsageError
        The library ``rosbags`` is not installed.
    SourceError
        There is no bag or more than one, it is damaged, or it leaves no choice or several.
    """
    (_, path), *others = find_bags(place).items()
    if others:
        names = ", ".join([path.name, *(other.name for _, other in others)])
        raise SourceError(
            f"{place}: expected the bag that the frames are of, found {names}; name one, e.g. "
            f"{path}"
        )
    bag = Bag(path)
    poses = camera_poses(bag, options, partial(_camera_frame, bag, options.get("image")))
    skipped = Skipped()
    for track in poses.tracks:
        invalid = int((~track.valid).sum())
        if invalid == len(track.valid):
            raise SourceError(f"{path}: expected poses ({poses.text}), found no valid one")
        if invalid:
            bad_ns = int(track.stamps_ns[~track.valid][0])
            at = f"{path.name}, pose at {bad_ns // 10**9}.{bad_ns % 10**9:09d}"
            skipped.add("invalid pose", at, invalid)
    first_ns, last_ns = poses.span_ns.tolist()
    return interpolated(poses.at, first_ns, last_ns, skipped, poses.text)


def _camera_frame(bag: Bag, wanted: str | None) -> str:
    """Return the frame of the bag's images, which is the camera's."""
    try:
        topic = image_topic(bag, wanted)
    except SourceError as error:
        raise SourceError(f"{error}; or name the camera's frame, e.g. frame=camera") from None
    return frame_name(bag.first(topic).header.frame_id)
