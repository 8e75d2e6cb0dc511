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
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from statistics import fmean
from threading import Event, Thread, current_thread
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


def clock_s() -> float:
    """Seconds of a clock that goes on while the machine sleeps, where there is one."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class Arrivals:
    """Which frames of a camera may have waited in a queue, and how long.

    Drivers, networks and decoders keep frames that nobody takes. Whoever takes them all, one after
    the other, is always ahead. What comes later than usual leaves a lag, which frames that come
    sooner make up for; as long as there is a lag, frames may be as old. It is over when it is made
    up for, or when frames come no sooner than usual, as the queue is empty then.
    """

    # A lag that matters, and how far a camera's jitter may have it wrong.
    _LAG_S = 1.0
    _JITTER, _JITTER_S = 1.5, 0.15
    # No queue holds more.
    _MOST_S = 60.0
    # Until so many gaps are known they are taken for those of a camera of 30 a second, or of 60 if
    # it says so; and no frame makes up for more than that.
    _FEW, _FPS, _MOST_FPS, _LATE_S = 8, 30.0, 60.0, 1.0
    _USUAL, _SOME, _SOME_S = 64, 16, 2.0
    _SLOW, _ALIKE = 4, 1.5
    # No sooner than usual, nearly; and far later.
    _AS_USUAL, _LATE = 0.9, 3.0
    # Even a decoder that is hardly faster than the camera has emptied a queue by then.
    _LONGEST = 10.0

    def __init__(self, opened_at: float, claimed_fps: float) -> None:
        self._last, self._first = opened_at, True
        fast = self._FPS < claimed_fps < math.inf
        self._gap_s = 1.0 / (min(claimed_fps, self._MOST_FPS) if fast else self._FPS)
        self._gaps: deque[float] = deque(maxlen=self._USUAL)
        self._since: deque[float] = deque(maxlen=self._SOME)
        self._recent: deque[float] = deque(maxlen=self._SOME)
        self._lag_s = self._largest_s = self._spent_s = 0.0

    def queued_s(self, come: float) -> float:
        """Seconds that the frame which came now may have waited, 0 where it is no more than one.

        ``come`` in seconds of the clock of ``opened_at``.
        """
        gap, self._last = come - self._last, come
        first, self._first = self._first, False
        # What it took to open says nothing of a rate.
        if not first:
            self._recent.append(gap)
        last = list(self._recent)[-self._SLOW :]
        if len(self._gaps) < self._FEW and self._are_slow(last):
            self._gaps.extend(self._FEW // self._SLOW * last)
            self._lag_s = self._largest_s = 0.0
        known = len(self._gaps) >= self._FEW
        usual = fmean(self._gaps) if known else self._gap_s
        late_s = self._LATE * usual if known else self._LATE_S
        made_up = self._AS_USUAL * usual
        self._lag_s = min(max(0.0, self._lag_s + gap - made_up), self._MOST_S)
        if first or gap > late_s:
            self._since.clear()
            self._spent_s = 0.0
            if 2 * sum(each > late_s for each in self._recent) >= self._SOME:
                # No pauses any more: a camera that has become slow.
                self._gaps.clear()
                self._gaps.extend(self._recent)
        else:
            self._since.append(gap)
            self._spent_s += gap
            if self._is_empty(usual):
                self._lag_s = 0.0
            if self._lag_s <= late_s:
                self._gaps.append(gap)
        most_s = self._lag_s + min(self._JITTER * usual, self._JITTER_S)
        if most_s > self._LAG_S or (self._largest_s and self._lag_s):
            self._largest_s = max(self._largest_s, most_s)
        else:
            self._largest_s = 0.0
        return self._largest_s

    def _are_slow(self, gaps: list[float]) -> bool:
        """Whether frames come more slowly than was assumed, one like the other: at their own rate.

        Those of a queue come sooner.
        """
        slow_s, alike_s = self._ALIKE * self._gap_s, max(gaps, default=0.0) / self._ALIKE
        return len(gaps) == self._SLOW and slow_s < min(gaps) > alike_s

    def _is_empty(self, usual: float) -> bool:
        some = len(self._since) == self._SOME or sum(self._since) > self._SOME_S
        return (some and fmean(self._since) >= self._AS_USUAL * usual) or (
            self._spent_s > self._LONGEST * self._largest_s > 0.0
        )
