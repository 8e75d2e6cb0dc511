"""Camera image -> the model's input, bit-identical on every machine.

It uses only exact integer operations: halving by averaging 2x2 pixels (``INTER_AREA`` at exactly
one half) and ``INTER_LINEAR_EXACT``. Other OpenCV resize modes differ between processors by a grey
level, which an 8-bit network amplifies. Halving first also keeps the linear step from skipping
pixels.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import LEAST_SIDE
from cvo_edge.input.view import View, crop_view
from cvo_edge.vocabulary import Crop

Image = NDArray[np.uint8]


def to_bgr8(image: object) -> Image | None:
    """Any camera image -> (height, width, 3) uint8 BGR, or None if it is not supported.

    Grey images (two dimensions or one channel) are repeated to three channels, alpha is dropped,
    and 16-bit values keep their upper eight bits.
    """
    if not isinstance(image, np.ndarray) or image.ndim not in (2, 3):
        return None
    if min(image.shape[:2]) < LEAST_SIDE:
        return None
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if image.dtype != np.uint8:
        return None
    if image.ndim == 2 or image.shape[2] == 1:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    if image.shape[2] == 4:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2BGR), dtype=np.uint8)
    return image if image.shape[2] == 3 else None


def halved(image: Image, height: int, width: int) -> Image:
    """Halve by rounded 2x2 means while sides are even and at least twice the target."""
    while (
        image.shape[0] % 2 == 0
        and image.shape[1] % 2 == 0
        and image.shape[0] >= 2 * height
        and image.shape[1] >= 2 * width
    ):
        half = (image.shape[1] // 2, image.shape[0] // 2)
        image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return image


def model_input(image_bgr: Image, height: int, width: int, crop: Crop) -> Image:
    """Image (any height, any width, 3) BGR -> (1, height, width, 3) RGB that it fills."""
    view = crop_view(image_bgr.shape[0], image_bgr.shape[1], height, width, crop)
    return viewed(image_bgr, view)[np.newaxis]


def viewed(image_bgr: Image, view: View) -> Image:
    """Image (any height, any width, 3) BGR -> what the model sees, (height, width, 3) RGB.

    The image is halved as often as possible, then resized by ``INTER_LINEAR_EXACT``.
    """
    part, place = view.part, view.place
    image = image_bgr[part.top : part.bottom, part.left : part.right]
    resized = _resized(image, *place.shape)
    if place.shape == (view.height, view.width):
        return resized
    # The network's padding would be darker than any image.
    bottom, right = view.height - place.bottom, view.width - place.right
    edges = place.top, bottom, place.left, right
    return np.asarray(cv2.copyMakeBorder(resized, *edges, cv2.BORDER_REPLICATE), dtype=np.uint8)


def _resized(image: Image, height: int, width: int) -> Image:
    """Image BGR -> (height, width, 3) RGB, contiguous."""
    image = halved(image, height, width)
    if image.shape[:2] == (height, width):
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    # OpenCV has vector code for four channels but not for three; the results are identical, and
    # it is faster even with both conversions.
    four = cv2.cvtColor(image, cv2.COLOR_BGR2RGBA)
    four = cv2.resize(four, (width, height), interpolation=cv2.INTER_LINEAR_EXACT)
    return np.asarray(cv2.cvtColor(four, cv2.COLOR_RGBA2RGB), dtype=np.uint8)


def selftest_image(height: int, width: int) -> Image:
    """Build the image of recipe ``ripples-1``, (height, width, 3) uint8 BGR, from integers only.

    Channel c of pixel (x, y) is ((x + 40 c)^2 + 2 y^2 + x y) // 64 mod 512, folded at 256. The
    smooth rings become finer towards the lower right, so that the resize is tested, too.
    """
    image = np.empty((height, width, 3), np.uint8)
    x = np.arange(width, dtype=np.int64)
    # Row by row, because the whole image in 64 bits would take more memory than a model.
    for y in range(height):
        for c in range(3):
            wave = ((x + 40 * c) ** 2 + 2 * y**2 + x * y) // 64 % 512
            image[y, :, c] = np.where(wave < 256, wave, 511 - wave)
    return image
