"""How far one label moves thresholds that adapt: see ``adaptation``."""

from __future__ import annotations

import math

ETA, RARE_ETA = 0.3, 0.5
# With more frames than this from one label to the next, labels are rare.
_RARE = 20
# Scores within a factor of 1,000 of the calibrated threshold are those that the bound is about.
REACH = math.log(1000.0)
# Labels under way move x by at most 1, and the last one by at most RARE_ETA.
MOST_STALE = 1.0 + RARE_ETA
LARGEST = REACH + MOST_STALE


def step(gap: int, delay: int) -> float:
    """Return eta for a label ``gap`` frames after the one before and ``delay`` frames late."""
    eta = RARE_ETA if gap > _RARE else ETA
    return min(eta, gap / delay) if delay else eta


def error_bound(labels: int, eta: float, under_way: float) -> float:
    """Return the bound on |share of labelled frames that were missed - alpha|.

    It is (13.8 + (1 + d) eta) / (eta T) for T ``labels`` with the step ``eta`` (the first may have
    a smaller one), of which d = ``under_way`` are given before the first of them arrives; 13.8 =
    2 ln 1000. The scores of labelled frames must lie within a factor of 1,000 of the calibrated
    threshold (or seven units).
    """
    return (2.0 * REACH + (1.0 + under_way) * eta) / (eta * labels)
