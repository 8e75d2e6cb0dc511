"""What a frame and its stream must be like for an interval to be claimed.

A frame check looks at one image, and counts at calibration, too: frames that it flags are neither
calibrated nor evaluated with, so that what is claimed is claimed of the others. A stream check
compares a frame with those before it, and only a running stream has it. Both look at what the model
sees, already halved and resized, so that they cost microseconds.
"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.estimate import Reason

Image8 = NDArray[np.uint8]

# Every eighth pixel of every eighth row: 768 of 256x192.
_STEP = 8
# Grey levels of 255. A lens cap with noise hardly has a value above the first, a blown-out image
# more than half of them from the second on, and what has no contrast varies by no more than the
# third (standard deviation; a picture's is ten times as large).
_BLACK, _SATURATED, _FLAT = 20, 250, 4.0
# A few pixels are hot, or show a time of day.
_FEW = 0.02
# Drivers hand out a few buffers in turn, and a dead one may hand out the same few for ever.
_BUFFERS = 8
# An older frame says where the camera was, not where it is.
_STALE_MS = 1000.0


class Look:
    """What is kept of an image until the next one: as the model sees it, and its own size.

    ``tensor`` (1, height, width, 3) uint8 RGB; ``size`` (height, width) of the image itself;
    ``sample`` some pixels of the tensor, (n, 3), and ``key`` their bytes.
    """

    def __init__(self, tensor: Image8, size: tuple[int, int]) -> None:
        self.tensor, self.size = tensor, size
        half = _STEP // 2
        self.sample: Image8 = tensor[0, half::_STEP, half::_STEP].reshape(-1, 3)
        self.key = self.sample.tobytes()


def image_doubt(look: Look) -> Reason | None:
    """Return what speaks against an image: black, saturated or without contrast; else None."""
    sample = look.sample
    if np.count_nonzero(sample > _BLACK) <= _FEW * sample.size:
        return Reason.IMAGE_BLACK
    if 2 * np.count_nonzero(sample >= _SATURATED) > sample.size:
        return Reason.IMAGE_SATURATED
    _, deviation = cv2.meanStdDev(sample[:, np.newaxis])
    return Reason.IMAGE_FLAT if deviation.max() <= _FLAT else None


class StreamChecks:
    """What speaks against a frame where it stands in its stream; frames come in order, once."""

    def __init__(self) -> None:
        self._before: Look | None = None
        self._keys: deque[bytes] = deque(maxlen=_BUFFERS)
        self._size: tuple[int, int] | None = None
        self._stamp_ns: int | None = None

    def doubts(self, look: Look | None, stamp_ns: int | None, age_ms: float) -> tuple[Reason, ...]:
        """Compare a frame with those before it, and remember it; no look where it is no image.

        A sensor's noise never repeats: the same image again is the old one, an encoder's copy of
        it, or one of a driver's buffers, come round again (compared as the model sees it). Another
        size than the first frame's is another camera, or another setting of it.
        """
        doubts: tuple[Reason, ...] = ()
        if look is not None:
            if self._seen(look):
                doubts += (Reason.FRAME_REPEATED,)
            self._size = self._size or look.size
            if look.size != self._size:
                doubts += (Reason.IMAGE_SIZE_CHANGED,)
            self._before = look
            self._keys.append(look.key)
        if stamp_ns is not None:
            if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
                doubts += (Reason.STAMP_NOT_LATER,)
            self._stamp_ns = stamp_ns
        if age_ms > _STALE_MS:
            doubts += (Reason.FRAME_STALE,)
        return doubts

    def _seen(self, look: Look) -> bool:
        if self._before is not None and look.key == self._before.key:
            # Of a picture without noise the rest may have changed.
            return np.array_equal(look.tensor, self._before.tensor)
        return look.key in self._keys
