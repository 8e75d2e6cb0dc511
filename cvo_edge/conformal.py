"""Split conformal prediction: the rank rule, the joint score, coverage, width, interval score.

Every formula that turns scores into a threshold or sets into a figure is here, once.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvo_edge.errors import UsageError

Array = NDArray[np.float64]

# Absorbs the rounding of products like 20 * 0.95, which must count as exactly 19.
_RANK_TOLERANCE = 1e-9


def conformal_rank(n: int, confidence: float) -> int:
    """Rank k = ceil((n + 1) * confidence): the k-th smallest of n scores is the threshold."""
    if not 0.0 < confidence < 1.0:
        raise UsageError(f"confidence: expected a number between 0 and 1, found {confidence}")
    return max(1, math.ceil((n + 1) * confidence - _RANK_TOLERANCE))


def conformal_quantile(scores: ArrayLike, confidence: float) -> float:
    """q_hat of one-dimensional scores (n,): the k-th smallest, infinite where k > n.

    For exchangeable scores P(new score <= q_hat) >= confidence, and <= confidence + 1/(n + 1)
    without ties (Vovk et al. 2005; Angelopoulos and Bates 2021, section 1). With k > n no finite
    threshold has that property: the maximum would claim what is not there.

    Raises UsageError for NaN scores.
    """
    values = _checked(scores)
    k = conformal_rank(values.size, confidence)
    if k > values.size:
        return math.inf
    return float(np.partition(values, k - 1)[k - 1])


def hierarchical_quantile(scores: ArrayLike, sequence: ArrayLike, confidence: float) -> float:
    """q_hat for a *new* sequence, from scores (n,) grouped by ``sequence`` (n,).

    The confidence quantile of sum_g sum_i delta(s_gi) / ((G + 1) n_g) + delta(inf) / (G + 1)
    (Lee, Barber and Willett 2023, arXiv 2306.06342): sequences are exchangeable, frames within
    one need not be. Finite only where G / (G + 1) >= confidence (G >= 9 at 0.9).

    Raises UsageError for NaN scores.
    """
    values = _checked(scores)
    _, group, sizes = np.unique(np.asarray(sequence), return_inverse=True, return_counts=True)
    weights = 1.0 / ((sizes.size + 1) * sizes[group])
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    index = int(np.searchsorted(cumulative, confidence - _RANK_TOLERANCE))
    return float(values[order[index]]) if index < values.size else math.inf


def joint_scores(scores: ArrayLike, scales: ArrayLike) -> Array:
    """One score a frame for all six DoF: max_d s_d / m_d. Shapes (n, 6), (6,) -> (n,).

    ``scales`` m_d are positive and chosen on data other than the calibration set; the threshold of
    DoF d is then m_d * q_hat, and the six intervals hold together.
    """
    s, m = np.asarray(scores, dtype=np.float64), np.asarray(scales, dtype=np.float64)
    if not (m > 0).all():
        raise UsageError(f"joint scales: expected positive numbers, found {m.tolist()}")
    return np.asarray((s / m).max(axis=-1))


def interval_score(width: ArrayLike, distance: ArrayLike, alpha: float) -> Array:
    """Winkler's score of sets (Gneiting and Raftery 2007, eq. 43); smaller is better.

    Width (any shape; for a union of bands its measure) plus 2/alpha times the distance of the truth
    to the set (same shape, 0 inside); the result has their shape and unit.
    """
    return np.asarray(width, np.float64) + (2.0 / alpha) * np.asarray(distance, np.float64)


def effective_sample_size(scores: ArrayLike) -> float:
    """How many independent draws scores (n,) in time order are worth: n / (1 + 2 sum rho_k).

    rho_k is the autocorrelation at lag k; the sum ends before the first pair of lags (2m, 2m + 1)
    whose correlations add up to no more than zero (initial positive sequence, Geyer 1992). Never
    more than n.
    """
    s = _checked(scores)
    n = s.size
    centred = s - s.mean()
    variance = float(centred @ centred)
    if n < 3 or variance == 0.0:
        return float(n)
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(centred, size)
    rho = np.fft.irfft(spectrum * spectrum.conj(), size)[:n] / variance
    pairs = 0.0
    for lag in range(0, n - 1, 2):
        pair = float(rho[lag] + rho[lag + 1])
        if pair <= 0.0:
            break
        pairs += pair
    # The first pair holds rho_0 = 1, which counts once.
    return float(n / max(1.0, 2.0 * pairs - 1.0))


def _checked(scores: ArrayLike) -> Array:
    values = np.asarray(scores, dtype=np.float64)
    if values.ndim != 1:
        raise UsageError(f"scores: expected one dimension, found shape {values.shape}")
    if np.isnan(values).any():
        count = int(np.isnan(values).sum())
        raise UsageError(f"scores: expected numbers, found {count} NaN among {values.size}")
    return values
