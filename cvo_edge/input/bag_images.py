"""Topics of images in ROS bags: ``sensor_msgs/Image`` and ``CompressedImage``."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2

from cvo_edge.errors import SourceError
from cvo_edge.input.decoding import MAX_PIXELS, image_size
from cvo_edge.trajectories.bag import Bag

_RAW, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


class Form(NamedTuple):
    """Bytes of a number, numbers of a pixel, and OpenCV's conversion to BGR."""

    depth: int
    channels: int
    conversion: int | None


# Names of sensor_msgs/image_encodings.h. OpenCV names a Bayer pattern by its first two pixels.
FORMS: dict[str, Form] = {
    "bgr8": Form(1, 3, None),
    "8UC3": Form(1, 3, None),
    "rgb8": Form(1, 3, cv2.COLOR_RGB2BGR),
    "bgra8": Form(1, 4, cv2.COLOR_BGRA2BGR),
    "rgba8": Form(1, 4, cv2.COLOR_RGBA2BGR),
    "bgr16": Form(2, 3, None),
    "rgb16": Form(2, 3, cv2.COLOR_RGB2BGR),
    "mono8": Form(1, 1, cv2.COLOR_GRAY2BGR),
    "8UC1": Form(1, 1, cv2.COLOR_GRAY2BGR),
    "mono16": Form(2, 1, cv2.COLOR_GRAY2BGR),
    "yuv422": Form(1, 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": Form(1, 2, cv2.COLOR_YUV2BGR_YUY2),
} | {
    f"bayer_{pattern}{8 * depth}": Form(depth, 1, conversion)
    for pattern, conversion in (
        ("rggb", cv2.COLOR_BayerRGGB2BGR),
        ("bggr", cv2.COLOR_BayerBGGR2BGR),
        ("gbrg", cv2.COLOR_BayerGBRG2BGR),
        ("grbg", cv2.COLOR_BayerGRBG2BGR),
    )
    for depth in (1, 2)
}


def message_size(message: Any) -> tuple[int, int] | None:
    """Return height and width of the image in a message, or None if it cannot be decoded."""
    if not hasattr(message, "encoding"):
        return image_size(message.data.tobytes())
    form = FORMS.get(message.encoding)
    height, width, step = int(message.height), int(message.width), int(message.step)
    if form is None or not 0 < height * width <= MAX_PIXELS:
        return None
    whole = step >= width * form.channels * form.depth and message.data.size >= step * height
    return (height, width) if whole else None


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
