"""OpenCV's video capture in a thread of its own, which can be left behind.

A read of a stalled stream does not come back, and no signal is answered while it lasts. So the
caller waits for an answer instead, for a bounded time; the thread that never answers is a daemon.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import time
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from threading import Event, Thread, current_thread
from time import perf_counter
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.input.queue_lag import Arrivals, clock_s

# What the command line looks for when it ends: Python must not end such a thread inside OpenCV.
READER = "cvo-edge reader"

TIMEOUT_S = 5.0
# To open takes longer than the next frame: an address is looked up, a format is probed.
_OPENING = 2.0
_PARTS = 20
# Giving a device back takes milliseconds.
_RELEASE_S = 1.0

T = TypeVar("T")


def shown(device: int | str) -> str:
    """Return a device's name for records and messages: in UTF-8, and without a password."""
    # A file name may be any bytes.
    text = os.fsencode(str(device)).decode("utf-8", "replace")
    return re.sub("(?<=://)[^/]*@", "", text)


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
        self._idle = Event()
        self._closed = False
        # The thread does not hold this object: whoever drops it ends the thread as well.
        thread = Thread(
            target=_work, args=(self._calls, self._answers, self._idle), name=READER, daemon=True
        )
        try:
            thread.start()
        except RuntimeError as error:
            raise SourceError(f"{shown(device)}: expected a thread to read it: {error}") from None
        # Also where Python ends: it would end such a thread within OpenCV, and the process with it.
        self._end = weakref.finalize(self, _end, thread, self._calls, self._idle)

    def open(self) -> tuple[float, int]:
        """Open the device -> frames a second and their number, 0 where it does not say.

        Raises SourceError where that cannot be done.
        """
        device = self._device
        try:
            # OpenCV ends the process at what is not.
            str(device).encode()
        except UnicodeEncodeError:
            raise SourceError(
                f"{shown(device)}: expected a name in UTF-8, found another: OpenCV opens none such"
            ) from None
        found = self._ask(lambda opened: opened.open(device), _OPENING * self._timeout_s)
        if found is None:
            self.close()
            raise SourceError(f"{shown(device)}: expected a video or camera that opens, found none")
        return found

    def read(self) -> Grabbed | None:
        """Return the next image, or None at the end, and for a file's frame that does not decode.

        Whether it was the end is seen by asking again.
        """
        return self._ask(_Opened.grab, self._timeout_s)

    def close(self) -> None:
        """Give it back, as soon as what it is at comes to an end; whoever waits need not."""
        self._closed = True
        self._answers.put(SourceError(f"{shown(self._device)}: closed"))
        self._end()

    def _ask(self, call: Callable[[_Opened], T], timeout_s: float) -> T:
        if self._closed:
            raise SourceError(f"{shown(self._device)}: closed")
        self._idle.clear()
        self._calls.put(call)
        # In parts: while this process is stopped one of them runs out, and not the thread's time.
        for _ in range(_PARTS):
            with contextlib.suppress(Empty):
                answer = self._answers.get(timeout=timeout_s / _PARTS)
                break
        else:
            self.close()
            raise SourceError(
                f"{shown(self._device)}: expected an answer within {timeout_s:g} s, found none"
            )
        if isinstance(answer, Exception):
            raise answer
        return answer  # type: ignore[return-value]  # of this very call


def _work(
    calls: SimpleQueue[Callable[[_Opened], object] | None],
    answers: SimpleQueue[object],
    idle: Event,
) -> None:
    opened = _Opened()
    while (call := calls.get()) is not None:
        try:
            answer = call(opened)
        except Exception as error:  # noqa: BLE001 - raised by whoever asked
            answer = error
        idle.set()
        answers.put(answer)
    opened.release()


def _end(
    thread: Thread, calls: SimpleQueue[Callable[[_Opened], object] | None], idle: Event
) -> None:
    calls.put(None)
    # Nobody waits for one that hangs; memory may be tidied up in the thread itself.
    if idle.is_set() and thread is not current_thread():
        thread.join(_RELEASE_S)


class _Opened:
    """What the thread alone touches: the capture, and when its frames came."""

    def __init__(self) -> None:
        self._capture = cv2.VideoCapture()
        self._arrivals = Arrivals(clock_s(), 0.0)

    def open(self, device: int | str) -> tuple[float, int] | None:
        """Open it -> frames a second and their number, as the container says; None if it is not."""
        begin = clock_s()
        try:
            if not self._capture.open(device):
                return None
            fps, count = map(self._capture.get, (cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT))
        except cv2.error:
            return None
        self._arrivals = Arrivals(begin, fps)
        return fps, int(count) if 0.0 < count < math.inf else 0

    def grab(self) -> Grabbed | None:
        """Take the next image, None where none comes."""
        try:
            begin = perf_counter()
            found = self._capture.grab()
            stamp_ns, come = time.time_ns(), perf_counter()
            if found:
                found, image = self._capture.retrieve()
            position_ms = float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        except cv2.error:
            return None
        if not found:
            return None
        end = perf_counter()
        return Grabbed(
            image=np.asarray(image),
            stamp_ns=stamp_ns,
            position_ms=position_ms,
            decode_ms=1e3 * (end - come),
            read_ms=1e3 * (end - begin),
            queued_ms=1e3 * self._arrivals.queued_s(clock_s()),
        )

    def release(self) -> None:
        """Give it back."""
        self._capture.release()
