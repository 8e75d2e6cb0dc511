"""OpenCV's video capture in a thread of its own, which can be left behind.

A read of a stalled stream does not come back, and no signal is answered while it lasts. So the
caller waits for an answer instead, for a bounded time; the thread that never answers is a daemon.
"""

from __future__ import annotations

import os
import re
import time
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from threading import Thread
from time import perf_counter
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError

# What the command line looks for when it ends: Python must not end such a thread inside OpenCV.
READER = "cvo-edge reader"

TIMEOUT_S = 5.0
# To open takes longer than the next frame: an address is looked up, a format is probed.
_OPENING = 2.0

T = TypeVar("T")


def shown(device: int | str) -> str:
    """Return a device's name for records and messages: in UTF-8, and without a password."""
    # A file name may be any bytes.
    text = os.fsencode(str(device)).decode("utf-8", "replace")
    return re.sub("(?<=://)[^/@]*@", "", text)


@dataclass(frozen=True, eq=False)
class Grabbed:
    """One image, mostly (height, width, 3) uint8 BGR, and the clock's time when it had come.

    ``decode_ms`` is what it took from then on; ``read_ms`` with the wait for it, which is nothing
    but reading where frames are there already; ``queued_ms`` how long it may have lain in a queue
    of a camera before. ``position_ms`` is where a file's container puts it; a build of OpenCV may
    count from the first frame's end.
    """

    image: NDArray[Any]
    stamp_ns: int
    position_ms: float
    decode_ms: float
    read_ms: float
    queued_ms: float


class Capture:
    """A video file, camera or stream, for OpenCV to open, by one thread.

    A call that takes longer than ``timeout_s``, to open twice that, raises SourceError, and the
    device is given up.
    """

    def __init__(self, device: int | str, timeout_s: float) -> None:
        self._device, self._timeout_s = device, timeout_s
        self._calls: SimpleQueue[Callable[[_Opened], object] | None] = SimpleQueue()
        self._answers: SimpleQueue[object] = SimpleQueue()
        self._closed = False
        # The thread does not hold this object: whoever drops it ends the thread as well.
        thread = Thread(target=_work, args=(self._calls, self._answers), name=READER, daemon=True)
        try:
            thread.start()
        except RuntimeError as error:
            raise SourceError(f"{shown(device)}: expected a thread to read it: {error}") from None
        weakref.finalize(self, self._calls.put, None)

    def open(self) -> None:
        """Open the device; raises SourceError where that cannot be done."""
        device = self._device
        try:
            # OpenCV ends the process at what is not.
            str(device).encode()
        except UnicodeEncodeError:
            raise SourceError(
                f"{shown(device)}: expected a name in UTF-8, found another: OpenCV opens none such"
            ) from None
        if not self._ask(lambda opened: opened.open(device), _OPENING * self._timeout_s):
            self.close()
            raise SourceError(f"{shown(device)}: expected a video or camera that opens, found none")

    def properties(self) -> tuple[float, int]:
        """Frames a second and number of frames, as the container says; 0 where it does not."""
        return self._ask(_Opened.properties, self._timeout_s)

    def read(self) -> Grabbed | None:
        """Return the next image, or None at the end, and for a file's frame that does not decode.

        Whether it was the end is seen by asking again.
        """
        return self._ask(_Opened.grab, self._timeout_s)

    def close(self) -> None:
        """Give it back, as soon as what it is at comes to an end; whoever waits need not."""
        self._closed = True
        self._calls.put(None)
        self._answers.put(SourceError(f"{shown(self._device)}: closed"))

    def _ask(self, call: Callable[[_Opened], T], timeout_s: float) -> T:
        if self._closed:
            raise SourceError(f"{shown(self._device)}: closed")
        self._calls.put(call)
        try:
            answer = self._answers.get(timeout=timeout_s)
        except Empty:
            self.close()
            raise SourceError(
                f"{shown(self._device)}: expected an answer within {timeout_s:g} s, found none"
            ) from None
        if isinstance(answer, Exception):
            raise answer
        return answer  # type: ignore[return-value]  # of this very call


def _work(
    calls: SimpleQueue[Callable[[_Opened], object] | None], answers: SimpleQueue[object]
) -> None:
    opened = _Opened()
    while (call := calls.get()) is not None:
        try:
            answers.put(call(opened))
        except Exception as error:  # noqa: BLE001 - raised by whoever asked
            answers.put(error)
    opened.release()


class _Opened:
    """What the thread alone touches: the capture, and when its frames came."""

    def __init__(self) -> None:
        self._capture = cv2.VideoCapture()
        self._arrivals = Arrivals(perf_counter())

    def open(self, device: int | str) -> bool:
        """Open it -> whether that was done."""
        try:
            return bool(self._capture.open(device))
        except cv2.error:
            return False

    def properties(self) -> tuple[float, int]:
        """Frames a second, number of frames."""
        return (
            float(self._capture.get(cv2.CAP_PROP_FPS)),
            int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)),
        )

    def grab(self) -> Grabbed | None:
        """Take the next image, None where none comes."""
        try:
            begin = perf_counter()
            found = self._capture.grab()
            stamp_ns, come = time.time_ns(), perf_counter()
            if found:
                found, image = self._capture.retrieve()
        except cv2.error:
            return None
        if not found:
            return None
        end = perf_counter()
        return Grabbed(
            image=np.asarray(image),
            stamp_ns=stamp_ns,
            position_ms=float(self._capture.get(cv2.CAP_PROP_POS_MSEC)),
            decode_ms=1e3 * (end - come),
            read_ms=1e3 * (end - begin),
            queued_ms=1e3 * self._arrivals.queued_s(begin, come),
        )

    def release(self) -> None:
        """Give it back."""
        self._capture.release()


class Arrivals:
    """Which frames of a camera were there before they were asked for, after a pause.

    Drivers and decoders keep frames that nobody takes. Whoever takes them all, one after the other,
    finds none there; after a pause, of this process or of the camera, those that come at once are
    old.
    """

    # Shorter pauses leave nothing behind that matters; a slow camera's own are no pauses.
    _PAUSE_S, _USUAL_GAPS = 1.0, 3.0
    # What is there already is there in less, and in less than half of the usual time.
    _AT_ONCE_S = 0.005

    def __init__(self, opened_at: float) -> None:
        self._last, self._first = opened_at, True
        self._pause_s = 0.0
        self._gaps: deque[float] = deque(maxlen=9)

    def queued_s(self, asked: float, come: float) -> float:
        """Seconds that a frame may have waited: the last pause, until a frame had to be waited for.

        ``asked`` and ``come`` in seconds of one clock.
        """
        gap, self._last = come - self._last, come
        usual = min(self._gaps, default=0.0)
        if gap > max(self._PAUSE_S, self._USUAL_GAPS * usual):
            # Twice in a row it is the camera that takes so long.
            if self._pause_s:
                self._gaps.append(gap)
            self._pause_s = gap
        elif not self._pause_s or come - asked > max(self._AT_ONCE_S, 0.5 * usual):
            self._pause_s = 0.0
            # The first one is behind the opening, not behind another frame.
            if not self._first:
                self._gaps.append(gap)
        self._first = False
        return self._pause_s
