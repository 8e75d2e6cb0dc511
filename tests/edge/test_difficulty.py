"""A difficulty scales the sets of every score, and its scores stay their exact inverse."""

import numpy as np
import pytest
from msgspec.structs import replace

from cvo_edge.bundle.format import DifficultySpec, Threshold
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.bundle.rules import check_rules
from cvo_edge.errors import CalibrationFileError
from cvo_edge.heads.checked import checked_head

FLOOR = [0.01] * 6
CQR = {"half_width_floor": FLOOR, "sides": "symmetric"}
SIDES = {"half_width_floor": FLOOR, "sides": "asymmetric"}
CLASSES = {"edges": [np.linspace(-4.0, 4.0, 13).tolist()] * 6, "penalty": 0.05, "free_ranks": 3}
REGION = {"points": 8, "half_width_floor": FLOOR}
SCORES = [
    *(("cqr", score, CQR) for score in ("additive", "normalised", "residual")),
    *(("cqr", score, SIDES) for score in ("additive", "normalised")),
    *(("csp", score, CLASSES) for score in ("lac", "aps", "raps")),
    *(("mcqr", score, REGION) for score in ("additive", "normalised")),
]
SPEC = DifficultySpec(weights=(0.5, -0.2, 0.3, 0.1), bias=0.4, lowest=-0.7, highest=2.0)
N = 200


def frames(seed):
    generator = np.random.default_rng(seed)
    point = generator.normal(0.0, 0.5, (N, 6))
    reach = generator.uniform(0.05, 0.8, (2, N, 6))
    scale = np.tril(generator.uniform(-0.2, 0.2, (N, 6, 6))) + 0.4 * np.eye(6)
    p = generator.random((N, 6, 12))
    outputs = {
        "lower": point - reach[0],
        "upper": point + reach[1],
        "probabilities": p / p.sum(axis=-1, keepdims=True),
        "codebook": point[:, np.newaxis] + generator.normal(0.0, 0.3, (N, 8, 6)),
        "scale": scale,
        "novelty": np.exp(generator.normal(0.0, 2.0, (N, 4))),
    }
    truth = point + generator.standard_t(3, (N, 6))
    return {name: each.astype(np.float32) for name, each in outputs.items()}, point, truth


@pytest.mark.parametrize("scope", ["marginal", "joint"])
@pytest.mark.parametrize(("method", "score", "parameters"), SCORES)
def test_a_truth_is_in_the_set_exactly_if_its_score_is_at_most_the_threshold(
    make_head, method, score, parameters, scope
):
    two = parameters is SIDES
    head = make_head(method, score, parameters, q_hat_upper=(None,) * 6 if two else None)
    head = head.scaled(SPEC)
    outputs, point, truth = frames(7)
    scores = head.scores(outputs, point, truth, scope)
    levels = np.quantile(scores, 0.8 if two else 0.6, axis=0)
    q_hat, q_upper = tuple(levels[0]), tuple(levels[1]) if two else None
    entry = Threshold(confidence=0.9, scope=scope, q_hat=q_hat, q_hat_upper=q_upper)
    expected = (scores <= levels).all(axis=1)
    found = np.empty((N, 6), bool)
    for row in range(N):
        one = {name: values[row : row + 1] for name, values in outputs.items()}
        given = head.conformal_set(one, point[row], entry)
        if given.ellipsoids is not None:
            found[row] = given.contains(truth[row])
            assert given.covers(truth[row]).all() or not found[row].all()
        else:
            found[row] = given.covers(truth[row])
    # Rounding decides scores that equal the threshold; the likeliest class is in every set.
    near = np.isclose(scores, levels, rtol=1e-6, atol=1e-9).any(axis=1)
    if method == "csp":
        near |= found
        assert not (expected & ~found).any()
    np.testing.assert_array_equal(found | near, expected | near)
    assert 0.3 < expected.mean() < 0.7


@pytest.mark.parametrize(("method", "score", "parameters"), [SCORES[0], SCORES[6], SCORES[9]])
def test_a_set_is_the_methods_own_stretched_by_the_factor(make_head, method, score, parameters):
    head = make_head(method, score, parameters)
    outputs, point, _ = frames(1)
    one = {name: values[:1] for name, values in outputs.items()}
    entry = Threshold(confidence=0.9, scope="marginal", q_hat=(0.5,) * 6, q_hat_upper=None)
    log_novelty = np.log(outputs["novelty"][0].astype(float))
    u = np.exp(np.clip(SPEC.bias + np.dot(SPEC.weights, log_novelty), SPEC.lowest, SPEC.highest))
    own = head.conformal_set(one, point[0], entry)
    found = head.scaled(SPEC).conformal_set(one, point[0], entry)
    np.testing.assert_allclose(found.width(), u * own.width())
    np.testing.assert_allclose(found.lower, point[0] + u * (own.lower - point[0]))
    again = head.scaled(SPEC).scaled(None).conformal_set(one, point[0], entry)
    np.testing.assert_array_equal(again.lower, own.lower)


def test_factors_stay_within_their_range_and_unbounded_sides_unbounded(make_head):
    head = make_head("cqr", "residual", CQR).scaled(SPEC)
    strange = {"novelty": np.full((1, 4), 1e6, np.float32)}
    seen = {"novelty": np.zeros((1, 4), np.float32)}
    q_hat = (1.0, None, 1.0, 1.0, 1.0, 1.0)
    entry = Threshold(confidence=0.9, scope="marginal", q_hat=q_hat, q_hat_upper=None)
    for outputs, log_u in ((strange, SPEC.highest), (seen, SPEC.lowest)):
        width = head.conformal_set(outputs, np.zeros(6), entry).width()
        np.testing.assert_allclose(width[[0, 2]], 2.0 * np.exp(log_u))
        assert width[1] == np.inf


def test_labels_need_the_novelty_of_their_frames(make_head):
    head = make_head("cqr", "residual", CQR)
    assert set(head.scored_outputs()) == {"pose"}
    assert set(head.scaled(SPEC).scored_outputs()) == {"pose", "novelty"}


def test_a_bundle_without_the_statistics_or_with_a_solver_has_no_difficulty(bundle, artifacts_dir):
    bare = bundle.calibration
    plain = replace(bare.model, outputs=bare.model.outputs[:3])
    kept = {spec.name: bare.selftest.outputs[spec.name] for spec in plain.outputs}
    test = replace(bare.selftest, outputs=kept)
    given = replace(bare, model=plain, selftest=test, alarm=None, difficulty=SPEC)
    with pytest.raises(
        CalibrationFileError,
        match="difficulty: expected null for a model without outputs novelty and degradation",
    ):
        check_rules(given)
    assert checked_head(replace(given, difficulty=None)).difficulty is None
    solved = read_calibration(artifacts_dir / "synthetic-room-scr")
    with pytest.raises(CalibrationFileError, match="difficulty: expected null for method scr"):
        checked_head(replace(solved, difficulty=SPEC))
