"""The rank rule and related functions against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cvo_edge.conformal import (
    LinearScale,
    RankScale,
    capped_quantile,
    conformal_quantile,
    conformal_rank,
    effective_sample_size,
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
def test_recordings_of_one_frame_with_a_cap_of_1_make_the_pooled_rule(values):
    for confidence in (0.5, 0.8, 0.9):
        assert capped_quantile(values, range(len(values)), confidence, 1.0) == (
            conformal_quantile(values, confidence)
        )


# Percents, so that definitions can be checked in whole numbers.
CONFIDENCES, CAPS = (50, 80, 90, 95, 99), (1, 5, 25, 50, 77, 100)
# A common multiple of the numbers of frames below.
PARTS = 840


@pytest.fixture(scope="module")
def groups():
    """Scores, recordings and a confidence and cap in percent, drawn 1000 times; every second has
    ties."""
    generator = np.random.default_rng(0)
    drawn = []
    for trial in range(1000):
        sizes = generator.integers(1, 9, generator.integers(1, 22))
        values = 3.0 * generator.standard_normal(sizes.sum())
        if trial % 2:
            values = np.round(values)
        sequence = generator.permutation(np.repeat(np.arange(sizes.size), sizes))
        drawn.append(
            (values, sequence, *map(int, (generator.choice(CONFIDENCES), generator.choice(CAPS))))
        )
    return drawn


def by_definition(values, sequence, confidence, cap):
    """The least score with (sum_g L_g + cap) / (G + 1) <= alpha, by counting in whole numbers."""
    numbers, sizes = np.unique(sequence, return_counts=True)
    candidates = np.unique(values)
    above = values > candidates[:, None]
    missed = sum(
        above[:, sequence == number].sum(axis=1) * (PARTS // size)
        for number, size in zip(numbers, sizes, strict=True)
    )
    within = 100 * missed + cap * PARTS <= (100 - confidence) * (sizes.size + 1) * PARTS
    return candidates[np.argmax(within)] if within.any() else math.inf


def hierarchical(values, sequence, confidence):
    """The confidence quantile of all scores, weighted 1/((G + 1) n_g), and of 1/(G + 1) at inf."""
    _, group, sizes = np.unique(sequence, return_inverse=True, return_counts=True)
    weights = 1.0 / ((sizes.size + 1) * sizes[group])
    order = np.argsort(values, kind="stable")
    index = int(np.searchsorted(np.cumsum(weights[order]), confidence - 1e-9))
    return float(values[order[index]]) if index < values.size else math.inf


def test_the_capped_rule_is_its_definition(groups):
    for values, sequence, confidence, cap in groups:
        assert capped_quantile(values, sequence, confidence / 100, cap / 100) == by_definition(
            values, sequence, confidence, cap
        )


def test_a_cap_of_1_is_hierarchical_conformal_prediction_to_the_bit(groups):
    for values, sequence, confidence, _ in groups:
        level = confidence / 100
        found = capped_quantile(values, sequence, level, 1.0)
        assert found == hierarchical(values, sequence, level)


def test_a_larger_cap_never_lowers_the_threshold(groups):
    changed = 0
    for values, sequence, confidence, _ in groups:
        level = confidence / 100
        found = [capped_quantile(values, sequence, level, cap / 100) for cap in (1, 25, 100)]
        assert found == sorted(found)
        changed += found[0] < found[-1]
    assert changed > 250


@pytest.mark.parametrize("cap", CAPS)
@pytest.mark.parametrize("confidence", CONFIDENCES)
def test_capped_is_finite_exactly_if_the_cap_is_at_most_alpha_times_g_plus_1(confidence, cap):
    for recordings in (*range(1, 12), 18, 19, 24, 48, 49, 98, 99):
        found = capped_quantile(
            np.arange(2.0 * recordings), np.arange(2 * recordings) // 2, confidence / 100, cap / 100
        )
        finite = cap <= (100 - confidence) * (recordings + 1)
        assert math.isfinite(found) is finite
        assert (recordings >= least_draws(confidence / 100, cap / 100)) is finite


@pytest.mark.parametrize("cap", [0.0, -0.5, 1.01, math.nan])
def test_a_cap_that_is_no_share_is_refused(cap):
    with pytest.raises(UsageError, match="cap: expected a number above 0 and at most 1, found"):
        capped_quantile([1.0], [0], 0.9, cap)


def test_recordings_weigh_the_same_whatever_their_length():
    # One long sequence of small scores must not dominate nine short ones of large scores.
    values = np.concatenate([np.zeros(1000), np.ones(9)])
    sequence = np.concatenate([np.zeros(1000), np.arange(1, 10)])
    assert capped_quantile(values, sequence, 0.8, 1.0) == 1.0
    assert conformal_quantile(values, 0.8) == 0.0


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.1, math.nan])
def test_confidence_outside_the_unit_interval_is_refused(confidence):
    with pytest.raises(UsageError, match="confidence"):
        conformal_quantile([1.0], confidence)


def test_nan_scores_are_refused():
    with pytest.raises(UsageError, match="1 NaN among 3"):
        conformal_quantile([1.0, math.nan, 2.0], 0.5)
    with pytest.raises(UsageError, match="NaN"):
        capped_quantile([math.nan], [0], 0.5, 1.0)


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
