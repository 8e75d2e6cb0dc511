"""Lines, marks and text on an enlarged canvas, drawn with OpenCV only.

Everything is drawn at twice the size, to a sixteenth of a pixel, and then halved. Places are pixels
of the picture, as ``fixed`` converts them.
"""

from __future__ import annotations

import struct
import zlib
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvo_edge.files import SOFTWARE, write_whole

Colour = tuple[int, int, int]

SCALE, BITS = 2, 4
TEXT: Colour = (60, 60, 60)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
# Signature and the chunk IHDR.
_PNG_HEAD = 33
_SAMPLE = "truth inside in 50 of 50 frames"


def fixed(points: ArrayLike) -> NDArray[np.int32]:
    """Pixels of the picture (n, 2) -> fixed-point pixels of the enlarged canvas."""
    return np.asarray(np.round(np.asarray(points, np.float64) * (SCALE << BITS)), np.int32)


def draw_line(
    canvas: NDArray[np.uint8], points: NDArray[np.int32], colour: Colour, width: float
) -> None:
    """Draw a line through fixed-point places (n, 2); ``width`` in pixels."""
    cv2.polylines(canvas, [points], False, colour, round(width * SCALE), cv2.LINE_AA, BITS)


def draw_dot(canvas: NDArray[np.uint8], place: NDArray[np.int32], colour: Colour) -> None:
    """Draw a dot at a fixed-point place (2,)."""
    cv2.circle(
        canvas, place.tolist(), round(2.5 * SCALE * (1 << BITS)), colour, -1, cv2.LINE_AA, BITS
    )


def draw_ring(canvas: NDArray[np.uint8], place: NDArray[np.int32], colour: Colour) -> None:
    """Draw a ring about a fixed-point place (2,)."""
    reach = 6 * SCALE << BITS
    cv2.circle(canvas, place.tolist(), reach, colour, round(1.5 * SCALE), cv2.LINE_AA, BITS)


def draw_cross(canvas: NDArray[np.uint8], place: NDArray[np.int32], colour: Colour) -> None:
    """Draw a cross at a fixed-point place (2,)."""
    reach = 4 * SCALE << BITS
    for diagonal in ((reach, reach), (reach, -reach)):
        draw_line(
            canvas, np.stack([place - diagonal, place + diagonal]).astype(np.int32), colour, 2.0
        )


def draw_swatch(canvas: NDArray[np.uint8], x: float, y: float, colour: Colour) -> None:
    """Draw the legend's sample of an area, from ``x`` to the right, about ``y``."""
    corners = fixed([(x, y - 7), (x + 30, y - 7), (x + 30, y + 7), (x, y + 7)])
    cv2.fillPoly(canvas, [corners], colour, cv2.LINE_AA, BITS)


def draw_text(
    canvas: NDArray[np.uint8],
    text: str,
    place: tuple[float, float],
    size: float,
    *,
    align: float = 0.0,
    bold: bool = False,
    colour: Colour = TEXT,
) -> None:
    """Draw text on a baseline; ``align`` 0 puts ``place`` at its left end, 0.5 middle, 1 right.

    ``size`` is the mean width of a character in pixels, because the fonts of OpenCV 4 and 5 differ
    in width and must fit the same layout.
    """
    thickness = 4 if bold else 2
    scale = size * SCALE / _character_width(thickness)
    width = cv2.getTextSize(text, _FONT, scale, thickness)[0][0]
    origin = (round(place[0] * SCALE - align * width), round(place[1] * SCALE))
    cv2.putText(canvas, text, origin, _FONT, scale, colour, thickness, cv2.LINE_AA)


@cache
def _character_width(thickness: int) -> float:
    """Return the mean width of a character at scale 1, in pixels."""
    return float(cv2.getTextSize(_SAMPLE, _FONT, 1.0, thickness)[0][0]) / len(_SAMPLE)


def write_png(path: str | Path, picture: NDArray[np.uint8]) -> None:
    """Write a picture as PNG; raises SinkError if the file cannot be written."""
    encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
    # PNG, section 11.3.3: a chunk is its length, kind, data and checksum.
    text = b"tEXtSoftware\0" + SOFTWARE.encode()
    chunk = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
    write_whole(Path(path), encoded[:_PNG_HEAD] + chunk + encoded[_PNG_HEAD:])
