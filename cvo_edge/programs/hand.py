"""A hand before the lens, drawn onto frames: the demonstration of the alarm.

The hand is seven capsules (segments with a thickness) of one skin colour, lit from the upper left,
a little out of focus. Lengths are shares of the image's height; points are x + iy, y down.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvo_edge.input.frame import Frame

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

# Frames that show any part of the hand, and how many of them it takes to come and to go.
HAND = range(12, 24)
_MOVING = 3

_SKIN_BGR = (140.0, 175.0, 235.0)
# Ends and radius about the middle of the palm: four fingers, thumb, palm, wrist.
_CAPSULES = (
    (-0.13 - 0.12j, -0.26 - 0.45j, 0.052),
    (-0.05 - 0.15j, -0.09 - 0.56j, 0.055),
    (0.04 - 0.15j, 0.08 - 0.54j, 0.053),
    (0.12 - 0.11j, 0.23 - 0.43j, 0.045),
    (-0.13 + 0.10j, -0.37 - 0.12j, 0.060),
    (-0.01 - 0.03j, 0.01 + 0.10j, 0.190),
    (0.02 + 0.10j, 0.10 + 0.80j, 0.140),
)
# Where the middle of the palm rests, as shares of width and height, and how far below it begins.
_REST, _WAY = (0.60, 0.66), 1.0
# Towards the light (right, down, to the camera), and the share of light that comes from all sides.
_LIGHT, _AMBIENT = (-0.45, -0.55, 0.70), 0.45
_THICK, _SOFT, _NOISE = 0.07, 0.015, 4.0


def covered(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield the frames of a clip; those of ``HAND`` show a hand."""
    for number, frame in enumerate(frames):
        reach = min(1.0, (number - HAND.start + 1) / _MOVING, (HAND.stop - number) / _MOVING)
        if frame.image is not None and reach > 0.0:
            yield replace(frame, image=with_hand(frame.image, reach, number))
        else:
            yield frame


def with_hand(image: NDArray[Any], reach: float, seed: int) -> Image:
    """Draw a hand onto a BGR image (height, width, 3); the same arguments give the same pixels.

    ``reach`` is how far it has come from below: 0 is out of the picture, 1 is at rest. ``seed`` is
    that of the sensor's noise on the hand.
    """
    height, width = image.shape[:2]
    x = (np.arange(width) + 0.5 - _REST[0] * width) / height
    y = (np.arange(height) + 0.5) / height - _REST[1] - _WAY * (1.0 - reach)
    points = np.add.outer(1j * y, x)
    depth, relief = np.full(points.shape, -np.inf), np.zeros(points.shape)
    for start, end, radius in _CAPSULES:
        along = end - start
        share = np.clip(((points - start) / along).real, 0.0, 1.0)
        distance = np.abs(points - start - share * along)
        depth = np.maximum(depth, radius - distance)
        rounded = np.sqrt(np.maximum(1.0 - (distance / radius) ** 2, 0.0))
        relief = np.maximum(relief, min(radius, _THICK) * rounded)
    opacity = np.clip(0.5 + depth / _SOFT, 0.0, 1.0)[..., np.newaxis]
    skin = np.multiply.outer(_lit(relief * height), _SKIN_BGR)
    skin += _NOISE * np.random.default_rng(seed).standard_normal(skin.shape)
    return np.asarray(np.clip(np.rint(image + opacity * (skin - image)), 0, 255), np.uint8)


def _lit(relief: Array) -> Array:
    """Brightness of a surface (height, width) whose relief is given in pixels."""
    down, right = np.gradient(relief)
    facing = (_LIGHT[2] - _LIGHT[0] * right - _LIGHT[1] * down) / np.sqrt(1.0 + right**2 + down**2)
    return np.asarray(_AMBIENT + (1.0 - _AMBIENT) * np.maximum(facing, 0.0), np.float64)
