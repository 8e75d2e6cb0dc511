"""How a stream of frames uses the cores: three modes, and the loops that run them.

- ``latency``: one frame after the other, each as fast as all cores can make it.
- ``throughput``: as many frames at a time as there are cores, each on one of them. Most frames a
  second, but each frame takes longer. The order is kept; estimates arrive in bunches, which suits
  recordings.
- ``live``: the newest frame of a steady camera, with little processor time. No thread spins while
  it waits, and frames that arrive during processing are dropped.

A loop takes frames, calls ``work`` on each (in threads of its own in ``throughput``), and yields
the results in the order of the frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from threading import Condition, Event, Thread
from time import perf_counter
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from cvo_edge.cores import checked_threads
from cvo_edge.errors import UsageError
from cvo_edge.input.capture import READER
from cvo_edge.input.frame import Frame, Source
from cvo_edge.input.queue_lag import clock_s

Mode = Literal["live", "latency", "throughput"]
MODES: tuple[Mode, ...] = get_args(Mode)

Result = TypeVar("Result")
# A frame and its number in the stream -> what is made of it.
Work = Callable[[Frame, int], Result]

# Frames queued behind those in work, so that one slow frame does not leave cores idle.
AHEAD = 2
# How long a stream that ends waits for a frame that is on its way.
_PATIENCE_S = 2.0


@dataclass(frozen=True)
class Plan:
    """Settings of a mode: threads of one inference, whether they spin, frames at a time."""

    threads: int
    spinning: bool
    workers: int


def plan(mode: Mode, threads: int | None = None) -> Plan:
    """Return the settings of a mode for ``threads`` in all, by default one for each allowed core.

    Raises UsageError for a number of threads that is out of range.
    """
    threads = checked_threads(threads)
    if mode == "throughput":
        return Plan(threads=1, spinning=False, workers=threads)
    return Plan(threads=threads, spinning=mode == "latency", workers=1)


def checked_mode(mode: str) -> Mode:
    """Return the mode of that name; raises UsageError where there is none."""
    for known in MODES:
        if known == mode:
            return known
    raise UsageError(f"mode: expected one of {', '.join(MODES)}, found {mode!r}")


def run_stream(
    frames: Iterable[Frame | NDArray[Any]],
    mode: Mode,
    workers: int,
    work: Work[Result],
    next_seq: Callable[[], int],
) -> Generator[Result, None, None]:
    """Yield what ``work`` makes of each frame, in the order of the frames.

    Parameters
    ----------
    frames
        A source, or frames or bare images, whose memory may be reused once the next is asked for.
    mode, workers
        The mode, and the number of frames at a time in ``throughput``.
    work
        Called with each frame and its number.
    next_seq
        Number of the next frame that nobody has been given yet.

    Raises what the source and ``work`` raise, in its place after the results before it, and in
    ``live`` UsageError for a recording without stamps.
    """
    # The frames of a camera have to be taken as they come: those that nobody takes grow old.
    if mode == "live" or (isinstance(frames, Source) and frames.live):
        with closing(_newest(frames)) as newest:
            yield from _one_by_one(newest, work, next_seq)
    elif mode == "throughput":
        reads = frames.reads() if isinstance(frames, Source) else map(_already_read, frames)
        numbered = zip(count(next_seq()), reads, strict=False)
        tasks = (partial(_read_and_work, read, work, seq) for seq, read in numbered)
        yield from in_order(tasks, workers)
    else:
        yield from _one_by_one(map(_as_frame, frames), work, next_seq)


def _newest(frames: Iterable[Frame | NDArray[Any]]) -> Generator[Frame, None, None]:
    if isinstance(frames, Source):
        coming = frames if frames.live else Played(frames)
        # A source that somebody else wrote need not have it.
        return iter(Newest(coming, getattr(coming, "stop", None)))
    return iter(Newest(map(_kept, frames)))


def _one_by_one(
    frames: Iterable[Frame], work: Work[Result], next_seq: Callable[[], int]
) -> Iterator[Result]:
    for frame in frames:
        yield work(frame, next_seq() + frame.skipped)


def _read_and_work(read: Callable[[], Frame], work: Work[Result], seq: int) -> Result:
    return work(read(), seq)


def _as_frame(frame: Frame | NDArray[Any]) -> Frame:
    return frame if isinstance(frame, Frame) else Frame(frame, None, "", 0.0)


def _kept(frame: Frame | NDArray[Any]) -> Frame:
    """Copy a caller's image, as the caller may write the next one into the same memory."""
    given = _as_frame(frame)
    image = given.image
    return replace(given, image=image.copy() if isinstance(image, np.ndarray) else image)


def _already_read(frame: Frame | NDArray[Any]) -> Callable[[], Frame]:
    kept = _kept(frame)
    return lambda: kept


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
