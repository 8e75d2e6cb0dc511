"""Which frames of a recording to use: one for each step of motion, the sharpest.

The motion between two frames is the median displacement of tracked corners, in image widths. It is
summed over the recording; each time the sum passes a multiple of the step, a new window of frames
begins, and the sharpest frame of each window is used. A camera that stands still gives one frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[Any]

# Motion is measured in images of this width.
_WIDTH = 320
_CORNERS, _QUALITY, _APART_PX = 200, 0.01, 8
# Fewest corners that say anything, least share of them that a frame must show again.
_LEAST_CORNERS, _LEAST_SHARE = 12, 0.3
# A corner that is tracked back must return to within this distance.
_RETURN_PX = 1.0
# Smaller displacements are noise: a quarter of a pixel.
_STILL = 0.25 / _WIDTH
# Motion to a frame that shows almost nothing of the one before, in image widths.
LOST = 1.0


def small_grey(image: Image) -> Image:
    """Return an image (height, width, 3), BGR, in grey at the width that motion is measured at."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    height, width = grey.shape
    size = (_WIDTH, max(round(height * _WIDTH / width), 1))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))


def sharpness(image: Image) -> float:
    """Return the variance of the Laplacian of an image (height, width, 3), BGR."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def motion(before: Image, after: Image) -> float:
    """Return the motion between two small grey images, in image widths.

    ``LOST`` if ``after`` shows almost nothing of ``before``; 0 if ``before`` has no corners.
    """
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, _QUALITY, _APART_PX)
    if corners is None or len(corners) < _LEAST_CORNERS:
        return 0.0
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy())
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, there.copy())
    off = np.linalg.norm((back - corners).reshape(-1, 2), axis=1)
    good = (found.ravel() == 1) & (returned.ravel() == 1) & (off < _RETURN_PX)
    if good.sum() < max(_LEAST_SHARE * len(corners), _LEAST_CORNERS):
        return LOST
    moved = np.linalg.norm((there - corners).reshape(-1, 2)[good], axis=1)
    widths = float(np.median(moved)) / _WIDTH
    return widths if widths > _STILL else 0.0


def chosen(motions: Sequence[float], sharpnesses: Sequence[float], step: float) -> list[int]:
    """Return the frames to use, in order: the sharpest of each window of motion.

    ``motions`` (n,) are the motions from the frame before, in image widths; the first is ignored.
    """
    travelled = np.concatenate([[0.0], np.cumsum(motions[1:])])
    window = np.floor(travelled / step).astype(np.int64)
    best: dict[int, int] = {}
    for frame, number in enumerate(window.tolist()):
        if number not in best or sharpnesses[frame] > sharpnesses[best[number]]:
            best[number] = frame
    return sorted(best.values())


def fitting_step(
    recordings: Sequence[tuple[Sequence[float], Sequence[float]]], step: float, most: int
) -> float:
    """Return the least step, from ``step`` on, with which at most ``most`` frames are used.

    ``recordings`` holds motions and sharpnesses of each; every recording gives at least one frame.
    """
    while True:
        count = sum(len(chosen(*recording, step)) for recording in recordings)
        if count <= max(most, len(recordings)):
            return step
        # Windows without a frame, after a jump, need larger steps than the ratio.
        step *= max(count / most, 1.02)
