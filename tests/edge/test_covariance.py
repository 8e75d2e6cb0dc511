"""Covariances are the second moments that sampled errors have, in every chart and frame."""

import numpy as np
import pytest
from scipy.stats import chi2, norm

from cvo_edge import geometry
from cvo_edge.covariance import chi_square_quantile, nees
from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.pose import Chart, Pose
from cvo_edge.record import Status
from cvo_edge.sets import ConformalSet, Ellipsoids

from .simulated_drives import composed

Q = geometry.quaternion_exp([0.5, -0.9, 0.7])
CHARTS = {
    "tangent_predicted": Chart("tangent_predicted"),
    "tangent_reference": Chart("tangent_reference", geometry.quaternion_exp([-0.4, 0.3, 0.2])),
    "euler_zyx": Chart("euler_zyx"),
}
BASE = Pose(np.array([0.3, -0.2, 0.6]), geometry.quaternion_exp([0.2, 1.1, -0.4]))
MAP = Pose(np.array([10.0, -4.0, 2.0]), geometry.quaternion_exp([0.1, 0.2, 2.0]))


def interval(chart, found, confidence=0.9, scope="marginal"):
    pose = Pose(np.array([1.0, 2.0, 3.0]), Q)
    return PoseInterval(0, None, "", Status.OK, (), pose, found, confidence, scope, chart)


def quaternion_of(chart, numbers):
    """Rotation numbers (n, 3) -> quaternions (n, 4)."""
    if chart.rotation == "euler_zyx":
        return geometry.euler_zyx_to_quaternion(numbers)
    base = Q if chart.reference_q_xyzw is None else chart.reference_q_xyzw
    return geometry.quaternion_multiply(base, geometry.quaternion_exp(numbers))


@pytest.mark.parametrize("place", ["camera", "base in map"])
@pytest.mark.parametrize("region", ["box", "ellipsoids"])
@pytest.mark.parametrize("chart", CHARTS.values(), ids=CHARTS)
def test_sampled_errors_have_the_covariance(chart, region, place):
    generator = np.random.default_rng(3)
    pose = Pose(np.array([1.0, 2.0, 3.0]), Q).to_array()
    point = chart.point(pose)
    count = 200_000
    if region == "box":
        half = np.array([0.02, 0.01, 0.03, 0.008, 0.006, 0.01])
        middle = point + 0.4 * half
        found = interval(chart, ConformalSet(middle - half, middle + half))
        drawn = middle + generator.normal(size=(count, 6)) * half / norm.ppf(0.95)
    else:
        B = np.tril(generator.normal(size=(6, 6))) * 1e-3
        centres = point + 2e-3 * generator.normal(size=(8, 6))
        radius = 2.0 * np.sqrt(chi2.ppf(0.9, 6))
        hull = ConformalSet(point - 1, point + 1, ellipsoids=Ellipsoids(centres, B, radius))
        found = interval(chart, hull, scope="joint")
        noise = 2.0 * generator.normal(size=(count, 6)) @ B.T
        drawn = centres[generator.integers(0, 8, count)] + noise
    truth = np.concatenate([drawn[:, :3], quaternion_of(chart, drawn[:, 3:])], axis=1)
    given = {} if place == "camera" else {"T_camera_base": BASE, "T_map_world": MAP}
    if given:
        truth = composed(MAP.to_array(), composed(truth, BASE.to_array()))
    at = found.pose_of(**given).to_array()
    turn = geometry.quaternion_multiply(truth[:, 3:], geometry.quaternion_conjugate(at[3:]))
    errors = np.concatenate([truth[:, :3] - at[:3], geometry.quaternion_log(turn)], axis=1)
    sampled = errors.T @ errors / count
    scale = np.sqrt(np.diag(sampled))
    off = (found.covariance(**given) - sampled) / np.outer(scale, scale)
    assert np.abs(off).max() < 0.01


@pytest.mark.parametrize(("scope", "level"), [("marginal", 0.9), ("joint", 0.9 ** (1 / 6))])
def test_the_quantile_is_that_of_the_scope(scope, level):
    point = CHARTS["tangent_predicted"].point(Pose(np.array([1.0, 2.0, 3.0]), Q).to_array())
    z = norm.ppf(0.5 + 0.5 * level)
    found = interval(CHARTS["tangent_predicted"], ConformalSet(point - z, point + z), 0.9, scope)
    np.testing.assert_allclose(found.covariance("chart"), np.eye(6), atol=1e-12)


def test_the_chi_square_quantile_is_scipys():
    levels = np.array([1e-6, 0.1, 0.5, 0.9, 0.99, 1 - 1e-9])
    found = [chi_square_quantile(level) for level in levels]
    np.testing.assert_allclose(found, chi2.ppf(levels, 6), rtol=1e-7)


def test_the_nees_of_normal_errors_is_six_on_average():
    generator = np.random.default_rng(0)
    B = np.tril(generator.normal(size=(6, 6))) + 2 * np.eye(6)
    errors = generator.normal(size=(20_000, 6)) @ B.T
    assert abs(nees(errors, np.broadcast_to(B @ B.T, (20_000, 6, 6))).mean() - 6) < 0.1


def test_an_unbounded_set_has_no_finite_variance():
    low, high = np.full(6, -1.0), np.full(6, 1.0)
    high[4] = np.inf
    found = interval(CHARTS["tangent_predicted"], ConformalSet(low, high))
    assert np.isinf(np.diag(found.covariance())).all()
    assert np.isinf(np.diag(found.covariance(T_camera_base=BASE))).all()
    assert np.flatnonzero(np.isinf(np.diag(found.covariance("chart")))).tolist() == [4]


def test_a_chart_has_no_base():
    found = interval(CHARTS["tangent_predicted"], ConformalSet(np.zeros(6), np.ones(6)))
    with pytest.raises(UsageError, match="expected world with T_camera_base"):
        found.covariance("chart", T_camera_base=BASE)
    with pytest.raises(UsageError, match="expected world or chart, found 'map'"):
        found.covariance("map")
