"""Points that two images share: corners of the first one, followed into the second and back."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Points = NDArray[np.float32]

# Corners that are asked for; their distance spreads them over the image.
_MOST = 400
_SPREAD = 0.6
# Of the strongest corner's smaller eigenvalue (Shi and Tomasi 1994).
_QUALITY = 0.01
# Side of the window that is followed, pixels; shortest side of the pyramid's top.
_WINDOW = 15
_TOP, _MOST_LEVELS = 30, 6
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.02)
# A point that is followed back has to come this near to where it was, pixels.
_BACK = 1.0
# Parts of an image whose brightness is compared, and the grey level below which a part is dark.
_PARTS, _DARK = (32, 24), 8.0
# Logarithm of a gain that makes no difference.
_SAME_GAIN = 0.02


class Tracks(NamedTuple):
    """The same points in two images, pixels, (n, 2) each."""

    first: Points
    second: Points


def corners(image: Grey) -> Points:
    """Return the corners (n, 2) of an image (height, width), well apart from each other."""
    height, width = image.shape
    apart = _SPREAD * math.sqrt(height * width / _MOST)
    found = cv2.goodFeaturesToTrack(image, _MOST, _QUALITY, apart)
    # None without any.
    return np.asarray([] if found is None else found, np.float32).reshape(-1, 2)


def as_bright(image: Grey, other: Grey) -> Grey:
    """Return an image with the exposure of another one.

    Lucas-Kanade takes a point's brightness for constant, and cameras change their exposure. The
    gain is the median over parts of the image: a shadow or a cover over some of it changes nothing.
    """
    parts = [
        cv2.resize(each, _PARTS, interpolation=cv2.INTER_AREA).astype(np.float64)
        for each in (image, other)
    ]
    seen = (parts[0] > _DARK) & (parts[1] > _DARK)
    if not seen.any():
        return image
    gain = float(np.median(parts[1][seen] / parts[0][seen]))
    if abs(math.log(gain)) < _SAME_GAIN:
        return image
    levels = np.rint(gain * np.arange(256))
    return np.asarray(cv2.LUT(image, np.minimum(levels, 255).astype(np.uint8)), np.uint8)


def follow(before: Grey, after: Grey, points: Points) -> Tracks:
    """Follow points (n, 2) from an image to the next one by pyramidal Lucas-Kanade, and back.

    Those that do not come back are left out (Kalal, Mikolajczyk and Matas 2010).
    """
    if not len(points):
        return Tracks(points, points)
    after = as_bright(after, before)
    shortest = min(before.shape)
    levels = max(0, min(_MOST_LEVELS, math.floor(math.log2(shortest / _TOP))))
    window = (_WINDOW, _WINDOW)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        points,
        np.empty_like(points),
        winSize=window,
        maxLevel=levels,
        criteria=_CRITERIA,
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        after,
        before,
        there,
        points.copy(),
        winSize=window,
        maxLevel=min(1, levels),
        criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    height, width = before.shape
    x, y = there.T
    kept = (found.ravel() > 0) & (returned.ravel() > 0)
    kept &= np.abs(back - points).max(axis=1) < _BACK
    kept &= (x >= 0.0) & (y >= 0.0) & (x <= width - 1.0) & (y <= height - 1.0)
    return Tracks(points[kept], np.asarray(there[kept], np.float32))
