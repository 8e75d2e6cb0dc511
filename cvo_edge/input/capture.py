"""OpenCV's video capture, run in a thread of its own that can be abandoned.

A read of a stalled stream never returns, and Python handles no signal during it. The caller
therefore waits for the thread's answer, for a bounded time. The thread is a daemon.
"""

from __future__ import annotations

import atexit
import contextlib
import math
import os
import re
import select
import time
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event, Thread, current_thread
from typing import Any, NamedTuple, Protocol, TypeVar
from weakref import WeakSet

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock
from cvo_edge.input.queue_lag import DriverStamps, LagAccount

# The command line looks for this name when it exits: if Python ends a thread inside OpenCV, the
# process aborts.
READER = "cvo-edge reader"

TIMEOUT_S = 5.0
# Opening takes longer than the next frame: an address is resolved, a format is probed.
OPENING = 2.0
_PARTS = 20
# Releasing a device takes milliseconds.
_RELEASE_S = 1.0

# FFmpeg's decoders that draw characters: a pipe or an address may give a text, too.
_DRAWN = frozenset(int.from_bytes(name, "little") for name in (b"ansi", b"xbin"))
# FFmpeg's names of codecs that code every picture by itself.
_INTRA = frozenset(
    int.from_bytes(name, "little")
    for name in (
        b"\0\0\0\0",  # pictures that are not coded
        *(b"MJPG", b"mjpg", b"jpeg", b"mjp2", b"MPNG", b"png ", b"FFV1", b"ffv1", b"HFYU", b"FFVH"),
        *(b"AVdn", b"apch", b"apcn", b"apcs", b"apco", b"ap4h", b"ap4x"),
    )
)

# Attempts that never answered, in this process. Each keeps a thread.
_MOST_HANGING = 16
_hanging: WeakSet[Thread] = WeakSet()
_reading: WeakSet[Thread] = WeakSet()

T = TypeVar("T")


def shown(device: int | str) -> str:
    """Return a device's name for records and messages: valid UTF-8, without a password."""
    # A file name may hold any bytes.
    text = os.fsencode(str(device)).decode("utf-8", "replace")
    return re.sub("(?<=://)[^/]*@", "", text)


@dataclass(frozen=True, eq=False)
class Grabbed:
    """One image and its times.

    ``image`` is mostly (height, width, 3) uint8 BGR. ``stamp_ns`` is the time of day at which the
    frame arrived, ``arrived_s`` the same moment on ``Clock.now_s``. ``decode_ms`` is the time spent
    from then on; ``read_ms`` also includes the wait for the frame. ``queued_ms`` bounds the age of
    the frame at its arrival: the time it may have spent in a camera's queue. ``position_ms`` is the
    frame's time in a file's container; some builds of OpenCV count from the end of the first frame.
    ``fresh_noise`` is False behind a codec that predicts pictures from others.
    """

    image: NDArray[Any]
    stamp_ns: int
    arrived_s: float
    position_ms: float
    decode_ms: float
    read_ms: float
    queued_ms: float
    fresh_noise: bool = True


class Reader(Protocol):
    """What a source reads from: a ``Capture``, or a test's camera."""

    def open(self) -> tuple[float, int]:
        """Open the device; see ``Capture.open``."""

    def read(self) -> Grabbed | None:
        """Return the next image; see ``Capture.read``."""

    def close(self) -> None:
        """Release the device; see ``Capture.close``."""


class Device(Protocol):
    """What of ``cv2.VideoCapture`` is used."""

    def open(self, _: Any, /, api: int = 0, limits: Any = ()) -> bool:  # noqa: ANN401 - overloads
        """Open a device or file."""

    def grab(self) -> bool:
        """Go on to the next frame."""

    def retrieve(self) -> tuple[bool, Any]:
        """Return the frame that was grabbed."""

    def get(self, _: int, /) -> float:
        """Return a property."""

    def set(self, _: int, value: float, /) -> bool:
        """Set a property."""

    def getBackendName(self) -> str:  # noqa: N802 - OpenCV's name
        """Return the name of what reads."""

    def release(self) -> None:
        """Release the device."""


class Capture:
    """A video file, camera or stream that OpenCV reads, in one thread.

    A call that takes longer than ``timeout_s`` raises SourceError, and the device is abandoned;
    opening may take twice as long. ``threads`` bounds those of a video decoder; by default FFmpeg
    decides.
    """

    def __init__(
        self,
        device: int | str,
        timeout_s: float,
        clock: Clock = SYSTEM_CLOCK,
        threads: int | None = None,
        video: Callable[[], Device] | None = None,
    ) -> None:
        hanging = sum(thread.is_alive() for thread in _hanging)
        if hanging >= _MOST_HANGING:
            raise SourceError(f"{shown(device)}: {hanging} earlier attempts still hang in OpenCV")
        self._device, self._timeout_s = device, timeout_s
        self._calls: SimpleQueue[Callable[[_Opened], object] | None] = SimpleQueue()
        self._answers: SimpleQueue[object] = SimpleQueue()
        self._idle = Event()
        self._closed = False
        # The thread holds no reference to this object, so that dropping it ends the thread.
        make = video or cv2.VideoCapture
        arguments = (self._calls, self._answers, self._idle, clock, threads, make)
        thread = Thread(target=_work, args=arguments, name=READER, daemon=True)
        _reading.add(thread)
        try:
            thread.start()
        except RuntimeError as error:
            raise SourceError(
                f"{shown(device)}: cannot start its reading thread: {error}"
            ) from None
        self._thread = thread
        # Also when Python exits, before it ends threads inside OpenCV and aborts.
        self._end = weakref.finalize(self, _end, thread, self._calls, self._idle)

    def open(self) -> tuple[float, int]:
        """Open the device; return its frame rate and number of frames, 0 if it does not state them.

        Raises
        ------
        SourceError
            The device does not open.
        """
        device = self._device
        try:
            # OpenCV aborts the process on other names.
            str(device).encode()
        except UnicodeEncodeError:
            raise SourceError(
                f"{shown(device)}: the name is not valid UTF-8, which OpenCV needs; rename it"
            ) from None
        wait_s = OPENING * self._timeout_s
        found = self._ask(lambda opened: opened.open(device, wait_s), wait_s)
        if found is None:
            self.close()
            raise SourceError(f"{shown(device)}: did not open as a video or camera")
        if found.codec in _DRAWN:
            self.close()
            raise SourceError(f"{shown(device)}: expected a video or camera, found text")
        return found.fps, found.frames

    def read(self) -> Grabbed | None:
        """Return the next image, or None at the end and for a frame that does not decode.

        The two cases differ in what the next call returns.

        Raises
        ------
        SourceError
            The device did not answer in time, or is closed.
        """
        return self._ask(_Opened.grab, self._timeout_s)

    def close(self) -> None:
        """Release the device once the pending call returns; callers do not block."""
        self._closed = True
        self._answers.put(SourceError(f"{shown(self._device)}: closed"))
        self._end()

    def _ask(self, call: Callable[[_Opened], T], timeout_s: float) -> T:
        if self._closed:
            raise SourceError(f"{shown(self._device)}: closed")
        self._idle.clear()
        self._calls.put(call)
        # In parts: if this process is stopped, one part expires, and not the whole time.
        for _ in range(_PARTS):
            with contextlib.suppress(Empty):
                answer = self._answers.get(timeout=timeout_s / _PARTS)
                break
        else:
            _hanging.add(self._thread)
            self.close()
            raise _no_answer(self._device, timeout_s)
        if isinstance(answer, Exception):
            raise answer
        return answer  # type: ignore[return-value]  # the answer to this call


def _work(
    calls: SimpleQueue[Callable[[_Opened], object] | None],
    answers: SimpleQueue[object],
    idle: Event,
    clock: Clock,
    threads: int | None,
    video: Callable[[], Device],
) -> None:
    opened = _Opened(video(), clock, threads)
    while (call := calls.get()) is not None:
        try:
            answer = call(opened)
        except Exception as error:  # noqa: BLE001 - raised by the caller
            answer = error
        idle.set()
        answers.put(answer)
    opened.release()


def _end(
    thread: Thread, calls: SimpleQueue[Callable[[_Opened], object] | None], idle: Event
) -> None:
    calls.put(None)
    # A thread that hangs is not waited for; the finalizer may also run in the thread itself.
    if idle.is_set() and thread is not current_thread():
        thread.join(_RELEASE_S)


@atexit.register
def _await_readers() -> None:
    """Let reads of closed captures come to their end when Python exits: at most one gap each.

    Python would end their threads inside OpenCV and abort. Those that hang are not waited for.
    """
    late = time.monotonic() + _RELEASE_S
    for thread in set(_reading) - set(_hanging):
        if thread.is_alive():
            thread.join(max(0.0, late - time.monotonic()))


class _Stated(NamedTuple):
    """Frame rate, number of frames (0 if unknown) and codec (a FourCC) of an opened device."""

    fps: float
    frames: int
    codec: int


class _Opened:
    """The capture and the ages of its frames; only the reading thread uses it."""

    def __init__(self, capture: Device, clock: Clock, threads: int | None = None) -> None:
        self._capture, self._clock, self._threads = capture, clock, threads
        self._account = LagAccount(clock.now_s(), 0.0)
        self._driver: DriverStamps | None = None
        self._fresh_noise = True

    def open(self, device: int | str, wait_s: float) -> _Stated | None:
        """Open the device; return what it states of itself, None if it does not open."""
        begin = self._clock.now_s()
        try:
            # Another one's bytes have begun.
            own = isinstance(self._capture, cv2.VideoCapture)
            with _written_to(device, wait_s) if own else contextlib.nullcontext():
                if not self._open(device):
                    return None
            # As for image files: pixels in the sensor's order, whatever the container asks for.
            self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
            fps, count = map(self._capture.get, (cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT))
            backend = self._capture.getBackendName()
            codec = int(self._capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF
        except cv2.error:
            return None
        self._account = LagAccount(begin, fps)
        # Video4Linux reports the driver's stamp as the position; other backends count from a start.
        self._driver = DriverStamps() if backend == "V4L2" else None
        self._fresh_noise = backend != "FFMPEG" or codec in _INTRA
        return _Stated(fps, int(count) if 0.0 < count < math.inf else 0, codec)

    def _open(self, device: int | str) -> bool:
        # Video4Linux refuses a parameter that is FFmpeg's.
        if self._threads is None or isinstance(device, int) or Path(device).is_char_device():
            return bool(self._capture.open(device))
        limit = [cv2.CAP_PROP_N_THREADS, self._threads]
        return bool(self._capture.open(device, cv2.CAP_ANY, limit))

    def grab(self) -> Grabbed | None:
        """Return the next image, None if there is none."""
        clock = self._clock
        # In this order, a thread that is not run in between appears to have slept less, not more.
        busy_s, begin = clock.busy_s(), clock.now_s()
        try:
            found = self._capture.grab()
            stamp_ns, awake_s, arrived = clock.time_ns(), clock.awake_s(), clock.now_s()
            busy_s = clock.busy_s() - busy_s
            if found:
                found, image = self._capture.retrieve()
            position_ms = float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        except cv2.error:
            return None
        if not found:
            return None
        queued_s = self._account.queued_s(arrived, arrived - begin - busy_s)
        if self._driver is not None:
            age_s = self._driver.age_s(1e-3 * position_ms, awake_s, arrived)
            queued_s = queued_s if age_s is None else age_s
        end = clock.now_s()
        return Grabbed(
            image=np.asarray(image),
            stamp_ns=stamp_ns,
            arrived_s=arrived,
            position_ms=position_ms,
            decode_ms=1e3 * (end - arrived),
            read_ms=1e3 * (end - begin),
            queued_ms=1e3 * queued_s,
            fresh_noise=self._fresh_noise,
        )

    def release(self) -> None:
        """Release the device."""
        self._capture.release()


@contextlib.contextmanager
def _written_to(device: int | str, wait_s: float) -> Iterator[None]:
    """Hold a named pipe open that has begun to give bytes; raises SourceError if it gives none.

    OpenCV opens one stream at a time and would wait for ever, also for another stream.
    """
    pipe = None
    if not isinstance(device, int) and Path(device).is_fifo():
        # One that cannot be opened is left to OpenCV.
        with contextlib.suppress(OSError):
            pipe = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
    if pipe is None:
        yield
        return
    try:
        waiting = select.poll()
        waiting.register(pipe, select.POLLIN)
        if not waiting.poll(1e3 * wait_s):
            raise _no_answer(device, wait_s)
        yield
    finally:
        os.close(pipe)


def _no_answer(device: int | str, wait_s: float) -> SourceError:
    return SourceError(f"{shown(device)}: gave no answer within {wait_s:g} s")
