"""Progress of training on stderr: bars on a terminal, a line every 15 seconds in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal, Protocol

Stage = Literal[
    "features",
    "map",
    "training",
    "fine-tuning",
    # Those of reconstruct.
    "motion",
    "images",
    "matching",
    "mapping",
    "tags",
]


class Progress(Protocol):
    """Callback that training calls as it advances."""

    def __call__(self, stage: Stage, done: int, total: int, note: str = "", /) -> None:
        """Report that ``done`` of ``total`` steps of a stage are finished, with a ``note``."""


_SECONDS_BETWEEN_LINES = 15.0


@contextmanager
def show_progress() -> Iterator[Progress]:
    """Yield a ``Progress`` that shows bars or lines."""
    if sys.stderr.isatty():
        with _bar() as progress:
            yield progress
    else:
        yield _lines()


@contextmanager
def _bar() -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID

    with RichProgress(console=Console(stderr=True)) as bars:
        tasks: dict[Stage, TaskID] = {}
        last: dict[Stage, int] = {}

        def progress(stage: Stage, done: int, total: int, note: str = "") -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            elif done < last[stage]:
                # A new lesson or a new set of features begins.
                bars.reset(tasks[stage])
            last[stage] = done
            text = _text(stage, note)
            bars.update(tasks[stage], completed=done, total=total, description=text)

        yield progress


def _lines(clock: Callable[[], float] = time.monotonic) -> Progress:
    start = clock()
    last = -_SECONDS_BETWEEN_LINES

    def progress(stage: Stage, done: int, total: int, note: str = "") -> None:
        nonlocal last
        now = clock() - start
        if done == total or now - last >= _SECONDS_BETWEEN_LINES:
            last = now
            text = f"{now:7.1f} s  {_text(stage, note)}: {done} of {total}"
            print(text, file=sys.stderr, flush=True)

    return progress


def _text(stage: Stage, note: str) -> str:
    return f"{stage}, {note}" if note else stage
