"""Whether recordings are still like those of the calibration: a conformal test martingale.

Each recording has one number, the mean ``novelty`` of its frames. Its p-value is its smoothed rank
among the calibration's recordings and all earlier ones. While recordings are exchangeable, p-values
are independent and uniform whatever the distribution, so that betting against them is a fair game:
the capital is a martingale that starts at 1, and passes ``ALARM`` = 20 ever with probability at
most 1/20 (Ville's inequality).

Vovk, Gammerman, Shafer, Algorithmic Learning in a Random World, chapter 8 (2022), with the simple
mixture of power martingales; calibration apart from the test as in Volkhonskiy et al. 2017,
"Inductive conformal martingales".
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

ALARM = 20.0
# Capital is reported up to exp of this, near the largest float.
_MOST = 700.0
# Draws of the ranks of equal numbers; fixed, so that the same recordings give the same result.
_SEED = 0


class Bet(NamedTuple):
    """p-value of a recording in (0, 1], the capital after it, and whether it ever passed ALARM."""

    p: float
    martingale: float
    alarm: bool


class RecordingMartingale:
    """The martingale over recordings in the order in which they were made.

    ``reference`` holds the mean novelty of each calibration recording.
    """

    def __init__(self, reference: Sequence[float]) -> None:
        self._seen = list(reference)
        self._generator = np.random.default_rng(_SEED)
        self._surprises: list[float] = []
        self._alarm = False

    def add(self, novelty: float) -> Bet:
        """Bet on the mean novelty of the next recording."""
        self._seen.append(novelty)
        p = p_value(self._seen, 1.0 - float(self._generator.random()))
        self._surprises.append(-math.log(p))
        martingale = mixture(len(self._surprises), math.fsum(self._surprises))
        self._alarm = self._alarm or martingale >= ALARM
        return Bet(p, martingale, self._alarm)


def p_value(seen: Sequence[float], share: float) -> float:
    """Return the smoothed p-value of the last number; ``share`` in (0, 1] is that of equal ones."""
    values = np.asarray(seen)
    larger, equal = np.sum(values > values[-1]), np.sum(values == values[-1])
    return float((larger + share * equal) / len(values))


def mixture(count: int, surprise: float) -> float:
    """Return the integral over e in (0, 1) of the product of e p^(e - 1), at most exp(700).

    ``count`` p-values have the sum ``surprise`` of -ln p. The integral is exp(s) s^-(n+1) times the
    lower incomplete gamma function at (n + 1, s), whose series is a sum of s^k / (n+1)...(n+1+k).
    """
    # From here on, each term is at most half of the one before it.
    terms = int(2.0 * surprise) + 64
    factors = np.concatenate([[1.0], np.full(terms, surprise)]) / (
        count + 1.0 + np.arange(terms + 1)
    )
    with np.errstate(divide="ignore"):
        logarithms = np.cumsum(np.log(factors))
    largest = float(logarithms.max())
    total = largest + math.log(float(np.sum(np.exp(logarithms - largest))))
    return math.exp(min(total, _MOST))


def mean_novelty(values: Iterable[float | None]) -> tuple[int, float | None]:
    """Return how many frames were judged, and their mean novelty, six digits (None without any)."""
    judged = [value for value in values if value is not None]
    return len(judged), round(math.fsum(judged) / len(judged), 6) if judged else None
