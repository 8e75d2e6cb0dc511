"""Fit one horizon: bias, scale, which of them to use, and the crossed scores of all recordings.

Each fold's models are fitted on the recordings of the other folds; the models that are kept, on
all. For translation and for rotation apart, the variant is used whose intervals are narrowest on
recordings that its models have not seen; a simpler one unless another is 2 % narrower.

A scale that is fitted to single errors is flatter than their spread: where it is largest, too few
errors are inside. Its logarithm is stretched by the least factor with which the quarter of a
recording's motions that it calls hardest is covered as stated, if intervals become at most 5 %
wider.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, reduce
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
from cvo_edge.spread import Spread

Array = NDArray[np.float64]

FOLDS = 12
LEVEL = 0.9
_WORTH = 0.98
_STRETCHES = (1.0, 1.1, 1.2, 1.3, 1.4, 1.5)
_HARDEST = 0.75
_WIDEST = 1.05
# So many motions of a recording tell how far to stretch.
_SAMPLE = 1000
# Columns of scores: the translation's and the rotation's three, and their norms.
HALVES = ((0, 1, 2, 6), (3, 4, 5, 7))
Variant = tuple[bool, bool]
Model = TypeVar("Model", Array, Scale)
_VARIANTS: tuple[Variant, ...] = ((False, False), (True, False), (False, True), (True, True))


class Fit(NamedTuple):
    """Bias and scale of a horizon, each None if it is not used by any column."""

    bias: Array | None
    scale: Scale | None

    def scales(self, errors: Errors) -> Array:
        """Return u (m, 8)."""
        if self.scale is None:
            return np.ones((len(errors.end), ERRORS))
        return predict_scale(self.scale, errors.sizes)


class Tried(NamedTuple):
    """What the models that do not know a recording make of it.

    Attributes
    ----------
    rests
        Residuals (m, 6) without and with their bias taken off.
    eights
        Sizes (m, 8) of these: of the six degrees of freedom, and the two norms.
    sizes
        Scales (m, 8) for each of them; None if there are none.
    """

    rests: tuple[Array, ...]
    eights: tuple[Array, ...]
    sizes: tuple[Array, ...] | None

    def scales(self, variant: Variant) -> Array:
        """Return scales (m, 8), or a one for all."""
        return self.sizes[variant[0]] if self.sizes and variant[1] else _ONE

    def scores(self, variant: Variant) -> Array:
        """Return |x - b| / u of the six degrees of freedom and the two norms, (m, 8)."""
        return self.eights[variant[0]] / self.scales(variant)


class Crossed(NamedTuple):
    """The fit that is kept, and the scores of each recording by models fitted without it.

    Attributes
    ----------
    fit
        Bias and scale.
    scaled
        Of each recording, residuals over their scales, (m, 6), and scores (m, 8).
    variants
        Whether translation and rotation use bias and scale.
    """

    fit: Fit
    scaled: Spread[tuple[Array, Array]]
    variants: tuple[Variant, ...]


_ONE = np.ones((1, ERRORS))


class Stretch(NamedTuple):
    """Scales u become exp(middle + factor (log u - middle)); both are of shape (8,)."""

    middle: Array
    factor: Array

    def of(self, scales: Array) -> Array:
        """Return stretched scales (m, 8)."""
        if (self.factor == 1.0).all():
            return scales
        off = np.log(scales) - self.middle
        return np.asarray(np.exp(self.middle + self.factor * off))


_AS_IS = Stretch(np.zeros(ERRORS), np.ones(ERRORS))


class _Models(NamedTuple):
    """Bias, and scale of errors without and with their bias taken off."""

    bias: Array
    scales: tuple[Scale, Scale]


def fit_horizon(
    errors: Spread[Errors], groups: Sequence[str], learned: bool, *, biased: bool = True
) -> Crossed:
    """Fit the recordings of several groups.

    ``learned`` False: without bias and scale, because there is too little to learn them from.
    ``biased`` False: never with a bias.
    """
    if not learned:
        plain = errors.map(_plain)
        return Crossed(Fit(None, None), plain.map(_joined), (_VARIANTS[0],) * len(HALVES))
    folds = folds_of(groups)
    biases, plain_sums = zip(*errors.map(_first_sums).collect(), strict=True)
    of_fold, bias = crossed(biases, folds, solve_bias)
    own = [of_fold[fold] for fold in folds]
    rest_sums = errors.map(_second_sums, own).collect()
    scales = [crossed(sums, folds, solve_scale) for sums in (plain_sums, rest_sums)]
    without = [
        _Models(each, (plain, rest))
        for each, plain, rest in zip(of_fold, scales[0][0], scales[1][0], strict=True)
    ]
    tried = errors.map(_tried, [without[fold] for fold in folds])
    thresholds = [
        Scores(tried.map(partial(Tried.scores, variant=each)).collect(), groups).thresholds(
            "mean", LEVEL
        )
        for each in _VARIANTS
    ]
    costs = np.mean(tried.map(partial(_costs, thresholds=thresholds)).collect(), axis=0)
    if not biased:
        costs[[each for each, _ in _VARIANTS]] = np.inf
    chosen = tuple(_choice(costs[:, half]) for half in HALVES)
    whole = _Models(bias, (scales[0][1], scales[1][1]))
    stretch = stretched(tried.map(partial(_sample, chosen=chosen)).collect(), groups)
    joined = tried.map(partial(_joined, chosen=chosen, stretch=stretch))
    return Crossed(_kept(whole, chosen, stretch), joined, chosen)


def _first_sums(errors: Errors) -> tuple[Normal, Normal]:
    """Return the sums of the bias, and those of the scale of errors with their bias."""
    return bias_sums(errors.numbers, errors.residuals), scale_sums(errors.sizes, errors.residuals)


def _second_sums(errors: Errors, bias: Array) -> Normal:
    """Return the sums of the scale of errors without their bias."""
    return scale_sums(errors.sizes, errors.residuals - predict_bias(bias, errors.numbers))


def _plain(errors: Errors) -> Tried:
    return Tried((errors.residuals,), (eight(errors.residuals),), None)


def _tried(errors: Errors, models: _Models) -> Tried:
    rest = errors.residuals - predict_bias(models.bias, errors.numbers)
    plain, without = (predict_scale(each, errors.sizes) for each in models.scales)
    rests = errors.residuals, rest
    return Tried(rests, (eight(rests[0]), eight(rest)), (plain, without))


def _costs(tried: Tried, thresholds: Sequence[Array]) -> Array:
    """Return the mean interval score of each variant's crossed intervals, (variants, 8)."""
    penalty = 1.0 / (1.0 - LEVEL)
    costs = []
    for variant, q in zip(_VARIANTS, thresholds, strict=True):
        over = np.maximum(tried.scores(variant) - q, 0.0)
        costs.append(np.mean(tried.scales(variant) * (q + penalty * over), axis=0))
    return np.array(costs)


def _choice(costs: Array) -> Variant:
    """Return the first variant that is hardly worse than the best one, by costs (variants, k).

    Columns count by their geometric mean.
    """
    means = np.exp(np.mean(np.log(np.maximum(costs, 1e-12)), axis=1))
    return _VARIANTS[int(np.argmax(_WORTH * means <= means.min()))]


def _sample(tried: Tried, chosen: Sequence[Variant]) -> tuple[Array, Array]:
    """Return scores and scales (m, 8) of some motions, evenly over the recording."""
    _, scores = _joined(tried, chosen)
    scales = np.empty_like(scores)
    for half, variant in zip(HALVES, chosen, strict=True):
        scales[:, list(half)] = tried.scales(variant)[:, list(half)]
    some = slice(None, None, 1 + len(scores) // _SAMPLE)
    return scores[some], scales[some]


def stretched(samples: Sequence[tuple[Array, Array]], groups: Sequence[str]) -> Stretch:
    """Return how far to stretch the scales behind crossed scores, of each column for itself."""
    middle = np.mean([np.log(scales).mean(axis=0) for _, scales in samples], axis=0)
    hard = [scales >= np.quantile(scales, _HARDEST, axis=0) for _, scales in samples]
    inside, widths = [], []
    for factor in _STRETCHES:
        stretch = Stretch(middle, np.full(ERRORS, factor))
        stretched = [stretch.of(scales) for _, scales in samples]
        scores = [
            each * scales / after for (each, scales), after in zip(samples, stretched, strict=True)
        ]
        q = Scores(scores, groups).thresholds("mean", LEVEL)
        shares = [
            ((each <= q) & most).sum(axis=0) / most.sum(axis=0)
            for each, most in zip(scores, hard, strict=True)
        ]
        inside.append(np.mean(shares, axis=0))
        widths.append(q * np.mean([after.mean(axis=0) for after in stretched], axis=0))
    reached = (np.array(inside) >= LEVEL) & (np.array(widths) <= _WIDEST * widths[0])
    # Without any, the first: as it is.
    return Stretch(middle, np.array(_STRETCHES)[np.argmax(reached, axis=0)])


def _joined(
    tried: Tried,
    chosen: Sequence[Variant] = (_VARIANTS[0], _VARIANTS[0]),
    stretch: Stretch = _AS_IS,
) -> tuple[Array, Array]:
    """Return scaled residuals (m, 6) and scores (m, 8), each half by its variant."""
    scaled, scores = np.empty_like(tried.rests[0]), np.empty_like(tried.eights[0])
    for half, variant in zip(HALVES, chosen, strict=True):
        columns, sizes = list(half), stretch.of(tried.scales(variant))
        scores[:, columns] = tried.eights[variant[0]][:, columns] / sizes[:, columns]
        scaled[:, columns[:3]] = tried.rests[variant[0]][:, columns[:3]] / sizes[:, columns[:3]]
    return scaled, scores


def folds_of(groups: Sequence[str]) -> list[int]:
    """Return the fold of each recording; those of one group are together."""
    names = sorted(set(groups))
    return [names.index(group) % FOLDS for group in groups]


def crossed(
    sums: Sequence[Normal], folds: Sequence[int], solve: Callable[[Normal], Model]
) -> tuple[list[Model], Model]:
    """Return what is fitted without each fold, and what is fitted on all."""
    count = max(folds) + 1
    of_fold = [
        reduce(Normal.plus, [each for each, own in zip(sums, folds, strict=True) if own == fold])
        for fold in range(count)
    ]
    without = [
        solve(reduce(Normal.plus, [each for other, each in enumerate(of_fold) if other != fold]))
        for fold in range(count)
    ]
    return without, solve(reduce(Normal.plus, of_fold))


def _kept(models: _Models, chosen: Sequence[Variant], stretch: Stretch) -> Fit:
    """Return what is used of models of all recordings; zero coefficients for what is not."""
    bias: Array | None = None
    scale: Scale | None = None
    for half, (biased, scaled) in zip(HALVES, chosen, strict=True):
        columns = list(half)
        if biased:
            bias = np.zeros_like(models.bias) if bias is None else bias
            bias[:, columns[:3]] = models.bias[:, columns[:3]]
        if scaled:
            own = models.scales[biased]
            if scale is None:
                scale = own._replace(coefficients=np.zeros_like(own.coefficients))
            scale.coefficients[:, columns] = own.coefficients[:, columns] * stretch.factor[columns]
            scale.coefficients[0, columns] += stretch.middle[columns] * (
                1.0 - stretch.factor[columns]
            )
    return Fit(bias, scale)
