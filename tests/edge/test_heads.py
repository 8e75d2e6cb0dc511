"""Every head's set is {y : score(y) <= q_hat}, plus the properties of its method."""

from typing import get_args

import numpy as np
import pytest

from cvo_edge.bundle.format import Threshold
from cvo_edge.errors import CalibrationFileError
from cvo_edge.heads.cqr import IntervalScore
from cvo_edge.heads.csp import Score, class_scores
from cvo_edge.sets import scaled_distance

FLOOR = [0.01] * 6
GRID = np.linspace(-3.0, 3.0, 241)


def threshold(q_hat, q_hat_upper=None, scope="marginal"):
    upper = None if q_hat_upper is None else tuple(q_hat_upper)
    return Threshold(confidence=0.9, scope=scope, q_hat=tuple(q_hat), q_hat_upper=upper)


# -- intervals ----------------------------------------------------------------------------------


def bounds(seed):
    generator = np.random.default_rng(seed)
    point = generator.normal(0.0, 0.5, (1, 6))
    lower = point - generator.uniform(0.05, 0.8, (1, 6))
    upper = point + generator.uniform(0.05, 0.8, (1, 6))
    return {"lower": lower.astype(np.float32), "upper": upper.astype(np.float32)}, point


@pytest.mark.parametrize("score", ["additive", "normalised", "residual"])
@pytest.mark.parametrize("q_hat", [0.0, 0.3, 1.7, None])
def test_an_interval_is_exactly_where_the_symmetric_score_is_at_most_q(make_head, score, q_hat):
    head = make_head("cqr", score, {"half_width_floor": FLOOR, "sides": "symmetric"})
    outputs, point = bounds(3)
    if score == "residual":
        outputs = {}
    region = head.conformal_set(outputs, point[0], threshold([q_hat] * 6))
    limit = np.inf if q_hat is None else q_hat
    for y in GRID:
        scores = head.scores(outputs, point, np.full((1, 6), y))
        assert scores.shape == (1, 1, 6)
        near = np.isclose(scores[0, 0], limit, atol=1e-9)
        inside = region.covers(np.full(6, y))
        np.testing.assert_array_equal(inside | near, (scores[0, 0] <= limit) | near)


@pytest.mark.parametrize("score", ["additive", "normalised"])
def test_two_sides_have_a_threshold_each(make_head, score):
    parameters = {"half_width_floor": FLOOR, "sides": "asymmetric"}
    head = make_head("cqr", score, parameters, q_hat_upper=(None,) * 6)
    outputs, point = bounds(5)
    region = head.conformal_set(outputs, point[0], threshold([0.2] * 6, [0.9] * 6))
    for y in GRID:
        below, above = head.scores(outputs, point, np.full((1, 6), y))[0]
        near = np.isclose(below, 0.2, atol=1e-9) | np.isclose(above, 0.9, atol=1e-9)
        expected = (below <= 0.2) & (above <= 0.9)
        np.testing.assert_array_equal(region.covers(np.full(6, y)) | near, expected | near)


@pytest.mark.parametrize(
    ("sides", "confidences"),
    [
        ("symmetric", (0.9,)),
        ("asymmetric", (0.95, 0.95)),
        ("lower", (0.9, None)),
        ("upper", (None, 0.9)),
    ],
)
def test_miscoverage_is_shared_by_the_sides_that_are_bounded(make_head, sides, confidences):
    upper = None if sides == "symmetric" else (None,) * 6
    parameters = {"half_width_floor": FLOOR, "sides": sides}
    head = make_head("cqr", "additive", parameters, q_hat_upper=upper)
    assert head.side_confidences(0.9) == pytest.approx(confidences)


def test_a_lower_bound_alone_leaves_the_upper_side_open(make_head):
    parameters = {"half_width_floor": FLOOR, "sides": "lower"}
    head = make_head("cqr", "additive", parameters, q_hat_upper=(None,) * 6)
    outputs, point = bounds(1)
    region = head.conformal_set(outputs, point[0], threshold([0.1] * 6, [None] * 6))
    np.testing.assert_allclose(region.lower, outputs["lower"][0] - 0.1)
    assert (region.upper == np.inf).all()


def test_a_set_emptied_by_a_negative_threshold_is_its_middle():
    lower, upper, point = np.full(6, -0.1), np.full(6, 0.3), np.zeros(6)
    region = IntervalScore(None).inverse(lower, upper, point, np.full(6, -0.5), np.full(6, -0.5))
    assert region.crossed
    np.testing.assert_allclose(region.lower, 0.1)
    np.testing.assert_allclose(region.upper, 0.1)


@pytest.mark.parametrize(
    ("method", "score", "parameters", "upper", "match"),
    [
        ("cqr", "aps", {"half_width_floor": FLOOR, "sides": "symmetric"}, None, "score"),
        ("cjp", "residual", None, None, "score"),
        ("cqr", "additive", {"half_width_floor": FLOOR, "sides": "both"}, None, "sides"),
        ("cqr", "additive", {"half_width_floor": FLOOR, "sides": "lower"}, None, "six values"),
        ("cqr", "additive", {"half_width_floor": FLOOR, "sides": "symmetric"}, (0.1,) * 6, "null"),
        ("cqr", "additive", {"half_width_floor": FLOOR}, None, "sides"),
        ("cqr", "additive", {"half_width_floor": FLOOR, "sides": "lower"}, (0.1,) * 6, "null with"),
    ],
)
def test_parameters_that_do_not_fit_are_refused(
    make_head, bundle, method, score, parameters, upper, match
):
    parameters = parameters or bundle.calibration.method_parameters
    with pytest.raises(CalibrationFileError, match=match):
        make_head(method, score, parameters, q_hat_upper=upper)


@pytest.mark.parametrize("score", ["normalised", "residual"])
def test_a_negative_factor_is_refused_where_the_score_cannot_be_negative(make_head, score):
    parameters = {"half_width_floor": FLOOR, "sides": "symmetric"}
    with pytest.raises(CalibrationFileError, match="factors of at least 0"):
        make_head("cqr", score, parameters, q_hat=(-0.1,) * 6)


# -- classes ------------------------------------------------------------------------------------

EDGES = [
    [-2.0, -1.0, 0.0, 0.5, 1.0, 2.0],
    [-2.0, 0.0, 2.0],  # two classes only: three probabilities are unused
    [-1.5, -0.5, 0.0, 0.25, 1.0, 1.5],
    [-2.0, -1.0, 0.0, 1.0, 2.0],
    [-0.5, -0.25, 0.0, 0.25, 0.5, 0.75],
    [-3.0, -1.0, -0.5, 0.0, 1.0, 3.0],
]


def parameters(penalty=0.0, free_ranks=0):
    return {"edges": EDGES, "penalty": penalty, "free_ranks": free_ranks}


def probabilities(seed):
    generator = np.random.default_rng(seed)
    p = np.zeros((1, 6, 5), np.float32)
    for dof, edges in enumerate(EDGES):
        count = len(edges) - 1
        p[0, dof, :count] = generator.dirichlet(np.full(count, 0.4))
    return {"probabilities": p}


@pytest.mark.parametrize("score", get_args(Score))
@pytest.mark.parametrize("q_hat", [0.0, 0.3, 0.6, 0.9, 1.1])
@pytest.mark.parametrize("seed", range(5))
def test_a_set_of_classes_is_where_the_score_is_at_most_q_and_the_likeliest_class(
    make_head, seed, score, q_hat
):
    head = make_head("csp", str(score), parameters(0.05, 2))
    outputs = probabilities(seed)
    region = head.conformal_set(outputs, np.zeros(6), threshold([q_hat] * 6))
    likeliest = outputs["probabilities"][0].argmax(axis=1)
    for dof, edges in enumerate(EDGES):
        for number in range(len(edges) - 1):
            y = np.full(6, 0.5 * (edges[number] + edges[number + 1]))
            score_of_y = head.scores(outputs, np.zeros((1, 6)), y[None])[0, 0, dof]
            expected = score_of_y <= q_hat or number == likeliest[dof]
            assert region.covers(y)[dof] == expected


def test_adjacent_classes_merge_and_others_stay_apart(make_head):
    head = make_head("csp", "lac", parameters())
    p = np.zeros((1, 6, 5), np.float32)
    p[0, 0] = [0.4, 0.0, 0.0, 0.3, 0.3]
    p[0, 1, :2] = [0.5, 0.5]
    p[0, 2:] = [0.2, 0.2, 0.2, 0.2, 0.2]
    region = head.conformal_set({"probabilities": p}, np.zeros(6), threshold([0.75] * 6))
    assert region.bands[0] == ((-2.0, -1.0), (0.5, 2.0))
    assert region.bands[1] == ((-2.0, 2.0),)
    assert region.lower[0] == -2.0
    assert region.upper[0] == 2.0
    np.testing.assert_array_equal(region.covers([-1.5, 0, 0, 0, 0, 0])[0], True)
    np.testing.assert_array_equal(region.covers([-0.5, 0, 0, 0, 0, 0])[0], False)
    assert region.width()[0] == pytest.approx(2.5)
    assert region.distance([0.25, 0, 0, 0, 0, 0])[0] == pytest.approx(0.25)
    assert head.classes_in(region).tolist() == [3, 2, 1, 1, 1, 1]


def test_no_set_is_empty_and_none_leaves_the_workspace(make_head):
    head = make_head("csp", "aps", parameters())
    for seed in range(50):
        outputs = probabilities(seed)
        smallest = head.conformal_set(outputs, np.zeros(6), threshold([0.0] * 6))
        assert (smallest.width() > 0).all()
        largest = head.conformal_set(outputs, np.zeros(6), threshold([2.0] * 6))
        assert largest.lower.tolist() == [row[0] for row in EDGES]
        assert largest.upper.tolist() == [row[-1] for row in EDGES]


def test_an_unbounded_threshold_is_everything_and_the_others_stay(make_head):
    head = make_head("csp", "aps", parameters())
    region = head.conformal_set(probabilities(0), np.zeros(6), threshold([None, *[0.5] * 5]))
    assert region.bands[0] == ((-np.inf, np.inf),)
    assert region.covers([1e9, 0, 0, 0, 0, 0])[0]
    assert np.isfinite(region.lower[1:]).all()
    limited = region.within(np.full(6, -5.0), np.full(6, 5.0))
    assert limited.width()[0] == 10.0
    assert limited.bands[1:] == region.bands[1:]


def test_a_truth_outside_the_workspace_has_an_infinite_score(make_head):
    head = make_head("csp", "aps", parameters())
    outputs = probabilities(0)
    inside = head.scores(outputs, np.zeros((1, 6)), np.zeros((1, 6)))
    outside = head.scores(outputs, np.zeros((1, 6)), np.full((1, 6), 9.0))
    assert np.isfinite(inside).all()
    assert np.isinf(outside).all()


def test_scores_of_stacked_frames_are_those_of_each_to_the_last_bit(make_head):
    head = make_head("csp", "raps", parameters(0.01, 1))
    p = np.concatenate([probabilities(seed)["probabilities"] for seed in range(20)])
    y = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 6))
    stacked = head.scores({"probabilities": p}, y, y)
    for row in range(20):
        one = {"probabilities": p[row : row + 1]}
        np.testing.assert_array_equal(head.scores(one, y[:1], y[row : row + 1])[0], stacked[row])


def test_aps_of_the_last_ranked_class_is_the_whole_mass():
    p = np.random.default_rng(0).dirichlet(np.ones(9), size=(4, 6))
    assert class_scores(p, "aps").max(axis=-1) == pytest.approx(np.ones((4, 6)))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"edges": [[0.0, 0.0, 1.0], *EDGES[1:]]}, "ascending"),
        ({"edges": [[1.0, 0.5, 2.0], *EDGES[1:]]}, "ascending"),
        ({"edges": [[0.0, 1.0], *EDGES[1:]]}, "edges"),
        ({"edges": EDGES[:5]}, "edges"),
        ({"penalty": -1.0}, "penalty"),
        ({"free_ranks": -1}, "free_ranks"),
        ({"more": 1}, "more"),
    ],
)
def test_class_parameters_that_do_not_fit_are_refused(make_head, change, match):
    with pytest.raises(CalibrationFileError, match=match):
        make_head("csp", "aps", {**parameters(), **change})


def test_an_unused_class_is_never_the_likeliest(make_head):
    head = make_head("csp", "aps", parameters())
    outputs = probabilities(0)
    outputs["probabilities"][0, 1] = [0.1, 0.2, 0.7, 0.0, 0.0]  # a DoF with two classes
    region = head.conformal_set(outputs, np.zeros(6), threshold([0.0] * 6))
    assert region.bands[1] == ((0.0, 2.0),)


def test_a_score_or_a_side_of_another_method_is_refused(make_head):
    with pytest.raises(CalibrationFileError, match="lac, aps, raps"):
        make_head("csp", "additive", parameters())
    with pytest.raises(CalibrationFileError, match="q_hat_upper"):
        make_head("csp", "aps", parameters(), q_hat_upper=(0.5,) * 6)


# -- regions ------------------------------------------------------------------------------------

POINTS = {"points": 20, "half_width_floor": FLOOR}


def codebooks(seed, count=1):
    """Outputs of ``count`` frames: 20 points, and a scale with correlations."""
    generator = np.random.default_rng(seed)
    scale = np.tril(generator.normal(0.0, 0.1, (count, 6, 6)))
    scale[:, range(6), range(6)] = generator.uniform(0.1, 0.3, (count, 6))
    codebook = generator.normal(0.0, 0.5, (count, 20, 6))
    return {"codebook": codebook.astype(np.float32), "scale": scale.astype(np.float32)}


def near(outputs, seed, count=400):
    """Points around the codebook of one frame, inside and outside its region."""
    generator = np.random.default_rng(seed)
    centres = outputs["codebook"][0, generator.integers(20, size=count)]
    steps = generator.standard_normal((count, 6)) * generator.uniform(0.0, 1.2, (count, 1))
    return centres + steps @ outputs["scale"][0].T


def test_the_distance_is_that_of_an_independent_solver():
    outputs = codebooks(0, 5)
    y = np.random.default_rng(1).normal(0.0, 1.0, (5, 6))
    found = scaled_distance(outputs["codebook"], outputs["scale"], y)
    for row in range(5):
        scale = outputs["scale"][row].astype(np.float64)
        difference = y[row] - outputs["codebook"][row].astype(np.float64)
        expected = np.linalg.norm(np.linalg.solve(scale, difference.T), axis=0).min()
        assert found[row] == pytest.approx(expected)


def test_what_has_no_extent_holds_nothing(make_head):
    outputs = codebooks(0)
    outputs["scale"][0, 2, 2] = 0.0
    head = make_head("mcqr", "additive", POINTS)
    region = head.conformal_set(outputs, np.zeros(6), threshold([1e9] * 6, scope="joint"))
    assert not region.contains(outputs["codebook"][0, 0])
    scores = head.scores(outputs, np.zeros((1, 6)), outputs["codebook"][:, 0], "joint")
    assert np.isinf(scores).all()


@pytest.mark.parametrize("radius", [0.0, 1.0, 2.5, None])
def test_the_joint_region_is_exactly_where_the_distance_is_at_most_r(make_head, radius):
    head = make_head("mcqr", "normalised", POINTS)
    outputs = codebooks(2)
    region = head.conformal_set(outputs, np.zeros(6), threshold([radius] * 6, scope="joint"))
    limit = np.inf if radius is None else radius
    inside = 0
    for y in near(outputs, 3):
        scores = head.scores(outputs, np.zeros((1, 6)), y[None], "joint")
        assert scores.shape == (1, 1, 6)
        assert (scores == scores[0, 0, 0]).all()
        assert region.contains(y) == (scores[0, 0, 0] <= limit)
        # The hull contains the region.
        assert region.covers(y).all() or not region.contains(y)
        inside += region.contains(y)
    assert (inside == 0) is (radius == 0.0)


def test_the_hull_touches_the_region_on_all_twelve_sides(make_head):
    head = make_head("mcqr", "normalised", POINTS)
    outputs = codebooks(4)
    region = head.conformal_set(outputs, np.zeros(6), threshold([1.5] * 6, scope="joint"))
    codebook, scale = outputs["codebook"][0].astype(float), outputs["scale"][0].astype(float)
    for dof in range(6):
        # The ellipsoid's furthest point along this axis, relative to its centre.
        furthest = 1.5 * scale @ scale[dof] / np.linalg.norm(scale[dof])
        top = codebook[codebook[:, dof].argmax()] + furthest
        bottom = codebook[codebook[:, dof].argmin()] - furthest
        assert top[dof] == pytest.approx(region.upper[dof])
        assert bottom[dof] == pytest.approx(region.lower[dof])
        assert region.ellipsoids.distance(top) == pytest.approx(1.5, abs=1e-6)


def test_the_hull_holds_the_furthest_points_to_the_last_bit(make_head):
    head = make_head("mcqr", "normalised", POINTS)
    for seed in range(40):
        outputs = codebooks(seed)
        codebook, scale = outputs["codebook"][0].astype(float), outputs["scale"][0].astype(float)
        for dof in range(6):
            furthest = codebook[codebook[:, dof].argmax()] + scale @ scale[dof] / np.linalg.norm(
                scale[dof]
            )
            radius = float(scaled_distance(outputs["codebook"][0], scale, furthest))
            region = head.conformal_set(
                outputs, np.zeros(6), threshold([radius] * 6, scope="joint")
            )
            assert region.contains(furthest)
            assert region.covers(furthest).all()


def test_no_radius_is_everything_even_without_extent(make_head):
    outputs = codebooks(0)
    outputs["scale"][0, 2] = 0.0
    head = make_head("mcqr", "normalised", POINTS)
    region = head.conformal_set(outputs, np.zeros(6), threshold([None] * 6, scope="joint"))
    assert region.contains(np.full(6, 1e9))
    assert region.covers(np.full(6, -1e9)).all()
    assert (region.lower == -np.inf).all()


def test_what_is_above_the_diagonal_counts_nowhere(make_head):
    head = make_head("mcqr", "normalised", POINTS)
    plain, outputs = codebooks(8), codebooks(8)
    outputs["scale"][0, 0, 5] = 0.3
    y = near(plain, 9, 50)
    for scope in ("marginal", "joint"):
        one, other = (
            head.conformal_set(given, np.zeros(6), threshold([1.0] * 6, scope=scope))
            for given in (plain, outputs)
        )
        np.testing.assert_array_equal(one.upper, other.upper)
        for truth in y:
            assert one.contains(truth) == other.contains(truth)
            scores = [head.scores(g, y[:1], truth[None], scope) for g in (plain, outputs)]
            np.testing.assert_array_equal(*scores)


@pytest.mark.parametrize("score", ["additive", "normalised"])
@pytest.mark.parametrize("q_hat", [0.0, 0.3, 1.7])
def test_six_intervals_on_the_raw_hull_are_where_the_marginal_score_is_at_most_q(
    make_head, score, q_hat
):
    head = make_head("mcqr", score, POINTS)
    outputs = codebooks(5)
    region = head.conformal_set(outputs, np.zeros(6), threshold([q_hat] * 6))
    assert region.ellipsoids is None
    for y in GRID:
        scores = head.scores(outputs, np.zeros((1, 6)), np.full((1, 6), y))[0, 0]
        close = np.isclose(scores, q_hat, atol=1e-9)
        inside = region.covers(np.full(6, y))
        np.testing.assert_array_equal(inside | close, (scores <= q_hat) | close)


def test_region_scores_of_stacked_frames_are_those_of_each_to_the_last_bit(make_head):
    head = make_head("mcqr", "normalised", POINTS)
    outputs = codebooks(6, 20)
    y = np.random.default_rng(7).normal(0.0, 1.0, (20, 6))
    for scope in ("marginal", "joint"):
        stacked = head.scores(outputs, y, y, scope)
        for row in range(20):
            one = {name: values[row : row + 1] for name, values in outputs.items()}
            found = head.scores(one, y[:1], y[row : row + 1], scope)
            np.testing.assert_array_equal(found[0], stacked[row])


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"score": "residual"}, "normalised, additive"),
        ({"parameters": {**POINTS, "points": 0}}, "points"),
        ({"parameters": {**POINTS, "half_width_floor": [0.0] * 6}}, "half_width_floor"),
        ({"parameters": {"points": 20}}, "half_width_floor"),
        ({"q_hat_upper": (0.5,) * 6}, "q_hat_upper"),
        ({"q_hat": (1.0,) * 5 + (1.1,), "scope": "joint"}, "six times"),
        ({"q_hat": (1.0,) * 5 + (None,), "scope": "joint"}, "six times"),
        ({"q_hat": (-1.0,) * 6, "scope": "joint"}, "at least 0"),
        ({"q_hat": (1.0,) * 5 + (-0.5,)}, "factors of at least 0"),
        ({"joint": "bonferroni"}, "one score for all six"),
    ],
)
def test_parameters_and_thresholds_that_are_no_region_are_refused(make_head, changes, match):
    given = {"score": "normalised", "parameters": POINTS, **changes}
    with pytest.raises(CalibrationFileError, match=match):
        make_head("mcqr", **given)
