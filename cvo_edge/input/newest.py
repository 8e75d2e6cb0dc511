"""Frames at the pace of a camera: the newest one for a reader that is slower than the source."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import replace
from threading import Condition, Event, Thread

from cvo_edge.errors import UsageError
from cvo_edge.input.capture import READER
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock
from cvo_edge.input.frame import Frame

# How long a stream that has ended waits for the frame being read.
_PATIENCE_S = 2.0


class Newest:
    """The newest frame of a source that does not wait for its reader.

    A thread reads the source continuously. A frame that is not taken before the next one arrives is
    dropped and counted in ``Frame.skipped``. Frames age from their arrival on. ``stop`` ends the
    source's wait for its next frame.
    """

    def __init__(
        self,
        frames: Iterable[Frame],
        stop: Callable[[], None] | None = None,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._frames, self._stop, self._clock = frames, stop, clock
        self._changed = Condition()
        self._frame: Frame | None = None
        self._dropped = 0
        self._closed = False
        self._ended = False
        self._failure: BaseException | None = None

    def __iter__(self) -> Generator[Frame, None, None]:
        """Yield frames until the source ends; what it raises is raised after its last frame."""
        # A daemon: a camera that gives no further frame must not keep the process alive.
        reader = Thread(target=self._read, name=READER, daemon=True)
        reader.start()
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._frame or self._ended)
                    frame, dropped, self._dropped = self._frame, self._dropped, 0
                    self._frame = None
                if frame is None:
                    break
                yield replace(frame, skipped=dropped)
        finally:
            self._closed = True
            if self._stop is not None:
                self._stop()
            # If Python ended this thread inside OpenCV, the process would abort.
            reader.join(_PATIENCE_S)
        if self._failure is not None:
            raise self._failure

    def _read(self) -> None:
        try:
            for frame in self._frames:
                if frame.arrived_s is None:
                    read_s = 1e-3 * frame.read_ms
                    frame = replace(frame, arrived_s=self._clock.now_s() - read_s)
                with self._changed:
                    # A source may have dropped frames itself.
                    self._dropped += frame.skipped + (self._frame is not None)
                    self._frame = frame
                    self._changed.notify()
                if self._closed:
                    return
        except BaseException as error:  # noqa: BLE001 - raised by the iterating thread
            self._failure = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()


class Played:
    """A recording whose frames come at the times of their stamps, late ones at once.

    Raises
    ------
    UsageError
        A frame has no stamp.
    """

    def __init__(self, source: Iterable[Frame], clock: Clock = SYSTEM_CLOCK) -> None:
        self._source, self._clock = source, clock
        self._stopped = Event()

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames, each at its time, until ``stop``."""
        begin = None
        for frame in self._source:
            if frame.stamp_ns is None:
                raise UsageError(
                    "live: the frames have no stamps to play them by; set --fps or use a camera"
                )
            if begin is None:
                begin = self._clock.now_s() - 1e-9 * frame.stamp_ns
            pause_s = begin + 1e-9 * frame.stamp_ns - self._clock.now_s()
            if self._clock.wait(self._stopped, max(0.0, pause_s)):
                return
            yield frame

    def stop(self) -> None:
        """End the recording, also while its next frame is waited for."""
        self._stopped.set()
