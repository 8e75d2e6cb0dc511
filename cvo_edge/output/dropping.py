"""A sink that outlives a full disk: what cannot be written is dropped, counted and said."""

from __future__ import annotations

import errno
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Self

from cvo_edge.errors import SinkError
from cvo_edge.estimate import PoseInterval
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock
from cvo_edge.output.opening import Writing

# A disk with room for a line now and then is full.
_STEADY_S = 5.0
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Dropping:
    """Writes what can be written.

    Parameters
    ----------
    what
        What is written, for messages: ``records``.
    opening
        Opens the sink.
    told
        Called with one line when dropping begins, and when it has ended.

    Attributes
    ----------
    written, dropped
        Estimates so far.

    Raises SinkError if the sink does not open for another reason than a full disk; one that is full
    is tried again with each estimate.
    """

    def __init__(
        self,
        what: str,
        opening: Callable[[], AbstractContextManager[Writing]],
        told: Callable[[str], None],
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self.what, self._opening, self._told, self._clock = what, opening, told, clock
        self.written = self.dropped = 0
        self._said = 0
        self._failed_s: float | None = None
        self._opened: AbstractContextManager[Writing] | None = None
        self._sink: Writing | None = None

    def __enter__(self) -> Self:
        """Open the sink and return itself."""
        try:
            self._open()
        except SinkError as error:
            if getattr(error.__context__, "errno", None) not in _FULL:
                raise
            self._failed(error)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the sink."""
        if self._opened is not None:
            self._opened.__exit__(kind, error, traceback)

    def write(self, estimate: PoseInterval) -> None:
        """Write an estimate, or count it as dropped."""
        try:
            (self._sink or self._open()).write(estimate)
        except SinkError as error:
            self._failed(error)
            self.dropped += 1
            return
        self.written += 1
        if self._failed_s is not None and self._clock.now_s() - self._failed_s >= _STEADY_S:
            self._failed_s = None
            self._told(f"{self.what} are written again; {self.dropped - self._said} were dropped")
            self._said = self.dropped

    def _open(self) -> Writing:
        self._opened = self._opening()
        self._sink = self._opened.__enter__()
        return self._sink

    def _failed(self, error: SinkError) -> None:
        if self._failed_s is None:
            self._told(f"{error}; {self.what} are dropped until it can be written")
        self._failed_s = self._clock.now_s()
