"""What the val frames decide: the score, and whether a difficulty scales the sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import PoseSpec, Threshold
from cvo_edge.conformal import conformal_quantiles, interval_score
from cvo_edge.heads import Candidate, Head
from cvo_edge.pose import Chart
from cvo_export.bundles.difficulty import fitted_difficulty
from cvo_export.bundles.draft import Draft
from cvo_export.bundles.entries import entry_of, marginal_thresholds
from cvo_export.bundles.observed import Observed

Array = NDArray[np.float64]

_LEVEL = 0.9
# Margin by which another score must win on val; smaller differences may be chance.
_CLEARLY = 0.05
# With a difficulty: how much the interval scores of clean and of noisy frames may rise, and how
# many misses fewer there must be.
_PRICES, _GAIN = (0.15, 1 / 3), 0.1
# With fewer val frames, the frames that a difficulty is fitted to also decide about it.
_HALVED = 100


def chosen(draft: Draft, val: Observed, candidates: Sequence[Candidate]) -> Candidate:
    """Return the candidate to use: the first, unless another is clearly better on val.

    Candidates are compared by the interval score at 0.9 over each DoF's standard deviation, with
    thresholds from val itself; val is too small to separate closer candidates. Degrees of freedom
    that stand still do not count.
    """
    heads = [draft.head(candidate) for candidate in candidates]
    results = [_loss(draft, head, _threshold(head, val), val) for head in heads]
    best = int(np.argmin(results))
    return candidates[best if results[best] < (1.0 - _CLEARLY) * results[0] else 0]


def with_difficulty(draft: Draft, candidate: Candidate, val: Observed, noisy: Observed) -> Draft:
    """Return a draft that has no difficulty with one, if val speaks for it.

    It is fitted to val frames as they are and to noisy copies of val frames. At thresholds of the
    frames as they are, a tenth fewer of the noisy truths have to be missed, and the interval score
    may rise by 15 % for clean frames and by a third for noisy ones. If there are enough val frames,
    each half of them decides on a difficulty of the other one.
    """
    plain = draft.head(candidate)

    def fitted(clean: Observed, copies: Observed) -> Draft:
        entry = _threshold(plain, clean)
        return replace(draft, difficulty=fitted_difficulty(plain, entry, clean, copies))

    halves = [(val, noisy)]
    if len(val.indices) >= _HALVED:
        middle = np.median(val.indices)
        first, copied = val.indices < middle, noisy.indices < middle
        halves = [
            (val.where(first), noisy.where(copied)),
            (val.where(~first), noisy.where(~copied)),
        ]
    before, after = np.zeros(3), np.zeros(3)
    for fits, decides in zip(halves, reversed(halves), strict=True):
        before += _judged(draft, plain, *decides)
        after += _judged(draft, fitted(*fits).head(candidate), *decides)
    most = np.array([*(1.0 + price for price in _PRICES), 1.0 - _GAIN])
    return fitted(val, noisy) if (after <= most * before).all() else draft


def _judged(draft: Draft, head: Head, clean: Observed, noisy: Observed) -> Array:
    """Return the interval scores of both, and the share of noisy truths that are missed, (3,)."""
    entry = _threshold(head, clean)
    sets = noisy.sets(head, entry)
    inside = np.mean([each.covers(y) for each, y in zip(sets, noisy.truth, strict=True)])
    return np.array([*(_loss(draft, head, entry, each) for each in (clean, noisy)), 1.0 - inside])


def _threshold(head: Head, frames: Observed) -> Threshold:
    """Return the marginal threshold at 0.9 that these frames give."""
    scores = head.scores(frames.outputs, frames.point, frames.truth)
    found = marginal_thresholds(head, scores, [_LEVEL], conformal_quantiles)[0]
    return entry_of(_LEVEL, "marginal", found)


def _loss(draft: Draft, head: Head, entry: Threshold, frames: Observed) -> float:
    """Return the interval score of frames over each DoF's standard deviation, their mean."""
    limits = workspace(draft.pose)
    sets = [each.within(*limits) for each in frames.sets(head, entry)]
    width = np.array([each.width() for each in sets])
    distance = np.array([each.distance(y) for each, y in zip(sets, frames.truth, strict=True)])
    deviation = np.array(draft.pose.standard_deviation)
    score = interval_score(width, distance, 1.0 - _LEVEL) / deviation
    return float(score[:, moving(draft.pose)].mean())


def moving(pose: PoseSpec) -> NDArray[np.bool_]:
    """Return which degrees of freedom scores are about, (6,): those that moved, or all if none."""
    names = Chart(pose.rotation).dof
    moves = np.array([name not in pose.still for name in names])
    return moves if moves.any() else ~moves


def workspace(pose: PoseSpec) -> tuple[Array, Array]:
    """Return the lowest and highest value per DoF, (6,) each, that replace unbounded sides."""
    limits = pose.limits
    lowest, highest = np.array(limits.lowest), np.array(limits.highest)
    if pose.rotation == "tangent_predicted":
        # Offsets from the prediction: at most half a turn.
        lowest[3:], highest[3:] = -np.pi, np.pi
    return lowest, highest
