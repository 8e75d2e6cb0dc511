"""The clock that stamps frames and measures how old they are."""

from __future__ import annotations

import time
from pathlib import Path
from threading import Event

# The kernel's account of the calling thread: nanoseconds on a processor, then in line for one.
_SCHEDSTAT = Path("/proc/thread-self/schedstat")


class Clock:
    """The system's clocks. Tests pass a clock of their own, whose time they set."""

    def now_s(self) -> float:
        """Return seconds since an arbitrary start; suspension counts where the system allows."""
        return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))

    def awake_s(self) -> float:
        """Return seconds of the monotonic clock that drivers stamp with; suspension is excluded."""
        return time.monotonic()

    def busy_s(self) -> float:
        """Return the seconds for which this thread has run or has been ready to run.

        The rest of its life it slept, e.g. waiting for a camera. Without Linux's scheduler
        statistics, only the time it has run.
        """
        try:
            running, in_line, _ = _SCHEDSTAT.read_bytes().split()
        except (OSError, ValueError):
            return time.thread_time()
        return 1e-9 * (int(running) + int(in_line))

    def time_ns(self) -> int:
        """Return the time of day, nanoseconds since 1970."""
        return time.time_ns()

    def wait(self, event: Event, timeout_s: float) -> bool:
        """Wait until the event is set, at most ``timeout_s``; return whether it is set."""
        return event.wait(timeout_s)


SYSTEM_CLOCK = Clock()
