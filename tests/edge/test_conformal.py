"""The rank rule and related functions against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cvo_edge.conformal import (
    LinearScale,
    RankScale,
    conformal_quantile,
    conformal_rank,
    effective_sample_size,
    hierarchical_quantile,
    interval_score,
    least_draws,
)
from cvo_edge.errors import UsageError

scores = st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=60)


@pytest.mark.parametrize(
    ("n", "confidence", "rank"),
    [(19, 0.95, 19), (9, 0.9, 9), (8, 0.9, 9), (99, 0.99, 99), (100, 0.9, 91), (39, 0.95, 38)],
)
def test_rank_is_exact_where_the_product_is_whole(n, confidence, rank):
    assert conformal_rank(n, confidence) == rank


@given(scores, st.sampled_from([0.5, 0.8, 0.9, 0.95, 0.99]))
def test_threshold_is_the_order_statistic_or_unbounded(values, confidence):
    k = conformal_rank(len(values), confidence)
    found = conformal_quantile(values, confidence)
    assert found == (sorted(values)[k - 1] if k <= len(values) else math.inf)


@given(scores, st.sampled_from([0.5, 0.8, 0.9]))
def test_threshold_is_never_the_maximum_in_place_of_infinity(values, confidence):
    if math.isfinite(conformal_quantile(values, confidence)):
        assert np.mean(np.array(values) <= conformal_quantile(values, confidence)) >= confidence


@given(scores)
def test_threshold_grows_with_the_confidence(values):
    found = [conformal_quantile(values, c) for c in (0.5, 0.8, 0.9, 0.95, 0.99)]
    assert found == sorted(found)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=40, unique=True))
def test_sequences_of_one_frame_make_the_hierarchical_rule_the_pooled_one(values):
    for confidence in (0.5, 0.8, 0.9):
        assert hierarchical_quantile(values, range(len(values)), confidence) == (
            conformal_quantile(values, confidence)
        )


@pytest.mark.parametrize(("sequences", "bounded"), [(8, False), (9, True), (18, True)])
def test_hierarchical_needs_nine_sequences_at_ninety_percent(sequences, bounded):
    values = np.arange(sequences * 5.0)
    found = hierarchical_quantile(values, np.repeat(np.arange(sequences), 5), 0.9)
    assert math.isfinite(found) is bounded


def test_hierarchical_weighs_sequences_not_frames():
    # One long sequence of small scores must not dominate nine short ones of large scores.
    values = np.concatenate([np.zeros(1000), np.ones(9)])
    sequence = np.concatenate([np.zeros(1000), np.arange(1, 10)])
    assert hierarchical_quantile(values, sequence, 0.8) == 1.0
    assert conformal_quantile(values, 0.8) == 0.0


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.1, math.nan])
def test_confidence_outside_the_unit_interval_is_refused(confidence):
    with pytest.raises(UsageError, match="confidence"):
        conformal_quantile([1.0], confidence)


def test_nan_scores_are_refused():
    with pytest.raises(UsageError, match="1 NaN among 3"):
        conformal_quantile([1.0, math.nan, 2.0], 0.5)
    with pytest.raises(UsageError, match="NaN"):
        hierarchical_quantile([math.nan], [0], 0.5)


def test_linear_scale_divides_and_goes_back():
    scale = LinearScale(np.array([[1.0, 2.0]]))
    comparable = scale.comparable(np.array([[[1.0, 4.0]], [[-1.0, -8.0]]]))
    np.testing.assert_array_equal(comparable, [[[1.0, 2.0]], [[-1.0, -4.0]]])
    np.testing.assert_array_equal(scale.thresholds(3.0), [[3.0, 6.0]])
    with pytest.raises(UsageError, match="positive"):
        LinearScale(np.array([[1.0, 0.0]]))


def test_linear_scale_is_the_ninety_percent_quantile_of_the_size():
    scores = np.random.default_rng(0).standard_normal((200, 2, 6)) * np.arange(1, 7)
    expected = np.quantile(np.abs(scores), 0.9, axis=0)
    np.testing.assert_array_equal(LinearScale.fitted(scores).scales, expected)


unit_scores = st.lists(st.integers(0, 10**6).map(lambda v: v / 1e6), min_size=1, max_size=40)


@given(unit_scores, unit_scores, st.sampled_from([1.0, 1.7]))
def test_rank_scale_keeps_the_order_and_goes_back_without_losing_a_score(fitted, values, top):
    scale = RankScale.fitted(np.array(fitted).reshape(-1, 1, 1), top)
    s = np.sort(values).reshape(-1, 1, 1)
    comparable = scale.comparable(s)[:, 0, 0]
    assert (np.diff(comparable) >= 0).all()
    for value, mapped in zip(s[:, 0, 0], comparable, strict=True):
        assert value <= scale.thresholds(mapped)[0, 0] <= value + 1e-9


def test_rank_scale_passes_through_its_knots_and_has_slope_one_above():
    scale = RankScale.fitted(np.array([0.5, 0.2, 0.2, np.inf]).reshape(-1, 1, 1), 1.0)
    values = np.array([0.0, 0.2, 0.5, 1.0, 1.5, np.inf]).reshape(-1, 1, 1)
    expected = [0.0, 0.4, 0.6, 1.0, 1.5, np.inf]
    np.testing.assert_allclose(scale.comparable(values)[:, 0, 0], expected)


@given(st.floats(-5, 5), st.floats(0, 5), st.floats(-10, 10))
def test_interval_score_is_width_inside_and_grows_twice_over_alpha_outside(low, width, y):
    distance = max(low - y, y - (low + width), 0.0)
    assert interval_score(width, distance, 0.1) == pytest.approx(width + 20.0 * distance)


def test_effective_size_of_independent_draws_is_their_number():
    n = 4000
    draws = np.random.default_rng(0).standard_normal(n)
    assert effective_sample_size(draws) == pytest.approx(n, rel=0.15)


@pytest.mark.parametrize("phi", [0.5, 0.9])
def test_effective_size_of_an_autoregression_is_the_closed_form(phi):
    n = 50_000
    generator = np.random.default_rng(1)
    series = np.zeros(n)
    for index in range(1, n):
        series[index] = phi * series[index - 1] + generator.standard_normal()
    assert effective_sample_size(series) == pytest.approx(n * (1 - phi) / (1 + phi), rel=0.25)


@given(st.floats(0.01, 0.999))
def test_a_threshold_is_finite_from_the_least_number_of_draws_on(confidence):
    n = least_draws(confidence)
    assert conformal_rank(n, confidence) <= n
    assert n == 1 or conformal_rank(n - 1, confidence) > n - 1
