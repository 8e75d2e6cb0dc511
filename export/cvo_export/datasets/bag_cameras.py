"""Cameras of ROS bags: ``sensor_msgs/CameraInfo``."""

from __future__ import annotations

from typing import Any

from cvo_edge.errors import SourceError
from cvo_edge.input.ros_images import lens_of, pinhole_of
from cvo_edge.trajectories.bag import Bag
from cvo_export.datasets.base import NO_DISTORTION, Intrinsics, Lens

_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


def bag_camera(
    bag: Bag, wanted: str | None, images: str, frame: str, size: tuple[int, int]
) -> tuple[Intrinsics, Lens] | None:
    """Return the camera of a topic of images with this frame and size (height, width).

    A wanted topic is used; ``none`` uses none. Otherwise it is ``camera_info`` beside the images,
    or the only CameraInfo with their frame and size. None if there is no such topic, it is not
    calibrated or its lens model is unknown. Images of a topic with ``rect`` in its last names are
    rectified: their camera is the projection P, without distortion.

    Raises SourceError if several or impossible cameras are found.
    """
    topics = bag.of_types((_CAMERA_INFO,))
    if wanted == "none":
        return None
    if wanted is not None:
        if wanted not in topics:
            raise SourceError(
                f"{bag.path}: expected a topic {wanted} with CameraInfo, found none; topics of "
                f"CameraInfo: {', '.join(topics) or 'none'}"
            )
        found = bag.first(wanted)
        if (found.height, found.width) != size:
            raise SourceError(
                f"{bag.path}: expected in {wanted} the camera of {size[1]}x{size[0]} images, found "
                f"that of {found.width}x{found.height}"
            )
        return _camera(bag, wanted, images)
    fitting = [topic for topic in topics if _fits(bag.first(topic), frame, size)]
    base = images.removesuffix("/compressed").rpartition("/")[0]
    beside = f"{base}/camera_info"
    if beside in fitting:
        return _camera(bag, beside, images)
    if len(fitting) > 1:
        raise SourceError(
            f"{bag.path}: expected one CameraInfo of the images, found {', '.join(fitting)}; "
            f"choose one, e.g. camera={fitting[0]}, or camera=none"
        )
    return _camera(bag, fitting[0], images) if fitting else None


def _fits(info: Any, frame: str, size: tuple[int, int]) -> bool:
    same = (info.height, info.width) == size
    return same and info.header.frame_id.lstrip("/") == frame


def _camera(bag: Bag, topic: str, images: str) -> tuple[Intrinsics, Lens] | None:
    info = bag.first(topic)
    rectified = "rect" in images.removesuffix("/compressed").rpartition("/")[2]
    values = pinhole_of(info, rectified=rectified)
    if values is None:
        return None
    intrinsics = Intrinsics(*values.tolist()).checked(f"{bag.path}: {topic}")
    found = None if rectified else lens_of(info)
    if rectified or (found is not None and found[0] == "none"):
        return intrinsics, NO_DISTORTION
    return None if found is None else (intrinsics, Lens(*found))
