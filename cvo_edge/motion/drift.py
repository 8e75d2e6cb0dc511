"""Whether an estimator moves as in the drives that it was calibrated on: no truth is needed.

Thresholds say nothing of a robot that drives faster, turns harder or shakes more than any
calibrated one. The numbers are logarithms of speed, turn rate and their changes, averaged over the
last second, and the means of columns of the file. In units of their spread over calibrated drives,

    d_t = root mean square of those above the mean (a robot that stands still is no concern)
    D_t = D_(t-1) + w (d_t - D_(t-1)),  w = period / 5 s

D starts at d a second after each break. The limit is the largest D of any calibrated drive, so that
a new one that is exchangeable with G of them, and no longer, ever exceeds it with probability at
most 1 / (G + 1).
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.motion.errors import recent_rows
from cvo_edge.motion.kept import Kept
from cvo_edge.motion.recordings import Recording
from cvo_edge.motion.trace import RECENT, Rows, logarithms, recent_numbers
from cvo_edge.spread import Spread

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_MEMORY_S = 5.0
# Of a logarithm: 1 %, and more than means in a file are rounded by.
_LEAST = 1e-2
# Of a second, for estimators whose stamps jitter.
_NEARLY = 0.8


class Familiar(NamedTuple):
    """Mean and spread (k,) of the numbers over calibrated drives, and the limit of D."""

    mean: Array
    spread: Array
    limit: float

    def novelty(self, rows: Rows, ends: Integers) -> Array:
        """Return d (m,) at rows; NaN within a second after a break."""
        recent = recent_rows(rows, ends)
        over = self._over(recent_numbers(rows, recent, ends))
        squares = np.add.reduce(over * over, axis=1)
        novelty = np.sqrt(squares / len(self.mean))
        return np.where(_whole_second(rows, recent, ends), novelty, np.nan)

    def latest(self, kept: Kept) -> float:
        """Return d at the last row of a stream, the same to the last bit."""
        end = len(kept) - 1
        recent = kept.recent(end)
        if 1e-9 * (kept.stamps_ns[end] - kept.stamps_ns[recent]) < _NEARLY * RECENT.value:
            return math.nan
        over = self._over(logarithms(np.array(kept.means(recent, end))[:, np.newaxis]).T)
        return math.sqrt(float(np.add.reduce(over * over, axis=1)[0]) / len(self.mean))

    def _over(self, numbers: Array) -> Array:
        return np.maximum((np.ascontiguousarray(numbers) - self.mean) / self.spread, 0.0)


class Running:
    """D over the rows of a stream."""

    def __init__(self, period_s: float) -> None:
        self._weight = min(1.0, period_s / _MEMORY_S)
        self._part = -1
        self._value = 0.0

    def add(self, novelty: float, part: int) -> float | None:
        """Take the next d, of a row in a part, and return D; None within a second after a break."""
        if novelty != novelty:
            return None
        if part != self._part:
            self._part, self._value = part, novelty
        else:
            self._value += self._weight * (novelty - self._value)
        return self._value

    def all(self, novelty: Array, part: Integers) -> list[float | None]:
        """Do the same for several rows (m,)."""
        return [self.add(*pair) for pair in zip(novelty.tolist(), part.tolist(), strict=True)]


def _whole_second(rows: Rows, recent: Integers, ends: Integers) -> NDArray[np.bool_]:
    seconds = 1e-9 * (rows.stamps_ns[ends] - rows.stamps_ns[recent])
    return np.asarray(seconds >= _NEARLY * RECENT.value)


def fit_familiar(recordings: Spread[Recording], period_s: float) -> Familiar:
    """Return mean, spread and limit of calibrated drives; drives count equally.

    Raises SourceError if no drive has a second without a break.
    """
    means = [each for each in recordings.map(_moments).collect() if each is not None]
    if not means:
        raise SourceError(
            "conformalize: expected a drive with a second of poses without a gap or a jump, found "
            "none"
        )
    mean = np.mean(means, axis=0)
    squares = recordings.map(partial(_moments, about=mean)).collect()
    square = np.mean([each for each in squares if each is not None], axis=0)
    open_ended = Familiar(mean, np.maximum(np.sqrt(square), _LEAST), np.inf)
    largest = recordings.map(partial(_largest, familiar=open_ended, period_s=period_s)).collect()
    return open_ended._replace(limit=max(largest))


def _moments(recording: Recording, about: Array | None = None) -> Array | None:
    """Return the mean of the numbers (k,), or that of their squares about another one.

    None if no second is whole.
    """
    rows = recording.rows
    ends = np.arange(len(rows.part))
    recent = recent_rows(rows, ends)
    ends = ends[_whole_second(rows, recent, ends)]
    if not len(ends):
        return None
    numbers = recent_numbers(rows, recent[ends], ends)
    return np.asarray((numbers if about is None else (numbers - about) ** 2).mean(axis=0))


def _largest(recording: Recording, familiar: Familiar, period_s: float) -> float:
    """Return the largest D of a recording; zero if no second is whole."""
    rows = recording.rows
    novelty = familiar.novelty(rows, np.arange(len(rows.part)))
    running = Running(period_s).all(novelty, rows.part)
    return max((value for value in running if value is not None), default=0.0)
