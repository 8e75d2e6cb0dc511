"""A frame of a stream that goes wrong, and kinds that change it; see ``wrong_kinds``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple
from zlib import crc32

import cv2
import numpy as np
from altered import Alteration, Image, Random, shown

# Right frames before a stream freezes or tears: some motion has been seen.
LEAD = 10


class Moment(NamedTuple):
    """One frame of a stream that a kind changes.

    Attributes
    ----------
    image
        The right image, (height, width, 3), uint8, BGR.
    number
        Frames since the fault began, from 0.
    past
        The right images before this one, oldest first; at least ``Kind.start`` of them.
    other
        An image of the same recording from another time.
    fresh, fixed
        Random numbers that differ from frame to frame, and the same ones for every frame.
    """

    image: Image
    number: int
    past: Sequence[Image]
    other: Image
    fresh: Random
    fixed: Random


Change = Callable[[Moment], Image]


class Kind(NamedTuple):
    """A kind of frames.

    Attributes
    ----------
    family, name
        The name is unique among all kinds.
    change
        Maps a moment to the image that the bundle gets.
    start
        Right frames before the fault begins.
    fitted
        Whether an exporter may have fitted its alarm to this kind of noise.
    still
        Whether the picture stands still but for noise: what a hint about motion is for.
    """

    family: str
    name: str
    change: Change
    start: int = 0
    fitted: bool = False
    still: bool = False


def frame(kind: Kind, images: Sequence[Image], number: int, seed: int = 0) -> Image:
    """Return image ``number`` of a stream of right images as the kind shows it.

    Before ``kind.start`` it is the right image.
    """
    if number < kind.start:
        return images[number]
    key = [seed, crc32(kind.name.encode())]
    moment = Moment(
        image=images[number],
        number=number - kind.start,
        past=images[:number],
        other=images[(number + len(images) // 2) % len(images)],
        fresh=np.random.default_rng([*key, number]),
        fixed=np.random.default_rng(key),
    )
    return np.ascontiguousarray(kind.change(moment))


def each(alteration: Alteration) -> Change:
    """Change each image alone, with new random numbers."""
    return lambda moment: alteration(moment.image, moment.fresh)


def steady(alteration: Alteration) -> Change:
    """Change each image alone, in the same way throughout a stream: dirt stays where it is."""
    return lambda moment: alteration(moment.image, moment.fixed)


def light_noise(image: Image, random: Random) -> Image:
    """Add noise of one hundredth of the range: what a sensor adds anyway."""
    return shown(image + 2.55 * random.standard_normal(image.shape))


def as_jpeg(image: Image, quality: int) -> Image:
    """Code as JPEG and decode."""
    _, coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
