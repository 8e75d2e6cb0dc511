"""OpenCV's video capture in a thread of its own, which can be left behind.

A read of a stalled stream does not come back, and no signal is answered while it lasts. So the
caller waits for an answer instead, for a bounded time; the thread that never answers is a daemon.
"""

from __future__ import annotations

import time
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


@dataclass(frozen=True, eq=False)
class Grabbed:
    """One image, mostly (height, width, 3) uint8 BGR, and the clock's time when it had come.

    ``decode_ms`` is what it took from then on; ``read_ms`` with the wait for it, which is nothing
    but reading where frames are there already.
    """

    image: NDArray[Any]
    stamp_ns: int
    decode_ms: float
    read_ms: float


class Capture:
    """A video file, camera or stream that OpenCV opens, by one thread.

    Raises
    ------
    SourceError
        It does not open, or a call takes longer than ``timeout_s``; then it is given up.
    """

    def __init__(self, device: int | str, timeout_s: float) -> None:
        self._device, self._timeout_s = device, timeout_s
        self._calls: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._answers: SimpleQueue[object] = SimpleQueue()
        self._given_up = False
        Thread(target=self._work, name=READER, daemon=True).start()
        if not self._ask(self._open, _OPENING * timeout_s):
            self.close()
            raise SourceError(f"{device}: expected a video or camera that opens, found none")

    def properties(self) -> tuple[float, int]:
        """Frames a second and number of frames, as the container says; 0 where it does not."""
        return self._ask(
            lambda: (
                float(self._capture.get(cv2.CAP_PROP_FPS)),
                int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)),
            ),
            self._timeout_s,
        )

    def read(self) -> Grabbed | None:
        """Return the next image, or None at the end."""
        return self._ask(self._grab, self._timeout_s)

    def close(self) -> None:
        """Give it back, as soon as what it is at comes to an end; whoever waits need not."""
        self._given_up = True
        self._calls.put(None)
        self._answers.put(SourceError(f"{self._device}: closed"))

    def _ask(self, call: Callable[[], T], timeout_s: float) -> T:
        if not self._given_up:
            self._calls.put(call)
            try:
                answer = self._answers.get(timeout=timeout_s)
            except Empty:
                self.close()
            else:
                if isinstance(answer, Exception):
                    raise answer
                return answer  # type: ignore[return-value]  # of this very call
        raise SourceError(f"{self._device}: expected an answer within {timeout_s:g} s, found none")

    def _work(self) -> None:
        while (call := self._calls.get()) is not None:
            try:
                self._answers.put(call())
            except Exception as error:  # noqa: BLE001 - raised by whoever asked
                self._answers.put(error)
        capture = getattr(self, "_capture", None)
        if capture is not None:
            capture.release()

    def _open(self) -> bool:
        try:
            self._capture = cv2.VideoCapture(self._device)
        except cv2.error:
            return False
        return bool(self._capture.isOpened())

    def _grab(self) -> Grabbed | None:
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
        return Grabbed(np.asarray(image), stamp_ns, 1e3 * (end - come), 1e3 * (end - begin))
