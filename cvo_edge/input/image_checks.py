"""Checks of an image's size and colour against the images of the calibration.

A network computes a pose for any array of pixels. Images of another shape (cut, stretched, or a raw
buffer of luma and chroma) are not those of the calibrated camera; images of another size show the
same, unless they have fewer pixels than the network saw.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.input.frame_checks import Look
from cvo_edge.record import Reason

# A pixel has colour if its channels differ by more than this, in grey levels out of 255: chroma of
# a grey scene that was encoded stays below. An image has colour if this share of its pixels has:
# one of a dark room has more, one with a coloured clock over it less.
_CHROMA, _FEW = 8, 0.02
# The mean chroma of an image of which just that share has colour; one grey level of slack.
_CHROMA_MEAN = _CHROMA + _FEW * (255 - _CHROMA) + 1
# Images may be enlarged a little more than those of the calibration: sizes are whole pixels.
_ENLARGED = 1.02
# Resized images have whole rows and columns; some tools round these to even numbers.
ROUNDING_PX = 2.0


class KnownImages(NamedTuple):
    """The images that a bundle can use.

    Attributes
    ----------
    size
        Height and width, pixels.
    colour
        Whether images without colour are doubted.
    enlarged
        How often these images are enlarged in the model's input, at least 1.
    rounding_px
        Pixels by which a side may differ from that of the same shape.
    half
        Whether this is the size of files that were decoded at half of theirs, and no other will do.
    """

    size: tuple[int, int]
    colour: bool
    enlarged: float
    rounding_px: float
    half: bool = False

    def doubt(self, look: Look, enlarged: float) -> Reason | None:
        """Return why an image is none of these, or None.

        ``enlarged``: how often the image is enlarged in the model's input.
        """
        if not similar(look.size, self.size, self.rounding_px):
            return Reason.CAMERA_DIFFERS
        if self.half and look.size != self.size:
            return Reason.IMAGE_NOT_HALF
        if enlarged > _ENLARGED * self.enlarged:
            return Reason.IMAGE_TOO_SMALL
        return Reason.IMAGE_GREY if self.colour and not has_colour(look) else None


class StreamSizes:
    """The sizes (height, width) of a stream's images; pass every image once, in order.

    ``known`` is the size of the images of the calibration. A bundle may not state it: then the
    first image of the stream takes its place, and others differ from it for good.
    """

    def __init__(self, known: tuple[int, int] | None) -> None:
        self._known = self._first = known
        self._told: set[tuple[int, int]] = set()

    def doubts(self, look: Look | None) -> tuple[Reason, ...]:
        """Compare an image with the stream's first one, if the bundle states no size."""
        if look is None or self._known is not None:
            return ()
        self._first = self._first or look.size
        return () if look.size == self._first else (Reason.IMAGE_SIZE_CHANGED,)

    def remarks(self, look: Look | None) -> tuple[Reason, ...]:
        """Tell once of each other size than the known one."""
        if look is None or look.size in (self._first, *self._told):
            return ()
        self._told.add(look.size)
        return (Reason.IMAGE_RESIZED,)


def has_colour(look: Look) -> bool:
    """Whether more than a few pixels of the model's input have colour."""
    # So different means take more than a few pixels; usually, this saves the counting.
    if max(look.means) - min(look.means) > _CHROMA_MEAN:
        return True
    red, green, blue = look.sample.T
    highest = np.maximum(np.maximum(red, green), blue)
    chroma: NDArray[np.uint8] = highest - np.minimum(np.minimum(red, green), blue)
    return bool(np.count_nonzero(chroma > _CHROMA) > _FEW * chroma.size)


def similar(size: tuple[int, int], other: tuple[int, int], rounding_px: float) -> bool:
    """Whether images of two sizes (height, width) have the same shape, but for some pixels."""
    slack = rounding_px * max(*size, *other)
    return abs(size[0] * other[1] - size[1] * other[0]) <= slack
