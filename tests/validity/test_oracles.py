"""Thresholds and sets against independent implementations: MAPIE, crepes and plain numpy."""

import math
import warnings
from typing import get_args

import numpy as np
import pytest
from crepes import ConformalRegressor
from mapie.regression import ConformalizedQuantileRegressor
from mapie.utils import _compute_regression_quantile

from cvo_edge.conformal import conformal_quantile, conformal_rank
from cvo_edge.heads.cqr import IntervalScore
from cvo_edge.heads.csp import Score, class_scores

LEVELS = [0.5, 0.8, 0.9, 0.95]


class Column:
    """A fitted scikit-learn regressor that predicts one column of its input."""

    is_fitted = True

    def __init__(self, number):
        self.number = number

    def fit(self, x, y):
        return self

    def predict(self, x):
        return np.asarray(x)[:, self.number]

    def __sklearn_is_fitted__(self):
        return True


def intervals(n, seed=0):
    """Random bounds, points and truths, (n,) each; some truths lie outside their bounds."""
    generator = np.random.default_rng((seed, n))
    middle = generator.standard_normal(n)
    half = 0.2 + generator.random(n)
    return middle - half, middle + half, middle, middle + generator.standard_normal(n)


def sides(lower, upper, point, truth):
    """Return the runtime's additive scores for the lower and the upper bound, (n,) each."""
    columns = (np.tile(values[:, np.newaxis], 6) for values in (lower, upper, point, truth))
    return IntervalScore(None).sides(*columns)[..., 0].T


def mapie_intervals(n, confidence, symmetric):
    lower, upper, point, truth = intervals(n)
    x = np.stack([lower, upper, point], axis=1)
    regressor = ConformalizedQuantileRegressor(
        [Column(0), Column(1), Column(2)], confidence_level=confidence, prefit=True
    ).conformalize(x, truth)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about crossing bounds
        _, found = regressor.predict_interval(x, symmetric_correction=symmetric)
    return found[:, :, 0]


@pytest.mark.parametrize("confidence", LEVELS)
def test_symmetric_thresholds_are_those_of_mapie_for_every_n(confidence):
    for n in range(math.ceil(1.0 / (1.0 - confidence) - 1e-9), 151):
        lower, upper, point, truth = intervals(n)
        q_hat = conformal_quantile(np.maximum(*sides(lower, upper, point, truth)), confidence)
        expected = mapie_intervals(n, confidence, symmetric=True)
        np.testing.assert_allclose(lower - q_hat, expected[:, 0], atol=1e-9, err_msg=f"n={n}")
        np.testing.assert_allclose(upper + q_hat, expected[:, 1], atol=1e-9, err_msg=f"n={n}")


@pytest.mark.parametrize("confidence", LEVELS[1:])
def test_the_least_n_with_a_finite_threshold_is_that_of_mapie(confidence):
    # MAPIE's regressor refuses n = 1/alpha - 1, where its own quantile is still finite.
    n = math.ceil(1.0 / (1.0 - confidence) - 1.0 - 1e-9)
    scores = np.maximum(*sides(*intervals(n)))
    found = _compute_regression_quantile(scores, np.array([confidence]))
    assert conformal_quantile(scores, confidence) == found.item()
    with pytest.raises(ValueError, match="too low"):
        _compute_regression_quantile(scores[1:], np.array([confidence]))
    assert conformal_quantile(scores[1:], confidence) == math.inf


@pytest.mark.parametrize("confidence", [0.8, 0.9])
def test_asymmetric_thresholds_are_those_of_mapie_for_every_n(confidence):
    level = 0.5 + 0.5 * confidence
    for n in range(math.ceil(1.0 / (1.0 - level) - 1e-9), 151):
        lower, upper, point, truth = intervals(n)
        below, above = sides(lower, upper, point, truth)
        expected = mapie_intervals(n, confidence, symmetric=False)
        low = lower - conformal_quantile(below, level)
        high = upper + conformal_quantile(above, level)
        np.testing.assert_allclose(low, expected[:, 0], atol=1e-9, err_msg=f"n={n}")
        np.testing.assert_allclose(high, expected[:, 1], atol=1e-9, err_msg=f"n={n}")


@pytest.mark.parametrize("confidence", LEVELS)
def test_symmetric_thresholds_are_those_of_crepes_but_where_its_index_is_rounded(confidence):
    differing = set()
    for n in range(10, 301):
        scores = np.abs(np.maximum(*sides(*intervals(n))))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about too few examples
            found = ConformalRegressor().fit(scores).predict_int(np.zeros(1), confidence=confidence)
        expected = conformal_quantile(scores, confidence)
        if found[0, 1] == expected:
            continue
        differing.add(n)
        # crepes uses one rank more, which is valid but slightly wider.
        k = conformal_rank(n, confidence)
        assert found[0, 1] == (np.sort(scores)[k] if k < n else math.inf)
    assert differing == ROUNDED_BY_CREPES[confidence]


# Sizes n for which (1 - confidence) * (n + 1) is whole but slightly less in floating point.
ROUNDED_BY_CREPES: dict[float, set[int]] = {
    0.5: set(),
    0.8: set(range(14, 301, 5)),
    0.9: set(range(19, 301, 10)),
    0.95: set(),
}


def plain_score(p, y, score, penalty, free):
    """Compute the score of class y from its definition, one number at a time."""
    if score == "lac":
        return 1.0 - p[y]
    ranked = sorted(range(len(p)), key=lambda k: (-p[k], k))
    rank = ranked.index(y) + 1
    total = sum(p[k] for k in ranked[:rank])
    return total + (penalty * max(0, rank - free) if score == "raps" else 0.0)


@pytest.mark.parametrize("score", get_args(Score))
def test_class_scores_are_their_definition(score):
    generator = np.random.default_rng(1)
    p = generator.dirichlet(np.full(12, 0.3), size=(30, 6))
    p[0] = 1 / 12  # ties are ranked by class number
    found = class_scores(p, score, 0.1, 2)
    for frame in range(30):
        for dof in range(6):
            for y in range(12):
                expected = plain_score(p[frame, dof].tolist(), y, score, 0.1, 2)
                assert found[frame, dof, y] == pytest.approx(expected, abs=1e-12)
