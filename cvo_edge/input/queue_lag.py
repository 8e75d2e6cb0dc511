"""How long a frame of a camera may have waited in a queue before it was read."""

from __future__ import annotations

import math
import time
from collections import deque
from statistics import fmean


def clock_s() -> float:
    """Seconds of a clock that goes on while the machine sleeps, where there is one."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class Arrivals:
    """Which frames of a camera may have waited in a queue, and how long.

    Drivers, networks and decoders keep frames that nobody takes. Whoever takes them all, one after
    the other, is always ahead. What comes later than usual leaves a lag, which frames that come
    sooner make up for; as long as there is a lag, frames may be as old. It is over when it is made
    up for, or when frames come no sooner than usual, as the queue is empty then.
    """

    # A lag that matters, and how far a camera's jitter may have it wrong.
    _LAG_S = 1.0
    _JITTER, _JITTER_S = 1.5, 0.15
    # No queue holds more.
    _MOST_S = 60.0
    # Until so many gaps are known they are taken for those of a camera of 30 a second, or of 60 if
    # it says so; and no frame makes up for more than that.
    _FEW, _FPS, _MOST_FPS, _LATE_S = 8, 30.0, 60.0, 1.0
    _USUAL, _SOME, _SOME_S = 64, 16, 2.0
    _SLOW, _ALIKE = 4, 1.5
    # No sooner than usual, nearly; and far later.
    _AS_USUAL, _LATE = 0.9, 3.0
    # Even a decoder that is hardly faster than the camera has emptied a queue by then.
    _LONGEST = 10.0

    def __init__(self, opened_at: float, claimed_fps: float) -> None:
        self._last, self._first = opened_at, True
        fast = self._FPS < claimed_fps < math.inf
        self._gap_s = 1.0 / (min(claimed_fps, self._MOST_FPS) if fast else self._FPS)
        self._gaps: deque[float] = deque(maxlen=self._USUAL)
        self._since: deque[float] = deque(maxlen=self._SOME)
        self._recent: deque[float] = deque(maxlen=self._SOME)
        self._lag_s = self._largest_s = self._spent_s = 0.0

    def queued_s(self, come: float) -> float:
        """Seconds that the frame which came now may have waited, 0 where it is no more than one.

        ``come`` in seconds of the clock of ``opened_at``.
        """
        gap, self._last = come - self._last, come
        first, self._first = self._first, False
        # What it took to open says nothing of a rate.
        if not first:
            self._recent.append(gap)
        last = list(self._recent)[-self._SLOW :]
        if len(self._gaps) < self._FEW and self._are_slow(last):
            self._gaps.extend(self._FEW // self._SLOW * last)
            self._lag_s = self._largest_s = 0.0
        known = len(self._gaps) >= self._FEW
        usual = fmean(self._gaps) if known else self._gap_s
        late_s = self._LATE * usual if known else self._LATE_S
        made_up = self._AS_USUAL * usual
        self._lag_s = min(max(0.0, self._lag_s + gap - made_up), self._MOST_S)
        if first or gap > late_s:
            self._since.clear()
            self._spent_s = 0.0
            if 2 * sum(each > late_s for each in self._recent) >= self._SOME:
                # No pauses any more: a camera that has become slow.
                self._gaps.clear()
                self._gaps.extend(self._recent)
        else:
            self._since.append(gap)
            self._spent_s += gap
            if self._is_empty(usual):
                self._lag_s = 0.0
            if self._lag_s <= late_s:
                self._gaps.append(gap)
        most_s = self._lag_s + min(self._JITTER * usual, self._JITTER_S)
        if most_s > self._LAG_S or (self._largest_s and self._lag_s):
            self._largest_s = max(self._largest_s, most_s)
        else:
            self._largest_s = 0.0
        return self._largest_s

    def _are_slow(self, gaps: list[float]) -> bool:
        """Whether frames come more slowly than was assumed, one like the other: at their own rate.

        Those of a queue come sooner.
        """
        slow_s, alike_s = self._ALIKE * self._gap_s, max(gaps, default=0.0) / self._ALIKE
        return len(gaps) == self._SLOW and slow_s < min(gaps) > alike_s

    def _is_empty(self, usual: float) -> bool:
        some = len(self._since) == self._SOME or sum(self._since) > self._SOME_S
        return (some and fmean(self._since) >= self._AS_USUAL * usual) or (
            self._spent_s > self._LONGEST * self._largest_s > 0.0
        )
