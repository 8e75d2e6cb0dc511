"""Fit one horizon: bias, scale, which of them to use, and the crossed scores of all recordings.

Each fold's models are fitted on the recordings of the other folds; the models that are kept, on
all. For translation and for rotation apart, the variant is used whose intervals are narrowest on
recordings that its models have not seen; a simpler one unless another is 2 % narrower.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cvo_edge.motion.errors import Errors
from cvo_edge.motion.fitting import (
    ERRORS,
    Normal,
    Scale,
    bias_sums,
    eight,
    predict_bias,
    predict_scale,
    scale_sums,
    solve_bias,
    solve_scale,
)
from cvo_edge.motion.thresholds import Scores

Array = NDArray[np.float64]

FOLDS = 12
_LEVEL = 0.9
_WORTH = 0.98
# Columns of scores: the translation's and the rotation's three, and their norms.
HALVES = ((0, 1, 2, 6), (3, 4, 5, 7))
Variant = tuple[bool, bool]
Model = TypeVar("Model", Array, Scale)
_VARIANTS: tuple[Variant, ...] = ((False, False), (True, False), (False, True), (True, True))


class Fit(NamedTuple):
    """Bias and scale of a horizon, each None if it is not used by any column."""

    bias: Array | None
    scale: Scale | None

    def biases(self, errors: Errors) -> Array:
        """Return b (m, 6)."""
        if self.bias is None:
            return np.zeros((len(errors.end), 6))
        return predict_bias(self.bias, errors.numbers)

    def scales(self, errors: Errors) -> Array:
        """Return u (m, 8)."""
        if self.scale is None:
            return np.ones((len(errors.end), ERRORS))
        return predict_scale(self.scale, errors.sizes)

    def scores(self, errors: Errors) -> Array:
        """Return |x - b| / u of the six degrees of freedom and the two norms, (m, 8)."""
        return eight(errors.residuals - self.biases(errors)) / self.scales(errors)


class Crossed(NamedTuple):
    """The fit that is kept, and scores (m, 8) of each recording by models fitted without it.

    ``scaled``: the residuals behind the scores, without their bias and over their scales, (m, 6).

    ``variants``: whether translation and rotation use bias and scale.
    """

    fit: Fit
    scores: list[Array]
    scaled: list[Array]
    variants: tuple[Variant, ...]


class _Tried(NamedTuple):
    """A variant: its fit on all recordings; of each, crossed scores, scales, scaled residuals."""

    fit: Fit
    scores: list[Array]
    scales: list[Array]
    scaled: list[Array]


def fit_horizon(errors: Sequence[Errors], groups: Sequence[str], learned: bool) -> Crossed:
    """Fit the recordings of several groups.

    ``learned`` False: without bias and scale, because there is too little to learn them from.
    """
    names = sorted(set(groups))
    folds = [names.index(group) % FOLDS for group in groups]
    tried = {
        variant: _variant(errors, folds, *variant)
        for variant in (_VARIANTS if learned else _VARIANTS[:1])
    }
    chosen = tuple(_choice(tried, list(half), groups) for half in HALVES)
    return _joined(chosen, tried)


def _variant(errors: Sequence[Errors], folds: Sequence[int], biased: bool, scaled: bool) -> _Tried:
    rests = [each.residuals for each in errors]
    bias, scale = None, None
    if biased:
        of_fold, bias = _crossed(
            [bias_sums(each.numbers, each.residuals) for each in errors], folds, solve_bias
        )
        rests = [
            each.residuals - predict_bias(of_fold[fold], each.numbers)
            for each, fold in zip(errors, folds, strict=True)
        ]
    scales = [np.ones((len(each.end), ERRORS)) for each in errors]
    if scaled:
        sums = [scale_sums(each.sizes, rest) for each, rest in zip(errors, rests, strict=True)]
        by_fold, scale = _crossed(sums, folds, solve_scale)
        scales = [
            predict_scale(by_fold[fold], each.sizes)
            for each, fold in zip(errors, folds, strict=True)
        ]
    scores = [eight(rest) / size for rest, size in zip(rests, scales, strict=True)]
    scaled_rests = [rest / size[:, :6] for rest, size in zip(rests, scales, strict=True)]
    return _Tried(Fit(bias, scale), scores, scales, scaled_rests)


def _crossed(
    sums: Sequence[Normal], folds: Sequence[int], solve: Callable[[Normal], Model]
) -> tuple[list[Model], Model]:
    """Return what is fitted without each fold, and what is fitted on all."""
    without = [
        solve(reduce(Normal.plus, [s for s, of in zip(sums, folds, strict=True) if of != fold]))
        for fold in range(max(folds) + 1)
    ]
    return without, solve(reduce(Normal.plus, sums))


def _choice(tried: Mapping[Variant, _Tried], columns: list[int], groups: Sequence[str]) -> Variant:
    """Return the first variant that is hardly worse than the best one, in some columns."""
    costs = {variant: _cost(each, columns, groups) for variant, each in tried.items()}
    best = min(costs.values())
    return next(variant for variant, cost in costs.items() if _WORTH * cost <= best)


def _cost(tried: _Tried, columns: list[int], groups: Sequence[str]) -> float:
    """Return the geometric mean over columns of the mean interval score of crossed intervals."""
    scores = [each[:, columns] for each in tried.scores]
    q = Scores(scores, groups).thresholds("mean", _LEVEL)
    penalty = 1.0 / (1.0 - _LEVEL)
    costs = [
        np.mean(size[:, columns] * (q + penalty * np.maximum(score - q, 0.0)), axis=0)
        for score, size in zip(scores, tried.scales, strict=True)
    ]
    return float(np.exp(np.mean(np.log(np.maximum(np.mean(costs, axis=0), 1e-12)))))


def _joined(chosen: tuple[Variant, ...], tried: Mapping[Variant, _Tried]) -> Crossed:
    """Return what is used of each half's variant; zero coefficients for what is not."""
    first = next(iter(tried.values()))
    scores, scaled = ([each.copy() for each in kind] for kind in (first.scores, first.scaled))
    bias: Array | None = None
    scale: Scale | None = None
    for half, variant in zip(HALVES, chosen, strict=True):
        columns, own = list(half), tried[variant]
        for joined, each in zip(scores, own.scores, strict=True):
            joined[:, columns] = each[:, columns]
        for joined, each in zip(scaled, own.scaled, strict=True):
            joined[:, columns[:3]] = each[:, columns[:3]]
        if own.fit.bias is not None:
            bias = np.zeros_like(own.fit.bias) if bias is None else bias
            bias[:, columns[:3]] = own.fit.bias[:, columns[:3]]
        if own.fit.scale is not None:
            plain = np.zeros_like(own.fit.scale.coefficients)
            scale = own.fit.scale._replace(coefficients=plain) if scale is None else scale
            scale.coefficients[:, columns] = own.fit.scale.coefficients[:, columns]
    return Crossed(Fit(bias, scale), scores, scaled, chosen)
