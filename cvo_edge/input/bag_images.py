"""Topics of images in ROS bags: ``sensor_msgs/Image`` and ``CompressedImage``."""

from __future__ import annotations

from cvo_edge.errors import SourceError
from cvo_edge.input.ros_images import message_size
from cvo_edge.trajectories.bag import Bag

_RAW, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


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
