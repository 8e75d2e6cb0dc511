"""Fit the tube of one window: its scale, the unit of its six degrees of freedom, crossed scores.

Each fold is scored by a scale that is fitted on the other folds. For all six degrees of freedom,
for the position and for the rotation apart, the scale either knows only how far along the window a
motion is, or how the robot moved since the anchor as well: the latter where it makes tubes of
recordings that it has not seen 3 % narrower.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.motion.fitting import Normal, Scale, predict_scale, solve_scale
from cvo_edge.motion.horizon_fit import LEVEL, crossed, folds_of
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.thresholds import Scores
from cvo_edge.motion.windows import Window, anchors_of, raised, window_scores, with_six
from cvo_edge.spread import Spread

Array = NDArray[np.float64]

# Columns of scores: the six degrees of freedom, which hold all at once, position, rotation.
_TUBES = (tuple(range(6)), (6,), (7,))
# Of the median error, grown as a random walk: smaller errors are luck, not skill.
_LEAST = 0.5
# A drive has few windows that do not overlap: luck is larger than for horizons.
_WORTH = 0.97
_ZERO = 1e-12


class Tube(NamedTuple):
    """The tube of a window.

    Attributes
    ----------
    scale
        See ``windows``.
    unit
        Shape (6,): thresholds of the degrees of freedom, each for itself.
    usual
        Shape (8,): mean of u at the end of a window.
    scores
        Of each recording, by a scale fitted without it, (anchors, 3): position, rotation, and the
        largest of the six degrees of freedom in their units.
    """

    scale: Scale
    unit: Array
    usual: Array
    scores: list[Array]


class _Tried(NamedTuple):
    """What one kind of scale, fitted without a recording, makes of it.

    Attributes
    ----------
    scores
        Shape (anchors, 8).
    means
        Shape (anchors, 8): mean scales over each window.
    end
        Shape (8,): mean scales at the ends of windows.
    """

    scores: Array
    means: Array
    end: Array


def fit_tube(window: Horizon, errors: Spread[Window], groups: Sequence[str], learned: bool) -> Tube:
    """Fit recordings of several groups, each with a whole window.

    ``learned`` False: the scale knows only how far along the window a motion is.
    """
    folds = folds_of(groups)
    sums = errors.map(_sums, what=f"window {window}").collect()
    own = sums[0].left.shape[0] - (1 if window.unit == "m" else 2)
    models = [crossed(sums, folds, partial(_grown, own=own))]
    if learned:
        models.append(crossed(sums, folds, solve_scale))
    without = [[by_fold[fold] for by_fold, _ in models] for fold in folds]
    tried = errors.map(partial(_tried, window=window), without, what=f"window {window}").collect()
    kinds = [[each[kind] for each in tried] for kind in range(len(models))]
    return _joined([scale for _, scale in models], kinds, groups)


def _sums(found: Window) -> Normal:
    """Return the normal equations of one recording's scales."""
    A = np.concatenate([np.ones((1, len(found.along))), found.numbers])
    grown = np.sqrt(found.along / found.along.max())
    median = np.maximum(np.median(found.errors, axis=0), 1e-9)
    y = np.log(found.errors + _LEAST * median * grown[:, np.newaxis] + 1e-12)
    weighted = A * (found.shares / anchors_of(found))
    return Normal(weighted @ A.T, weighted @ y)


def _grown(sums: Normal, own: int) -> Scale:
    """Return a scale of nothing but how far along the window a motion is, its number ``own``."""
    used = [0, own]
    alone = solve_scale(Normal(sums.left[np.ix_(used, used)], sums.right[used]))
    every = solve_scale(sums)
    coefficients = np.zeros_like(every.coefficients)
    coefficients[used] = alone.coefficients
    return every._replace(coefficients=coefficients)


def _tried(found: Window, scales: Sequence[Scale], window: Horizon) -> list[_Tried]:
    begin, shares = found.begin, found.shares[:, np.newaxis]
    last = np.append(begin[1:], len(found.along)) - 1
    tried = []
    for scale in scales:
        u = predict_scale(scale, found.numbers.T) * raised(window, found.along)[:, np.newaxis]
        means = np.add.reduceat(shares * u, begin, axis=0)
        tried.append(_Tried(window_scores(found, u), means, u[last].mean(axis=0)))
    return tried


def _joined(
    scales: Sequence[Scale], kinds: Sequence[Sequence[_Tried]], groups: Sequence[str]
) -> Tube:
    """Return for each tube the simpler scale, unless another is worth it."""
    units, costs = [], []
    for kind in kinds:
        thresholds = Scores([each.scores for each in kind], groups).thresholds("mean", LEVEL)
        unit = np.maximum(thresholds, _ZERO)
        units.append(unit)
        costs.append([_cost(kind, unit, list(columns), groups) for columns in _TUBES])
    coefficients, unit = scales[0].coefficients.copy(), units[0].copy()
    usual = np.mean([each.end for each in kinds[0]], axis=0)
    scores = [each.scores.copy() for each in kinds[0]]
    for columns, cost in zip(map(list, _TUBES), np.array(costs).T, strict=True):
        chosen = int(np.argmax(_WORTH * cost <= cost.min()))
        coefficients[:, columns] = scales[chosen].coefficients[:, columns]
        unit[columns] = units[chosen][columns]
        usual[columns] = np.mean([each.end for each in kinds[chosen]], axis=0)[columns]
        for joined, each in zip(scores, kinds[chosen], strict=True):
            joined[:, columns] = each.scores[:, columns]
    scale = scales[0]._replace(coefficients=coefficients)
    return Tube(scale, unit[:6], usual, [with_six(each, unit[:6]) for each in scores])


def _cost(kind: Sequence[_Tried], unit: Array, columns: list[int], groups: Sequence[str]) -> float:
    """Return the geometric mean over columns of the mean interval score of whole windows."""
    scores = [(each.scores[:, columns] / unit[columns]).max(axis=1) for each in kind]
    q = float(Scores([each[:, np.newaxis] for each in scores], groups).thresholds("mean", LEVEL)[0])
    penalty = 1.0 / (1.0 - LEVEL)
    costs = [
        np.mean(
            each.means[:, columns] * (q + penalty * np.maximum(score - q, 0.0))[:, np.newaxis],
            axis=0,
        )
        for score, each in zip(scores, kind, strict=True)
    ]
    return float(np.exp(np.mean(np.log(np.maximum(unit[columns] * np.mean(costs, axis=0), _ZERO)))))
