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
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cvo_edge.engine.cores import checked_threads
from cvo_edge.errors import UsageError
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock
from cvo_edge.input.frame import Frame, Source
from cvo_edge.input.newest import Newest, Played
from cvo_edge.vocabulary import MODES, Mode

Result = TypeVar("Result")
# A frame and its number in the stream -> what is made of it.
Work = Callable[[Frame, int], Result]

# Frames queued behind those in work, so that one slow frame does not leave cores idle.
AHEAD = 2


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
    clock: Clock = SYSTEM_CLOCK,
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
    clock
        Paces a recording in ``live``, and dates the arrival of frames.

    Raises what the source and ``work`` raise, in its place after the results before it, and in
    ``live`` UsageError for a recording without stamps.
    """
    # The frames of a camera have to be taken as they come: those that nobody takes grow old.
    if mode == "live" or (isinstance(frames, Source) and frames.live):
        with closing(_newest(frames, clock)) as newest:
            yield from _one_by_one(newest, work, next_seq)
    elif mode == "throughput":
        reads = frames.reads() if isinstance(frames, Source) else map(_already_read, frames)
        numbered = zip(count(next_seq()), reads, strict=False)
        tasks = (partial(_read_and_work, read, work, seq) for seq, read in numbered)
        yield from in_order(tasks, workers)
    else:
        yield from _one_by_one(map(_as_frame, frames), work, next_seq)


def _newest(frames: Iterable[Frame | NDArray[Any]], clock: Clock) -> Generator[Frame, None, None]:
    if isinstance(frames, Source):
        coming = frames if frames.live else Played(frames, clock)
        # A source that somebody else wrote need not have it.
        return iter(Newest(coming, getattr(coming, "stop", None), clock))
    return iter(Newest(map(_kept, frames), clock=clock))


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
