"""Coverage by simulation: the mean over many calibrations against k/(n+1)."""

import numpy as np
import pytest

from cvo_edge.conformal import (
    LinearScale,
    conformal_quantile,
    conformal_rank,
    hierarchical_quantile,
)

REPEATS = 1000


@pytest.mark.parametrize("n", [19, 20, 100])
@pytest.mark.parametrize("confidence", [0.5, 0.8, 0.9, 0.95])
def test_marginal_coverage_is_rank_over_n_plus_one(n, confidence):
    generator = np.random.default_rng(n)
    covered = []
    for _ in range(REPEATS):
        q_hat = conformal_quantile(generator.random(n), confidence)
        covered.append(min(q_hat, 1.0))  # the exact coverage for uniform scores
    expected = min(1.0, conformal_rank(n, confidence) / (n + 1))
    error = np.std(covered) / np.sqrt(REPEATS) + 1e-12
    assert abs(np.mean(covered) - expected) < 4.5 * error


@pytest.mark.parametrize("n", [19, 100])
def test_joint_coverage_of_correlated_scores_is_rank_over_n_plus_one(n):
    confidence = 0.9
    generator = np.random.default_rng(n)
    mixing = 0.3 * np.eye(6) + 0.7
    hits, trials = 0, 40
    scale = LinearScale(np.array([[0.5, 1.0, 2.0, 1.0, 1.0, 3.0]]))
    for _ in range(REPEATS):
        scores = np.abs(generator.standard_normal((n + trials, 1, 6)) @ mixing)
        largest = scale.comparable(scores[:n]).max(axis=(1, 2))
        thresholds = scale.thresholds(conformal_quantile(largest, confidence))
        hits += int((scores[n:] <= thresholds).all(axis=(1, 2)).sum())
    k = conformal_rank(n, confidence)
    # Beta(k, n + 1 - k) between calibrations, binomial within one.
    mean = k / (n + 1)
    beta_variance = mean * (1 - mean) / (n + 2)
    error = np.sqrt((beta_variance + mean * (1 - mean) / trials) / REPEATS)
    assert abs(hits / (REPEATS * trials) - mean) < 4.5 * error


def test_hierarchical_rule_covers_new_sequences_where_pooling_does_not():
    # Eleven sequences, each with a difficulty of its own; a new one is drawn each time.
    generator = np.random.default_rng(5)
    pooled, hierarchical = [], []
    for _ in range(REPEATS):
        difficulty = np.exp(generator.standard_normal(12))
        scores = np.abs(generator.standard_normal((12, 30))) * difficulty[:, None]
        cal, group = scores[:11].ravel(), np.repeat(np.arange(11), 30)
        pooled.append(np.mean(scores[11] <= conformal_quantile(cal, 0.9)))
        hierarchical.append(np.mean(scores[11] <= hierarchical_quantile(cal, group, 0.9)))
    error = np.std(hierarchical) / np.sqrt(REPEATS)
    assert np.mean(hierarchical) > 0.9 - 4.5 * error
    assert np.mean(pooled) < 0.89
