"""A simulated clock, and an oracle that a board may lack."""

from __future__ import annotations

from threading import Event
from typing import Any

import pytest

from cvo_edge.input.clock import Clock


class SimulatedClock(Clock):
    """A clock that advances only when a test, or a wait on this clock, advances it."""

    def __init__(self) -> None:
        self.now = self.busy = self.suspended = 0.0
        self.waits: list[float] = []

    def now_s(self) -> float:
        return self.now

    def awake_s(self) -> float:
        return self.now - self.suspended

    def busy_s(self) -> float:
        return self.busy

    def time_ns(self) -> int:
        return 1_700_000_000_000_000_000 + round(1e9 * self.now)

    def wait(self, event: Event, timeout_s: float) -> bool:
        self.waits.append(timeout_s)
        if not event.is_set():
            self.now += timeout_s
        return event.is_set()


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture
def optimize() -> Any:
    """``scipy.optimize``; skips the test on a board without scipy."""
    return pytest.importorskip("scipy.optimize")
