"""How a stream of frames uses the cores: three uses, three settings.

- ``latency``: one frame after the other, each as fast as all cores make it.
- ``throughput``: as many frames at a time as there are cores, each on one of them; the most frames
  a second, each of them slower. Order is kept. Estimates come in bunches: it is for recordings.
- ``live``: the newest frame of a steady camera, with little processor time: no thread waits by
  spinning, and frames that came while another one was at work are left out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Condition, Event, Thread
from time import perf_counter
from typing import TypeVar

from cvo_edge.cores import checked_threads
from cvo_edge.errors import UsageError
from cvo_edge.input.capture import READER
from cvo_edge.input.frame import Frame
from cvo_edge.input.queue_lag import clock_s
from cvo_edge.vocabulary import Mode as Mode

Result = TypeVar("Result")

# Queued behind those at work, so that a slow one does not keep the others waiting.
AHEAD = 2


@dataclass(frozen=True)
class Plan:
    """Settings of a mode: threads of one inference, whether they spin, frames at a time."""

    threads: int
    spinning: bool
    workers: int


def plan(mode: Mode, threads: int | None = None) -> Plan:
    """Settings of a mode with so many threads in all, by default one for each allowed core.

    Raises UsageError for numbers of threads that are none.
    """
    threads = checked_threads(threads)
    if mode is Mode.THROUGHPUT:
        return Plan(threads=1, spinning=False, workers=threads)
    return Plan(threads=threads, spinning=mode is Mode.LATENCY, workers=1)


def checked_mode(mode: Mode | str) -> Mode:
    """Return the mode of that name; raises UsageError where there is none."""
    try:
        return Mode(mode)
    except ValueError:
        raise UsageError(f"mode: expected one of {', '.join(Mode)}, found {mode!r}") from None


def in_order(tasks: Iterable[Callable[[], Result]], workers: int) -> Generator[Result, None, None]:
    """Run tasks in ``workers`` threads and yield what they return, in their order.

    Tasks are taken as they are needed: never more than a few are under way. What a task raises, or
    a source of tasks that ends early, is raised in its place, after the results before it.
    """
    pending: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(workers, "cvo-edge worker")
    try:
        for task in _failing_last(tasks):
            pending.append(pool.submit(task))
            while pending and (len(pending) >= workers + AHEAD or pending[0].done()):
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        # Whoever leaves does not wait for what is being read.
        pool.shutdown(wait=False, cancel_futures=True)


def _failing_last(tasks: Iterable[Callable[[], Result]]) -> Iterator[Callable[[], Result]]:
    """Tasks, and where their source ends with an error one more that raises it."""
    try:
        yield from tasks
    except Exception as error:  # noqa: BLE001 - raised in its place
        failure = error

        def fail() -> Result:
            raise failure

        yield fail


# How long a stream that has ended waits for a frame that is on its way.
_PATIENCE_S = 2.0


class Newest:
    """The newest frame of a source, which does not wait for whoever looks at it.

    A thread reads on; frames that were not looked at before the next one came are left out, and
    counted in ``Frame.skipped``. ``stop`` ends the source's wait for its next frame.
    """

    def __init__(self, frames: Iterable[Frame], stop: Callable[[], None] | None = None) -> None:
        self._frames, self._stop = frames, stop
        self._changed = Condition()
        self._frame: Frame | None = None
        self._ready_at = 0.0
        self._skipped = 0
        self._closed = False
        self._ended = False
        self._failure: BaseException | None = None

    def __iter__(self) -> Generator[Frame, None, None]:
        """Yield frames until the source ends; raises what it raised, after its last frame."""
        # A camera may never give another frame: nothing waits for ever for who waits for it.
        reader = Thread(target=self._read, name=READER, daemon=True)
        reader.start()
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._frame or self._ended)
                    frame, skipped, self._skipped = self._frame, self._skipped, 0
                    self._frame, ready_at = None, self._ready_at
                if frame is None:
                    break
                waited_ms = 1e3 * (clock_s() - ready_at)
                yield replace(frame, waited_ms=frame.waited_ms + waited_ms, skipped=skipped)
        finally:
            self._closed = True
            if self._stop is not None:
                self._stop()
            # A thread that Python ends inside OpenCV takes the process with it.
            reader.join(_PATIENCE_S)
        if self._failure is not None:
            raise self._failure

    def _read(self) -> None:
        try:
            for frame in self._frames:
                with self._changed:
                    self._skipped += self._frame is not None
                    self._frame, self._ready_at = frame, clock_s()
                    self._changed.notify()
                if self._closed:
                    return
        except BaseException as error:  # noqa: BLE001 - raised by whoever iterates
            self._failure = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()


class Played:
    """A recording at the times of its stamps, as a camera would give it; late frames at once.

    Raises UsageError for a frame without a stamp.
    """

    def __init__(self, source: Iterable[Frame]) -> None:
        self._source = source
        self._stopped = Event()

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames, each at its time, until ``stop``."""
        begin = None
        for frame in self._source:
            if frame.stamp_ns is None:
                raise UsageError(
                    "live: expected a camera, or frames with stamps (--fps), found none"
                )
            if begin is None:
                begin = perf_counter() - 1e-9 * frame.stamp_ns
            pause_s = begin + 1e-9 * frame.stamp_ns - perf_counter()
            if self._stopped.wait(max(0.0, pause_s)):
                return
            yield frame

    def stop(self) -> None:
        """End the play, whoever is waiting for its next frame."""
        self._stopped.set()
