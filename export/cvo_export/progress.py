"""Progress on stderr: a bar for a terminal, a line now and then for a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# What is done, how much of it, of how much.
Progress = Callable[[str, int, int], None]

_SECONDS_BETWEEN_LINES = 15.0


@contextmanager
def show_progress() -> Iterator[Progress]:
    """Yield ``progress(what, done, total)``."""
    if sys.stderr.isatty():
        with _bar() as progress:
            yield progress
    else:
        yield _lines()


@contextmanager
def _bar() -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import Progress as RichProgress

    with RichProgress(console=Console(stderr=True)) as bars:
        tasks: dict[str, int] = {}

        def progress(what: str, done: int, total: int) -> None:
            # "training, val score 0.3" goes on with the bar of "training".
            stage = what.split(",")[0]
            if stage not in tasks:
                tasks[stage] = int(bars.add_task(stage, total=total))
            bars.update(bars.task_ids[tasks[stage]], completed=done, description=what)

        yield progress


def _lines() -> Progress:
    start = time.monotonic()
    last = {"": -_SECONDS_BETWEEN_LINES}

    def progress(what: str, done: int, total: int) -> None:
        now = time.monotonic() - start
        if done == total or now - last[""] >= _SECONDS_BETWEEN_LINES:
            last[""] = now
            print(f"{now:7.1f} s  {what}: {done} of {total}", file=sys.stderr, flush=True)

    return progress
