"""At what rate poses come: the median of the last steps, of those that there are at the start."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# So many steps tell a rate that changes within a second, and no single frame that was dropped.
_STEPS = 15


class Rate:
    """The usual time between the last poses of a stream."""

    def __init__(self) -> None:
        self._steps: deque[int] = deque()
        self._sorted: list[int] = []

    def add(self, step_ns: int) -> float:
        """Take the next step and return seconds."""
        if len(self._steps) == _STEPS:
            del self._sorted[bisect_left(self._sorted, self._steps.popleft())]
        self._steps.append(step_ns)
        insort(self._sorted, step_ns)
        return 1e-9 * self._sorted[(len(self._sorted) - 1) // 2]


def periods_s(stamps_ns: Integers) -> Array:
    """Return the same for the poses (n,) of a trajectory, from the second one on, (n - 1,)."""
    steps = np.diff(stamps_ns)
    rate = Rate()
    first = [rate.add(step) for step in steps[: _STEPS - 1].tolist()]
    if len(steps) < _STEPS:
        return np.array(first)
    windows = np.lib.stride_tricks.sliding_window_view(steps, _STEPS)
    middle = np.partition(windows, _STEPS // 2, axis=1)[:, _STEPS // 2]
    return np.concatenate([first, 1e-9 * middle])
