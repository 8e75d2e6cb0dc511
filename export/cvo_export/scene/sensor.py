"""Camera effects on a rendering: motion blur, lighting and noise.

Between these steps, images are float32 grey levels of shape (height, width, 3), BGR.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.geometry import quaternion_to_matrix
from cvo_export.scene.renderer import Floats, Image, Pinhole

Levels = NDArray[np.float32]

_BLUR_DEPTH_M = 2.2  # typical distance from the camera to the scene
_BLUR_SAMPLES = 16


def motion_blur(
    sharp: Image, opening: Floats, pose: Floats, closing: Floats, intrinsics: Pinhole
) -> Levels:
    """Blur a rendering along the path of the image centre while the shutter is open.

    Parameters
    ----------
    sharp
        Shape (height, width, 3), uint8: rendered from ``pose``.
    opening, pose, closing
        Shape (7,) each, ``T_world_camera`` when the shutter opens, halfway, and when it closes.
    intrinsics
        fx, fy, cx, cy in pixels.
    """
    kernel = streak(_image_shift(opening, pose, closing, intrinsics), _BLUR_SAMPLES)
    blurred = cv2.filter2D(sharp, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, np.float32)


def _image_shift(opening: Floats, pose: Floats, closing: Floats, intrinsics: Pinhole) -> Floats:
    """Return the motion of the image centre while the shutter is open, shape (2,), pixels."""
    seen = pose[:3] + _BLUR_DEPTH_M * quaternion_to_matrix(pose[3:])[:, 2]
    ends = [(seen - end[:3]) @ quaternion_to_matrix(end[3:]) for end in (opening, closing)]
    moved = ends[1][:2] / ends[1][2] - ends[0][:2] / ends[0][2]
    return np.asarray(moved * intrinsics[:2])


def streak(shift: Floats, samples: int) -> Levels:
    """Return the blur kernel of a uniform motion by ``shift`` pixels; symmetric, with sum 1.

    ``shift`` (2,) is right and down, in pixels. ``samples`` is the number of points along the path;
    with fewer than one per pixel, the streak has gaps.
    """
    radius = math.ceil(float(np.abs(shift).max()) / 2)
    kernel = np.zeros((2 * radius + 3, 2 * radius + 3), np.float32)
    for x, y in np.linspace(-0.5, 0.5, samples)[:, None] * shift + radius + 1:
        column, row = int(x), int(y)
        weights = np.outer((1 - y + row, y - row), (1 - x + column, x - column))
        kernel[row : row + 2, column : column + 2] += weights / samples
    return kernel


class Light:
    """Brightness, tint, vignetting and slow exposure drift of one recording."""

    def __init__(self, rng: np.random.Generator) -> None:
        warmth = rng.normal(0, 0.06)
        tint = np.exp([-warmth, rng.normal(0, 0.02), warmth])
        self._gain = rng.uniform(0.82, 1.15) * tint
        self._vignette = rng.uniform(0.1, 0.5)
        self._drift, self._drift_phase = rng.uniform(0.02, 0.08), rng.uniform(0, 2 * math.pi)

    def shade(self, image: Levels, time_s: float, intrinsics: Pinhole) -> None:
        """Shade an image taken at ``time_s``, in place; intrinsics are fx fy cx cy in pixels."""
        fx, fy, cx, cy = intrinsics
        height, width = image.shape[:2]
        x, y = (np.arange(width) - cx) / fx, (np.arange(height) - cy) / fy
        exposure = 1 + self._drift * math.sin(0.7 * time_s + self._drift_phase)
        image *= np.outer(exposure * (1 - self._vignette * x**2), self._gain).astype(np.float32)
        image *= (1 - self._vignette * y**2).astype(np.float32)[:, None, None]


def add_noise(image: Levels, rng: np.random.Generator) -> None:
    """Add read noise of 1.2 grey levels and shot noise that grows with the signal, in place."""
    deviation = np.sqrt(image * np.float32(0.03) + np.float32(1.44))
    deviation *= rng.standard_normal(image.shape, dtype=np.float32)
    image += deviation
