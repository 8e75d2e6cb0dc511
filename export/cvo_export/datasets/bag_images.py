"""Images and cameras of ROS bags: ``sensor_msgs/Image``, ``CompressedImage``, ``CameraInfo``."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import Distortion
from cvo_edge.errors import SourceError
from cvo_edge.input.decoding import MAX_PIXELS, decode_image, image_size
from cvo_export.datasets.bag import Bag
from cvo_export.datasets.base import NO_DISTORTION, Intrinsics, Lens

Image = NDArray[np.uint8]

_RAW, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


class _Form(NamedTuple):
    """Bytes of a number, numbers of a pixel, and OpenCV's conversion to BGR."""

    depth: int
    channels: int
    conversion: int | None


# Names of sensor_msgs/image_encodings.h. OpenCV names a Bayer pattern by its first two pixels.
_FORMS: dict[str, _Form] = {
    "bgr8": _Form(1, 3, None),
    "8UC3": _Form(1, 3, None),
    "rgb8": _Form(1, 3, cv2.COLOR_RGB2BGR),
    "bgra8": _Form(1, 4, cv2.COLOR_BGRA2BGR),
    "rgba8": _Form(1, 4, cv2.COLOR_RGBA2BGR),
    "bgr16": _Form(2, 3, None),
    "rgb16": _Form(2, 3, cv2.COLOR_RGB2BGR),
    "mono8": _Form(1, 1, cv2.COLOR_GRAY2BGR),
    "8UC1": _Form(1, 1, cv2.COLOR_GRAY2BGR),
    "mono16": _Form(2, 1, cv2.COLOR_GRAY2BGR),
    "yuv422": _Form(1, 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": _Form(1, 2, cv2.COLOR_YUV2BGR_YUY2),
} | {
    f"bayer_{pattern}{8 * depth}": _Form(depth, 1, conversion)
    for pattern, conversion in (
        ("rggb", cv2.COLOR_BayerRGGB2BGR),
        ("bggr", cv2.COLOR_BayerBGGR2BGR),
        ("gbrg", cv2.COLOR_BayerGBRG2BGR),
        ("grbg", cv2.COLOR_BayerGRBG2BGR),
    )
    for depth in (1, 2)
}

_MODELS: dict[str, Distortion] = {
    "plumb_bob": "radial_tangential",
    "rational_polynomial": "radial_tangential",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
}


def message_size(message: Any) -> tuple[int, int] | None:
    """Return height and width of the image in a message, or None if it cannot be decoded."""
    if not hasattr(message, "encoding"):
        return image_size(message.data.tobytes())
    form = _FORMS.get(message.encoding)
    height, width, step = int(message.height), int(message.width), int(message.step)
    if form is None or not 0 < height * width <= MAX_PIXELS:
        return None
    whole = step >= width * form.channels * form.depth and message.data.size >= step * height
    return (height, width) if whole else None


def message_image(message: Any) -> Image | None:
    """Return the image in a message, (height, width, 3) BGR; None if it cannot be decoded.

    16 bits keep their upper eight, as in ``decode_image``.
    """
    if not hasattr(message, "encoding"):
        return decode_image(message.data.tobytes())
    size = message_size(message)
    if size is None:
        return None
    form, (height, width) = _FORMS[message.encoding], size
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


def image_topic(bag: Bag, wanted: str | None) -> str:
    """Return the wanted topic, or the only one with colour or grey images.

    Of an image and its compressed copy, ``TOPIC/compressed``, the former is used.

    Raises SourceError if there is none or more than one, naming the candidates.
    """
    topics = bag.of_types((_RAW, _COMPRESSED))
    usable = [topic for topic in topics if message_size(bag.first(topic)) is not None]
    candidates = [each for each in usable if each.removesuffix("/compressed") == each]
    candidates += [
        each for each in usable if each not in candidates and _parent(each) not in candidates
    ]
    if wanted is not None:
        if wanted in usable:
            return wanted
        if wanted in topics:
            kind = _kind(bag, wanted)
            raise SourceError(
                f"{bag.path}: expected images of 8 or 16 bits in {wanted}, found {kind}"
            )
    elif len(candidates) == 1:
        return candidates[0]
    elif candidates:
        raise SourceError(
            f"{bag.path}: expected one topic of images, found {', '.join(candidates)}; choose one, "
            f"e.g. image={candidates[0]}"
        )
    described = ", ".join(f"{each} ({_kind(bag, each)})" for each in topics)
    raise SourceError(
        f"{bag.path}: expected a topic {wanted or 'of colour or grey images'}, found none; topics "
        f"of images: {described or 'none'}"
    )


def _parent(topic: str) -> str:
    return topic.rpartition("/")[0]


def _kind(bag: Bag, topic: str) -> str:
    first = bag.first(topic)
    return str(getattr(first, "encoding", getattr(first, "format", "")))


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
    base = _parent(images.removesuffix("/compressed"))
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
