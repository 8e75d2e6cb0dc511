"""Simulated coverage: the mean over many calibrations against k/(n+1)."""

import numpy as np
import pytest

from cvo_edge.bundle.format import DifficultySpec
from cvo_edge.conformal import (
    LinearScale,
    capped_quantile,
    conformal_quantile,
    conformal_rank,
)
from cvo_export.bundles.observed import Scored
from cvo_export.bundles.thresholds import Quantiles

REPEATS = 1000


@pytest.mark.parametrize("n", [19, 20, 100])
@pytest.mark.parametrize("confidence", [0.5, 0.8, 0.9, 0.95])
def test_marginal_coverage_is_rank_over_n_plus_one(n, confidence):
    generator = np.random.default_rng(n)
    covered = []
    for _ in range(REPEATS):
        q_hat = conformal_quantile(generator.random(n), confidence)
        covered.append(min(q_hat, 1.0))  # exact coverage for uniform scores
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
    # Coverage is Beta(k, n + 1 - k) between calibrations and binomial within one calibration.
    mean = k / (n + 1)
    beta_variance = mean * (1 - mean) / (n + 2)
    error = np.sqrt((beta_variance + mean * (1 - mean) / trials) / REPEATS)
    assert abs(hits / (REPEATS * trials) - mean) < 4.5 * error


def test_hierarchical_rule_covers_new_sequences_where_pooling_does_not():
    # Eleven calibration sequences of different difficulty, and a new sequence for the test.
    generator = np.random.default_rng(5)
    pooled, hierarchical = [], []
    for _ in range(REPEATS):
        difficulty = np.exp(generator.standard_normal(12))
        scores = np.abs(generator.standard_normal((12, 30))) * difficulty[:, None]
        cal, group = scores[:11].ravel(), np.repeat(np.arange(11), 30)
        pooled.append(np.mean(scores[11] <= conformal_quantile(cal, 0.9)))
        hierarchical.append(np.mean(scores[11] <= capped_quantile(cal, group, 0.9, 1.0)))
    error = np.std(hierarchical) / np.sqrt(REPEATS)
    assert np.mean(hierarchical) > 0.9 - 4.5 * error
    assert np.mean(pooled) < 0.89


def test_capped_rule_bounds_the_capped_misses_and_the_plain_ones():
    """One recording in seven is ten times as bad."""
    generator = np.random.default_rng(7)
    recordings, frames_each = 11, 20
    worse = np.where(generator.random((REPEATS, recordings + 1, 1)) < 1 / 7, 10.0, 1.0)
    scores = np.abs(generator.standard_normal((REPEATS, recordings + 1, frames_each))) * worse
    group = np.repeat(np.arange(recordings), frames_each)
    for cap in (0.25, 0.5, 1.0):
        q_hat = [capped_quantile(cal.ravel(), group, 0.9, cap) for cal in scores[:, :-1]]
        missed = (scores[:, -1] > np.array(q_hat)[:, None]).mean(axis=1)
        error = missed.std() / np.sqrt(REPEATS)
        assert np.minimum(missed, cap).mean() < 0.1 + 3 * error
        assert missed.mean() < 0.1 + (1 - cap) / (recordings + 1) + 3 * error


# -- through the heads: calibrated and evaluated like bundles -------------------------------------

TRIALS = 20
# Trials per repeat that are evaluated as sets, because building a set is slower than a score.
JUDGED = 4
CONFIDENCE = 0.9
FLOOR = [0.01] * 6
CQR = {"half_width_floor": FLOOR, "sides": "symmetric"}
CLASSES = {"edges": [np.linspace(-4.0, 4.0, 13).tolist()] * 6, "penalty": 0.05, "free_ranks": 3}
REGION = {"points": 8, "half_width_floor": FLOOR}
METHODS = [
    ("cqr", "additive", CQR),
    ("cqr", "normalised", CQR),
    ("cqr", "residual", CQR),
    ("csp", "lac", CLASSES),
    ("csp", "aps", CLASSES),
    ("csp", "raps", CLASSES),
    ("mcqr", "additive", REGION),
    ("mcqr", "normalised", REGION),
]


SCATTER = np.random.default_rng(0).standard_normal((8, 6))


def frames(count, seed):
    """Outputs, points and truths (count, 6) of a model with roughly correct uncertainty."""
    generator = np.random.default_rng(seed)
    point = generator.standard_normal((count, 6))
    spread = 0.1 + 0.5 * generator.random((count, 6))
    truth = point + spread * generator.standard_t(5, (count, 6))
    edges = np.array(CLASSES["edges"][0])
    middle = 0.5 * (edges[1:] + edges[:-1])
    logits = -0.5 * ((middle - point[..., None]) / (1.3 * spread[..., None])) ** 2
    # Noise makes class ranks differ from distances and all scores distinct.
    p = np.exp(logits + 0.7 * generator.standard_normal(logits.shape))
    scale = np.zeros((count, 6, 6), np.float32)
    scale[:, range(6), range(6)] = spread * generator.uniform(0.5, 1.5, (count, 6))
    scale[:, 3, 0] = 0.2 * spread[:, 0]
    outputs = {
        "codebook": (point[:, None] + spread[:, None] * SCATTER).astype(np.float32),
        "scale": scale,
        "lower": (point - 1.2 * spread).astype(np.float32),
        "upper": (point + 1.2 * spread).astype(np.float32),
        "probabilities": (p / p.sum(axis=-1, keepdims=True)).astype(np.float32),
    }
    return outputs, point, truth


def standard_error(mean, n, columns=6, trials=TRIALS):
    """Standard error of the mean coverage: Beta between calibrations, binomial within one."""
    variance = mean * (1 - mean) * (1 / (n + 2) + 1 / trials)
    return np.sqrt(variance / (REPEATS * columns))


@pytest.mark.parametrize("n", [19, 20, 100])
@pytest.mark.parametrize(("method", "score", "parameters"), METHODS)
def test_scores_are_at_most_the_threshold_in_rank_over_n_plus_one(
    make_head, method, score, parameters, n
):
    head = make_head(method, score, parameters)
    outputs, point, truth = frames(REPEATS * (n + TRIALS), n)
    scores = head.scores(outputs, point, truth).reshape(REPEATS, n + TRIALS, 6)
    covered = [
        (repeat[n:] <= np.array([conformal_quantile(s, CONFIDENCE) for s in repeat[:n].T])).mean()
        for repeat in scores
    ]
    expected = conformal_rank(n, CONFIDENCE) / (n + 1)
    # The check is two-sided: over-coverage fails too.
    assert abs(np.mean(covered) - expected) < 4.5 * standard_error(expected, n)


def scored(head, outputs, point, truth):
    scores = (head.scores(outputs, point, truth, scope) for scope in ("marginal", "joint"))
    return Scored(*scores, np.zeros(len(truth), np.int64))


def coverages(head, n, joint="max"):
    """Return the mean coverage of marginal sets and their hulls, per DoF, and of joint sets."""
    outputs, point, truth = frames(REPEATS * (n + TRIALS) + 200, n)
    every = scored(head, outputs, point, truth)
    val = Scored(*(values[-200:] for values in every))
    marginal, hulls, jointly = [], [], []
    for repeat in range(REPEATS):
        start = repeat * (n + TRIALS)
        cal = Scored(*(values[start : start + n] for values in every))
        entries = Quantiles(head, cal, val, "pooled", joint).entries()
        by_scope = {e.scope: e for e in entries if e.confidence == CONFIDENCE}
        for row in range(start + n, start + n + JUDGED):
            one = {name: values[row : row + 1] for name, values in outputs.items()}
            inner, outer = (head.conformal_set(one, point[row], by_scope[s]) for s in by_scope)
            y = truth[row]
            marginal.append(inner.covers(y).mean())
            hulls.append(((inner.lower <= y) & (y <= inner.upper)).mean())
            jointly.append(outer.contains(y))
    return np.mean(marginal), np.mean(hulls), np.mean(jointly)


@pytest.mark.parametrize("n", [19, 20, 100])
@pytest.mark.parametrize(("method", "score", "parameters"), METHODS)
def test_sets_and_their_hulls_cover_at_least_that_and_joint_sets_all_six(
    make_head, method, score, parameters, n
):
    head = make_head(method, score, parameters)
    marginal, hull, jointly = coverages(head, n)
    least = conformal_rank(n, CONFIDENCE) / (n + 1)
    assert marginal > least - 4.5 * standard_error(least, n, trials=JUDGED)
    assert hull >= marginal
    assert jointly > least - 4.5 * standard_error(least, n, columns=1, trials=JUDGED)


@pytest.mark.parametrize("n", [19, 20, 100])
def test_a_region_covers_neither_less_nor_more_than_its_rank_says(make_head, n):
    _, _, jointly = coverages(make_head("mcqr", "normalised", REGION), n)
    expected = conformal_rank(n, CONFIDENCE) / (n + 1)
    assert abs(jointly - expected) < 4.5 * standard_error(expected, n, columns=1, trials=JUDGED)


@pytest.mark.parametrize("n", [20, 100])
@pytest.mark.parametrize(("method", "score", "parameters"), [METHODS[1], METHODS[4]])
def test_bonferroni_holds_jointly_or_says_that_it_cannot(make_head, method, score, parameters, n):
    head = make_head(method, score, parameters)
    _, _, jointly = coverages(head, n, "bonferroni")
    assert jointly > CONFIDENCE - 4.5 * standard_error(CONFIDENCE, n, columns=1, trials=JUDGED)
    # A finite threshold at a sixth of the miscoverage needs 59 frames.
    assert bool(jointly == 1.0) is (n < 59)


@pytest.mark.parametrize("n", [19, 20, 100])
@pytest.mark.parametrize("score", ["additive", "normalised"])
def test_two_thresholds_at_half_the_miscoverage_cover_what_their_ranks_say(make_head, score, n):
    parameters = {"half_width_floor": FLOOR, "sides": "asymmetric"}
    head = make_head("cqr", score, parameters, q_hat_upper=(None,) * 6)
    outputs, point, truth = frames(REPEATS * (n + TRIALS), n)
    scores = head.scores(outputs, point, truth).reshape(REPEATS, n + TRIALS, 2, 6)
    levels = head.side_confidences(CONFIDENCE)
    covered = []
    for repeat in scores:
        q_hat = np.array(
            [
                [conformal_quantile(repeat[:n, side, dof], levels[side]) for dof in range(6)]
                for side in range(2)
            ]
        )
        covered.append((repeat[n:] <= q_hat).all(axis=1).mean())
    expected = 2 * conformal_rank(n, 1 - (1 - CONFIDENCE) / 2) / (n + 1) - 1
    assert abs(np.mean(covered) - expected) < 4.5 * standard_error(expected, n)


def test_a_difficulty_keeps_the_coverage_of_frames_like_those_of_the_calibration(make_head):
    n = 100
    head = make_head("cqr", "normalised", CQR).scaled(
        DifficultySpec(weights=(0.5, 0.3, 0.0, -0.4), bias=0.1, lowest=-0.7, highest=1.5)
    )
    outputs, point, truth = frames(REPEATS * (n + TRIALS), n)
    generator = np.random.default_rng(n)
    outputs["novelty"] = np.exp(generator.standard_normal((len(truth), 4)))
    scores = head.scores(outputs, point, truth).reshape(REPEATS, n + TRIALS, 6)
    covered = [
        (repeat[n:] <= np.array([conformal_quantile(s, CONFIDENCE) for s in repeat[:n].T])).mean()
        for repeat in scores
    ]
    expected = conformal_rank(n, CONFIDENCE) / (n + 1)
    assert abs(np.mean(covered) - expected) < 4.5 * standard_error(expected, n)


@pytest.mark.parametrize("sides", ["lower", "upper"])
def test_one_bound_covers_at_the_whole_level(make_head, sides):
    n = 100
    parameters = {"half_width_floor": FLOOR, "sides": sides}
    head = make_head("cqr", "additive", parameters, q_hat_upper=(None,) * 6)
    marginal, _, jointly = coverages(head, n)
    expected = conformal_rank(n, CONFIDENCE) / (n + 1)
    assert abs(marginal - expected) < 4.5 * standard_error(expected, n, trials=JUDGED)
    assert abs(jointly - expected) < 4.5 * standard_error(expected, n, columns=1, trials=JUDGED)
