"""A progress line on the terminal: frames, rate, time left and statuses."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from cvo_edge.estimate import Status
from cvo_edge.programs.run import RunSummary

_SECONDS_BETWEEN_UPDATES = 0.1
_WIDTH = 80

_CLEAR = "\r\x1b[K"


class FramesProgress:
    """Progress line that is rewritten at most ten times per second; other calls return quickly.

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
        self._stream, self._summary, self._total, self._clock = stream, summary, total, clock
        self._begin = clock()
        self._next = self._begin + _SECONDS_BETWEEN_UPDATES
        self._shown = False

    def tick(self) -> None:
        """Update the line if it is due; call this once per frame."""
        now = self._clock()
        if now >= self._next:
            self._next = now + _SECONDS_BETWEEN_UPDATES
            self._put(_CLEAR + self.line(now)[: _columns(self._stream) - 1])
            self._shown = True

    def line(self, now: float) -> str:
        """Return the text at the time ``now``."""
        summary = self._summary
        done = summary.frames + summary.skipped
        rate = summary.frames / max(now - self._begin, 1e-9)
        parts = [f"{done} frames", f"{rate:.1f} fps"]
        if self._total is not None:
            # A header may announce fewer frames than the file holds.
            left = max(0, self._total - done)
            share = done / max(done, self._total)
            parts[0] = f"{done} of {self._total} frames ({share:.0%})"
            if done:
                parts.append(f"{_minutes(left * (now - self._begin) / done)} left")
        parts += [f"{summary.statuses[s]} {s}" for s in Status if summary.statuses[s]]
        return "  ".join(parts)

    def close(self) -> None:
        """Erase the line."""
        if self._shown:
            self._put(_CLEAR)

    def _put(self, text: str) -> None:
        # Losing the terminal must not end the run.
        try:
            self._stream.write(text)
            self._stream.flush()
        except (OSError, ValueError):
            self._next = float("inf")


@contextmanager
def frames_progress(
    wanted: bool, summary: RunSummary, length: int | None, max_frames: int | None
) -> Iterator[Callable[[], None]]:
    """Yield a function to call once per frame; it does nothing if stderr is not a terminal."""
    stream = sys.stderr
    if not wanted or stream is None or not stream.isatty():
        yield _nothing
        return
    known = [count for count in (length, max_frames) if count is not None]
    progress = FramesProgress(stream, summary, min(known, default=None))
    try:
        yield progress.tick
    finally:
        progress.close()


def _nothing() -> None:
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
