"""Parallel tasks, each in its own process with one torch thread."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

from cvo_edge.errors import CvoError, SinkError
from cvo_edge.process import signals_deferred

Task = Callable[[], None]
# Receives the name of a finished task, and its error if it failed.
Ended = Callable[[str, CvoError | None], None]
# Runs every task once.
Engine = Callable[[Mapping[str, Task], Ended], None]


# A process unwinds only after a pending library call has returned.
_SECONDS_TO_LEAVE = 10.0


class TaskError(CvoError):
    """A task failed because of a defect, or its process was killed."""


def run_tasks(jobs: int, tasks: Mapping[str, Task], ended: Ended) -> None:
    """Run tasks by name, ``jobs`` at a time; the others continue after a failure.

    With one job, tasks run in this process. With several, they run in other processes and must be
    picklable. No process outlives this call.
    """
    if jobs > 1:
        _in_processes(tasks, jobs, ended)
    else:
        for name, task in tasks.items():
            ended(name, attempt(task))


def _in_processes(tasks: Mapping[str, Task], jobs: int, ended: Ended) -> None:
    context = multiprocessing.get_context("spawn")
    waiting = list(tasks.items())
    running: dict[Connection, tuple[str, SpawnProcess]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                name, task = waiting.pop(0)
                receiver, sender = context.Pipe(duplex=False)
                process = context.Process(target=_worker, args=(sender, task), daemon=True)
                with signals_deferred():
                    with _interrupts_ignored():
                        process.start()
                    running[receiver] = (name, process)
                # Only the process holds the sending end now, so that its death closes the pipe.
                sender.close()
            ready = wait(list(running))
            for receiver in [receiver for receiver in running if receiver in ready]:
                name, process = running.pop(receiver)
                ended(name, _outcome(receiver, process))
    finally:
        for _, process in running.values():
            process.terminate()
        for _, process in running.values():
            process.join(_SECONDS_TO_LEAVE)
            process.kill()
            process.join()


def _outcome(receiver: Connection, process: SpawnProcess) -> CvoError | None:
    try:
        found: CvoError | None = receiver.recv()
    except EOFError:
        process.join()
        return TaskError(f"its process ended with exit code {process.exitcode}")
    finally:
        receiver.close()
    process.join()
    return found


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Make processes started here ignore SIGINT; their parent terminates them."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _worker(sender: Connection, task: Task) -> None:
    # Unwind, so that no temporary file or semaphore is left behind.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    # Loading torch takes seconds: it is not loaded for tasks without it, and reads this if it is
    # loaded later.
    os.environ["OMP_NUM_THREADS"] = "1"
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    sender.send(attempt(task))


def attempt(task: Task) -> CvoError | None:
    """Run a task; returns its error if it failed."""
    try:
        task()
    except CvoError as error:
        return error
    except OSError as error:
        return SinkError(f"{error.filename or 'output'}: {error.strerror}")
    except Exception as error:  # noqa: BLE001 - the other tasks continue
        traceback.print_exc()
        return TaskError(" ".join(f"{type(error).__name__}: {error}".split()))
    return None
