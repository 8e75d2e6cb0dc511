"""How old a camera's frame may be when it is read.

Drivers, networks and decoders queue the frames that nobody takes. Some drivers stamp each frame;
its age is then known (``DriverStamps``). Other frames carry no time, and their age is bounded by an
account (``LagAccount``) that uses only the times at which frames were read.
"""

from __future__ import annotations

import math
from collections import deque
from statistics import fmean

# No queue holds more.
_MOST_S = 60.0


class DriverStamps:
    """Ages of frames that a driver stamps with the system's monotonic clock."""

    def __init__(self) -> None:
        self._suspended_s = -math.inf
        self._resumed_at, self._missing_s = -math.inf, 0.0

    def age_s(self, stamp_s: float, awake_s: float, now_s: float) -> float | None:
        """Return the age of a frame stamped ``stamp_s``, or None if it is not on that clock.

        ``awake_s`` and ``now_s`` are the present on the monotonic clock, which stops while the
        machine is suspended, and on one that does not stop.
        """
        suspended_s = now_s - awake_s
        if suspended_s > self._suspended_s + 0.1:
            if self._suspended_s > -math.inf:
                self._resumed_at = awake_s
                self._missing_s = suspended_s - self._suspended_s
            self._suspended_s = suspended_s
        age_s = awake_s - stamp_s
        if not 0.0 <= age_s <= _MOST_S:
            return None
        # A frame from before the suspension was noticed is older by the length of it.
        return age_s + (self._missing_s if stamp_s < self._resumed_at else 0.0)


class LagAccount:
    """An upper bound on the time that frames without a stamp have spent in a queue.

    Consecutive frames are one usual gap apart when they are exposed. A frame read later than one
    gap after its predecessor therefore adds the excess to the lag, and one read sooner reduces it,
    however the reading thread is scheduled. Frames dropped by a full queue leave the bound too
    high, so the lag is also cleared when the queue is shown to be empty: without a pause, the last
    few frames came no faster than usual, and the reader slept while it waited for most of them.
    Time in which the reader ran, or was ready to run and was not run, is not sleep.
    """

    # A bound above one second is kept until the lag is gone; the margin covers a camera's jitter.
    _STALE_S, _MARGIN_S = 1.0, 0.2
    # The rate assumed before it is known, unless the camera claims a higher one, up to the second.
    _FPS, _MOST_FPS = 30.0, 60.0
    # Gaps in the mean that is the usual gap, and frames that show an empty queue.
    _USUAL, _SHOWING = 128, 8
    # "No faster than usual", and the share of a usual gap that counts as sleep.
    _AS_USUAL, _SLEEP = 0.85, 0.1
    # A gap of more than so many usual ones is a pause.
    _PAUSE = 2.5

    def __init__(self, opened_at: float, claimed_fps: float) -> None:
        fast = self._FPS < claimed_fps < math.inf
        gap_s = 1.0 / (min(claimed_fps, self._MOST_FPS) if fast else self._FPS)
        self._gaps = deque([gap_s] * self._SHOWING, self._USUAL)
        self._recent: deque[tuple[float, float]] = deque(maxlen=self._SHOWING)
        self._unlearnt: deque[float] = deque(maxlen=self._USUAL)
        self._last = opened_at
        self._lag_s = self._worst_s = 0.0

    def queued_s(self, read_at: float, slept_s: float) -> float:
        """Return an upper bound on the age of the frame that was read now, in seconds.

        ``read_at`` is on the clock of ``opened_at``; for ``slept_s`` of the read, the thread slept.
        """
        gap_s, self._last = read_at - self._last, read_at
        usual_s = fmean(self._gaps)
        self._recent.append((gap_s, slept_s))
        self._unlearnt.append(gap_s)
        lag_s = self._lag_s + gap_s - self._AS_USUAL * usual_s
        self._lag_s = min(max(0.0, lag_s), _MOST_S)
        if slept_s > self._SLEEP * usual_s:
            # The frames between two that were waited for are all that the camera gave meanwhile,
            # unless a queue was full.
            if self._lag_s <= self._PAUSE * usual_s:
                self._gaps.extend(self._unlearnt)
            self._unlearnt.clear()
            if self._is_empty(usual_s):
                if gap_s > self._PAUSE * usual_s:
                    # A camera that has become slower.
                    slower_s = min(gap for gap, _ in self._recent)
                    self._gaps = deque([slower_s] * self._SHOWING, self._USUAL)
                self._lag_s = 0.0
        if self._lag_s == 0.0:
            self._worst_s = 0.0
        elif self._worst_s or self._lag_s + self._MARGIN_S > self._STALE_S:
            self._worst_s = max(self._worst_s, self._lag_s + self._MARGIN_S)
        return self._worst_s or self._lag_s

    def _is_empty(self, usual_s: float) -> bool:
        gaps = [gap for gap, _ in self._recent]
        sleeping = sum(slept > self._SLEEP * usual_s for _, slept in self._recent)
        pauses = sum(gap > self._PAUSE * usual_s for gap in gaps)
        return (
            len(gaps) == self._SHOWING
            and pauses in (0, len(gaps))
            and fmean(gaps) >= self._AS_USUAL * usual_s
            and 2 * sleeping >= len(gaps)
        )
