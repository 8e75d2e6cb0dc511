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
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

from cvo_edge.cores import checked_threads
from cvo_edge.errors import UsageError

Result = TypeVar("Result")

# Queued behind those at work, so that a slow one does not keep the others waiting.
AHEAD = 2


class Mode(StrEnum):
    """What a stream is to be good at, see above."""

    LIVE = "live"
    LATENCY = "latency"
    THROUGHPUT = "throughput"


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
