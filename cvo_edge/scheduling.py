"""How a stream of frames uses the cores: three modes, and the loops that run them.

- ``latency``: one frame at a time, on all cores.
- ``throughput``: as many frames in parallel as there are cores, each on one core. This gives the
  highest frame rate, but each frame takes longer. Estimates keep the order of the frames and arrive
  in bursts, which suits recordings.
- ``live``: the newest frame of a camera, with little processor time. Threads do not busy-wait, and
  frames that arrive during processing are dropped.

Each loop calls ``work`` on every frame (in worker threads in ``throughput``) and yields the results
in the order of the frames.
"""

from __future__ import annotations

import os
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
# A frame and its number in the stream -> the result for it.
Work = Callable[[Frame, int], Result]

# Frames queued behind those being processed, so that a slow frame leaves no core idle.
AHEAD = 2


@dataclass(frozen=True)
class Plan:
    """Settings of a mode: threads per inference, whether they spin, frames in parallel."""

    threads: int
    spinning: bool
    workers: int


def plan(mode: Mode, threads: int | None = None) -> Plan:
    """Return the settings of a mode for ``threads`` in total, by default one per allowed core.

    Raises UsageError if the number of threads is out of range.
    """
    threads = checked_threads(threads)
    if mode == "throughput":
        return Plan(threads=1, spinning=False, workers=threads)
    return Plan(threads=threads, spinning=mode == "latency", workers=1)


def checked_mode(mode: str) -> Mode:
    """Return the mode of that name; raises UsageError if it is unknown."""
    for known in MODES:
        if known == mode:
            return known
    raise UsageError(f"mode: expected one of {', '.join(MODES)}, found {mode!r}")


def usual_mode(frames: Source, *, adapts: bool) -> Mode:
    """Return the mode that is fastest for a source and drops no frame of a recording.

    In ``throughput``, a frame starts before the labels of earlier ones can count, and its estimate
    may wait for later frames to come: an odometer that adapts and a source without a known end get
    ``latency``. So does a single frame, which then has all cores for itself.
    """
    if frames.live:
        return "live"
    return "latency" if adapts or frames.length in (None, 1) else "throughput"


def run_stream(
    frames: Iterable[Frame | NDArray[Any]],
    mode: Mode,
    workers: int,
    work: Work[Result],
    next_seq: Callable[[], int],
    clock: Clock = SYSTEM_CLOCK,
) -> Generator[Result, None, None]:
    """Yield the result of ``work`` for each frame, in the order of the frames.

    Parameters
    ----------
    frames
        A source, or frames or bare images, whose memory may be reused after the next request.
    mode, workers
        The mode, and the number of frames in parallel in ``throughput``.
    work
        Called with each frame and its number.
    next_seq
        Returns the number of the next frame.
    clock
        Paces a recording in ``live`` and dates the arrival of frames.

    Raises errors of the source and of ``work`` after the results of earlier frames, and UsageError
    for what holds no frames, such as a path, and in ``live`` for a recording without stamps.
    """
    if isinstance(frames, str | bytes | os.PathLike) or not isinstance(frames, Iterable):
        raise UsageError(
            f"stream: expected frames or a source, found {frames!r:.80}; a path is opened by "
            "open_source(path)"
        )
    # A camera must be read continuously; frames left in its queue become stale.
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
        # A user-defined source may have no stop method.
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
    """Copy the caller's image, because the caller may reuse its memory."""
    given = _as_frame(frame)
    image = given.image
    return replace(given, image=image.copy() if isinstance(image, np.ndarray) else image)


def _already_read(frame: Frame | NDArray[Any]) -> Callable[[], Frame]:
    kept = _kept(frame)
    return lambda: kept


def in_order(tasks: Iterable[Callable[[], Result]], workers: int) -> Generator[Result, None, None]:
    """Run tasks in ``workers`` threads and yield their results in order.

    Tasks are fetched on demand, so only a few are pending at a time. An error of a task, or of the
    iterable itself, is raised after the results of the tasks before it. A single worker is the
    calling thread: on one core another one would only be waited for.
    """
    if workers == 1:
        for task in tasks:
            yield task()
        return
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
        # Do not wait for reads in progress.
        pool.shutdown(wait=False, cancel_futures=True)


def _failing_last(tasks: Iterable[Callable[[], Result]]) -> Iterator[Callable[[], Result]]:
    """Yield the tasks and, if their iterable fails, a final task that raises its error."""
    try:
        yield from tasks
    except Exception as error:  # noqa: BLE001 - raised in its place
        failure = error

        def fail() -> Result:
            raise failure

        yield fail
