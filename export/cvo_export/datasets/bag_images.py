"""Images and cameras of ROS bags: ``sensor_msgs/Image``, ``CompressedImage``, ``CameraInfo``."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import Distortion
from cvo_edge.errors import SourceError
from cvo_edge.input.bag_images import FORMS, message_size
from cvo_edge.input.decoding import decode_image
from cvo_edge.trajectories.bag import Bag
from cvo_export.datasets.base import NO_DISTORTION, Intrinsics, Lens

Image = NDArray[np.uint8]

_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


_MODELS: dict[str, Distortion] = {
    "plumb_bob": "radial_tangential",
    "rational_polynomial": "radial_tangential",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
}


def message_image(message: Any) -> Image | None:
    """Return the image in a message, (height, width, 3) BGR; None if it cannot be decoded.

    16 bits keep their upper eight, as in ``decode_image``.
    """
    if not hasattr(message, "encoding"):
        return decode_image(message.data.tobytes())
    size = message_size(message)
    if size is None:
        return None
    form, (height, width) = FORMS[message.encoding], size
    rows = message.data[: message.step * height].reshape(height, message.step)
    pixels = np.ascontiguousarray(rows[:, : width * form.channels * form.depth])
    if form.depth == 2:
        wide = pixels.view(">u2" if message.is_bigendian else "<u2")
        pixels = (wide >> 8).astype(np.uint8)
    if form.channels > 1:
        pixels = pixels.reshape(height, width, form.channels)
    if form.conversion is None:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, form.conversion), np.uint8)
    except cv2.error:
        return None


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
    # ROS 1 names the matrices by capital letters.
    K, D, P = (
        np.asarray(getattr(info, name, getattr(info, name.upper(), ())), dtype=np.float64)
        for name in "kdp"
    )
    rectified = "rect" in images.removesuffix("/compressed").rpartition("/")[2]
    values = P[[0, 5, 2, 6]] if rectified else K[[0, 4, 2, 5]]
    if not values[:2].any():
        return None
    intrinsics = Intrinsics(*values.tolist()).checked(f"{bag.path}: {topic}")
    if rectified or not D.any():
        return intrinsics, NO_DISTORTION
    model = _MODELS.get(info.distortion_model)
    count = 4 if model == "equidistant" else 5 if D.size <= 5 else 8
    if model is None or D[count:].any() or not np.isfinite(D).all():
        return None
    numbers = np.pad(D[:count], (0, max(0, count - D.size)))
    return intrinsics, Lens(model, tuple(numbers.tolist()))
