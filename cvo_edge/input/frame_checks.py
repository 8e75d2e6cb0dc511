"""Checks that a frame and its stream must pass before an interval is given.

A frame check looks at one image. It also applies in calibration and evaluation, which exclude the
frames it flags, so that the guarantee covers exactly the frames that pass. A stream check compares
a frame with earlier ones and applies only to running streams. Both use the model's input, already
halved and resized, so they take a tenth of a millisecond.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.input.repetition import Digest, Repetition
from cvo_edge.record import Reason

Image8 = NDArray[np.uint8]

# Every eighth pixel of every eighth row: 768 pixels at 256x192.
SAMPLE_STEP = 8
# Grey levels out of 255. Noise behind a lens cap rarely exceeds the first. In an overexposed image
# more than half of all values reach the second. An image without contrast has a standard deviation
# below the third; that of a normal image is ten times as large.
_BLACK, _SATURATED, _FLAT = 20, 250, 4.0
# Share of bright pixels tolerated in a black image: hot pixels, or a time overlay.
_FEW = 0.02
# A black image is at most so bright, a saturated one at least: half of it is saturated. One grey
# level of slack is for rounding.
_BLACK_MEAN = _BLACK + _FEW * (255 - _BLACK) + 1
_SATURATED_MEAN = _SATURATED / 2 - 1
# An older frame says where the camera was, not where it is.
_STALE_MS = 1000.0
# 64 bits hold nanoseconds from 1970 up to the year 2262.
_END_NS = 2**63


class Look:
    """What the checks need of an image. Take it before inference empties the processor's caches.

    From the model's input ``tensor``, (1, height, width, 3) uint8 RGB. ``size``: (height, width) of
    the original image; ``sample``: some pixels of the tensor, (n, 3); ``means``, ``deviations``:
    theirs by channel; ``digest``: what is compared with other frames.
    """

    def __init__(self, tensor: Image8, size: tuple[int, int]) -> None:
        self.size, self.digest = size, Digest.of(tensor)
        half = SAMPLE_STEP // 2
        sample = np.ascontiguousarray(tensor[0, half::SAMPLE_STEP, half::SAMPLE_STEP])
        self.sample: Image8 = sample.reshape(-1, 3)
        means, deviations = cv2.meanStdDev(sample)
        self.means: list[float] = means.ravel().tolist()
        self.deviations: list[float] = deviations.ravel().tolist()


def image_doubt(look: Look) -> Reason | None:
    """Return why an image is rejected (black, saturated or without contrast), or None."""
    sample, mean = look.sample, sum(look.means) / len(look.means)
    # Most images are neither dark nor bright enough for the counts to matter.
    if mean <= _BLACK_MEAN and np.count_nonzero(sample > _BLACK) <= _FEW * sample.size:
        return Reason.IMAGE_BLACK
    if mean >= _SATURATED_MEAN and 2 * np.count_nonzero(sample >= _SATURATED) > sample.size:
        return Reason.IMAGE_SATURATED
    return Reason.IMAGE_FLAT if max(look.deviations) <= _FLAT else None


class StreamChecks:
    """Checks of a frame against its stream; pass every frame once, in order.

    ``unproven`` counts the images without fresh noise.
    """

    def __init__(self) -> None:
        self.unproven = 0
        self._repetition = Repetition()
        self._stamp_ns: int | None = None

    def picture(
        self, look: Look | None, fresh_noise: bool = True, moving: bool | None = None
    ) -> tuple[Reason, ...]:
        """Compare a picture with earlier ones and store it; None for an invalid image.

        ``fresh_noise`` and ``moving`` are those of the ``Frame``, see ``Repetition``.
        """
        if look is None:
            return ()
        self.unproven += not fresh_noise
        return self._repetition.doubts(look.digest, fresh_noise=fresh_noise, moving=moving)

    def times(self, stamp_ns: int | None, age_ms: float) -> tuple[Reason, ...]:
        """Compare a stamp with that of the frame before, and judge the frame's age."""
        doubts: tuple[Reason, ...] = ()
        if stamp_ns is not None and not 0 <= stamp_ns < _END_NS:
            doubts += (Reason.STAMP_IMPLAUSIBLE,)
        elif stamp_ns is not None:
            if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
                doubts += (Reason.STAMP_NOT_LATER,)
            self._stamp_ns = stamp_ns
        if age_ms > _STALE_MS:
            doubts += (Reason.FRAME_STALE,)
        return doubts
