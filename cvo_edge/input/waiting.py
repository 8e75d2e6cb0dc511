"""When a camera that failed is opened again, and whether it is ever given up."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Protocol

from cvo_edge.errors import SourceError, printable
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock

# A service's pauses grow to this.
LONGEST_PAUSE_S = 5.0
_FIRST_PAUSE_S = 0.25
# A camera that was back for so long, and is lost again, has all attempts again.
_STEADY_S = 10.0

_LOG = logging.getLogger(__name__)


class Patience(Protocol):
    """What a camera asks after a failure."""

    def failed(self, problem: str) -> float:
        """Return the pause before the next attempt, s; raises SourceError to give up."""

    def gave_frame(self) -> None:
        """Note a frame of a connection that has given one before."""


class FewAttempts:
    """Gives a camera up after an attempt behind each pause; says each attempt.

    ``pauses_s`` returns the pauses.
    """

    def __init__(self, pauses_s: Callable[[], tuple[float, ...]]) -> None:
        self._pauses_s, self._failures = pauses_s, 0

    def failed(self, problem: str) -> float:
        """Return the next pause; raises SourceError when there is none left."""
        pauses_s = self._pauses_s()
        if self._failures == len(pauses_s):
            raise SourceError(
                f"{problem} ({self._failures + 1} attempts); check the camera and its address"
            )
        pause_s = pauses_s[self._failures]
        _LOG.warning("%s; opening it again in %g s", printable(problem), pause_s)
        self._failures += 1
        return pause_s

    def gave_frame(self) -> None:
        """Grant all attempts again."""
        self._failures = 0


class Waiting:
    """Waits for a camera as long as it takes; says once that it is lost, and once that it is back.

    Attributes
    ----------
    lost
        Whether the camera gives no frames now; True until it has given two.
    reopened
        How often it came back.
    attempts
        Failures since it last came back.
    """

    def __init__(self, told: Callable[[str], None], clock: Clock = SYSTEM_CLOCK) -> None:
        self._told, self._clock = told, clock
        self.lost = True
        self.reopened = self.attempts = 0
        self._lost_s: float | None = None
        self._back_s = clock.now_s()
        self._pause_s = _FIRST_PAUSE_S

    def failed(self, problem: str) -> float:
        """Return the next pause, which grows to ``LONGEST_PAUSE_S``."""
        now = self._clock.now_s()
        if self._lost_s is None:
            self._lost_s = now
            self._told(f"camera lost: {printable(problem)}; waiting until it is back")
            # One that comes for moments alone is not asked faster and faster.
            if now - self._back_s >= _STEADY_S:
                self._pause_s = _FIRST_PAUSE_S
        self.lost = True
        self.attempts += 1
        pause_s, self._pause_s = self._pause_s, min(2.0 * self._pause_s, LONGEST_PAUSE_S)
        return pause_s

    def gave_frame(self) -> None:
        """Say that the camera is back, if it was lost."""
        self.lost = False
        if self._lost_s is None:
            return
        now = self._clock.now_s()
        attempts = f"{self.attempts} attempt{'s' * (self.attempts != 1)}"
        self._told(f"camera back after {now - self._lost_s:.1f} s and {attempts}")
        self._lost_s, self._back_s = None, now
        self.attempts = 0
        self.reopened += 1
