"""Simulated coverage with few calibration scores: as stated, or unbounded."""

from __future__ import annotations

import math

import numpy as np

from cvo_edge.conformal import conformal_quantile
from fuzz.trials import Tally

SIZES, CONFIDENCES = (19, 20, 100), (0.5, 0.8, 0.9, 0.95, 0.99)
_TESTS = 200
_STANDARD_ERRORS = 4.5


def coverage(count: int) -> Tally:
    """Draw n calibration and 200 test scores, ``count`` times for each n.

    With finite thresholds, the mean coverage must be k/(n + 1), k = ceil((n + 1) confidence),
    within 4.5 standard errors (the coverage of one repetition is Beta-binomial). If k > n, the
    threshold must be unbounded. One trial is one repetition of one n at one confidence.
    """
    tally, said = Tally(), list[str]()
    for n in SIZES:
        generator = np.random.default_rng([2031, n])
        # The distribution may be signed and heavy-tailed, because only the order of scores counts.
        draws = generator.standard_t(2, (count, n + _TESTS))
        for confidence in CONFIDENCES:
            k = math.ceil(round((n + 1) * confidence, 9))
            covered = np.empty(count)
            for row, scores in enumerate(draws):
                q_hat = conformal_quantile(scores[:n], confidence)
                covered[row] = np.mean(scores[n:] <= q_hat)
                unbounded = math.isinf(q_hat)
                wrong = unbounded != (k > n)
                tally.add(
                    f"n {n}, {confidence:g}: {'unbounded' if unbounded else 'bounded'}",
                    f"n {n}, {confidence}: unbounded is {unbounded}" if wrong else None,
                )
            if k > n:
                continue
            expected, a, b = k / (n + 1), k, n + 1 - k
            variance = a * b * (a + b + _TESTS) / ((a + b) ** 2 * (a + b + 1) * _TESTS)
            off = (covered.mean() - expected) / math.sqrt(variance / count)
            said.append(
                f"n {n}, {confidence:g}: {covered.mean():.4f} of {expected:.4f} ({off:+.1f})"
            )
            if abs(off) > _STANDARD_ERRORS:
                tally.findings.append(f"n {n}, {confidence}: {off:.1f} standard errors off")
    tally.summary = f"coverage of k/(n + 1) (standard errors off): {'; '.join(said)}"
    return tally
