"""A progress line on the terminal: how much is done, and the time left."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from cvo_edge.estimate import PoseInterval
from cvo_edge.programs.run import RunSummary
from cvo_edge.record import Status

_SECONDS_BETWEEN_UPDATES = 0.1
_WIDTH = 80

_CLEAR = "\r\x1b[K"


class _Line:
    """A line on a terminal that is rewritten at most ten times per second."""

    def __init__(self, stream: TextIO, clock: Callable[[], float]) -> None:
        self._stream, self._clock = stream, clock
        self._begin = clock()
        self._next = self._begin + _SECONDS_BETWEEN_UPDATES
        self._shown = False

    def close(self) -> None:
        """Erase the line."""
        if self._shown:
            self._put(_CLEAR)

    def _due(self, now: float) -> bool:
        if now < self._next:
            return False
        self._next = now + _SECONDS_BETWEEN_UPDATES
        return True

    def _show(self, text: str) -> None:
        self._put(_CLEAR + text[: _columns(self._stream) - 1])
        self._shown = True

    def _put(self, text: str) -> None:
        # Losing the terminal must not end the run.
        try:
            self._stream.write(text)
            self._stream.flush()
        except (OSError, ValueError):
            self._next = float("inf")


def done_text(summary: RunSummary, total: int | None, seconds: float) -> str:
    """Return the frames done so far, their rate and, with a total, the share and the time left."""
    done = summary.frames + summary.dropped
    parts = [f"{done} frames", f"{summary.frames / max(seconds, 1e-9):.1f} fps"]
    if total is not None:
        # A header may announce fewer frames than the file holds.
        parts[0] = f"{done} of {total} frames ({done / max(1, done, total):.0%})"
        if done:
            parts.append(f"{_minutes(max(0, total - done) * seconds / done)} left")
    return "  ".join(parts)


class FramesProgress(_Line):
    """Progress of a stream: frames, rate, time left and statuses; most calls return quickly.

    Parameters
    ----------
    stream
        The terminal.
    summary
        Counts of the run, updated by the caller.
    total
        Total number of frames, or None if the source does not tell.
    clock
        Monotonic time in seconds.
    """

    def __init__(
        self,
        stream: TextIO,
        summary: RunSummary,
        total: int | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(stream, clock)
        self._summary, self._total = summary, total

    def tick(self, _: PoseInterval | None = None) -> None:
        """Update the line if it is due; call this once per frame."""
        now = self._clock()
        if self._due(now):
            self._show(self.line(now))

    def line(self, now: float) -> str:
        """Return the text at the time ``now``."""
        counts = self._summary.statuses
        done = done_text(self._summary, self._total, now - self._begin)
        return "  ".join([done, *(f"{counts[s]} {s}" for s in Status if counts[s])])


class ItemsProgress(_Line):
    """Progress of work on recordings, one kind of work after another."""

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(stream, clock)
        self._what = ""

    def watch(self, what: str, done: int, total: int) -> None:
        """Say that ``done`` of ``total`` items are done; the time left is that of this work."""
        now = self._clock()
        if what != self._what:
            self._what, self._begin = what, now
        if self._due(now):
            left = _minutes((total - done) * (now - self._begin) / done)
            self._show(f"{what}: {done} of {total} recordings  {left} left")


@contextmanager
def frames_progress(
    wanted: bool, summary: RunSummary, total: int | None
) -> Iterator[Callable[[PoseInterval], None]]:
    """Yield a function to call with each frame; it does nothing if stderr is not a terminal."""
    stream = sys.stderr
    if not wanted or stream is None or not stream.isatty():
        yield _nothing
        return
    progress = FramesProgress(stream, summary, total)
    try:
        yield progress.tick
    finally:
        progress.close()


@contextmanager
def items_progress() -> Iterator[Callable[[str, int, int], None] | None]:
    """Yield what to tell of items that are done; None if stderr is not a terminal."""
    stream = sys.stderr
    if stream is None or not stream.isatty():
        yield None
        return
    progress = ItemsProgress(stream)
    try:
        yield progress.watch
    finally:
        progress.close()


def _nothing(_: PoseInterval | None = None) -> None:
    """Do nothing."""


def _columns(stream: TextIO) -> int:
    try:
        return os.get_terminal_size(stream.fileno()).columns or _WIDTH
    except (OSError, ValueError):
        return _WIDTH


def _minutes(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
