"""The pose solver: exact on exact points, robust to wrong ones, and honest about its covariance."""

import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.camera import Camera, cell_centres
from cvo_edge.pose import Chart
from cvo_edge.pose_solver import PoseSolver, _quaternion, dispersion
from cvo_edge.reprojection import NU

CAMERA = Camera(width=256, height=192, fx=234.0, fy=234.0, cx=127.5, cy=95.5)
RAYS = CAMERA.rays(cell_centres(192, 256, (12, 16)))
DEVIATION = np.array([0.5, 0.5, 0.5, 0.4, 0.4, 0.4])
CHART = Chart("tangent_predicted")


def pose_near(generator, spread_m=0.15, spread_rad=0.15):
    q = geometry.quaternion_exp(generator.normal(0.0, spread_rad, 3))
    return np.concatenate([generator.normal(0.0, spread_m, 3), q])


def points_of(pose, generator, noise_px=0.0):
    """World points (n, 3) on the rays of a camera at ``pose``, at depths of 1 to 4 m."""
    seen = RAYS + generator.standard_t(NU, RAYS.shape) * noise_px / CAMERA.fx
    depth = generator.uniform(1.0, 4.0, (len(RAYS), 1))
    in_camera = np.column_stack([seen, np.ones(len(RAYS))]) * depth
    return in_camera @ geometry.quaternion_to_matrix(pose[3:]).T + pose[:3]


def solver(starts=None):
    identity = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    return PoseSolver(RAYS, identity if starts is None else starts, DEVIATION)


def error(truth, found):
    return CHART.coordinates(truth, found) - CHART.coordinates(found, found)


@pytest.mark.parametrize("seed", range(20))
def test_exact_points_give_the_exact_pose(seed):
    generator = np.random.default_rng(seed)
    truth = pose_near(generator)
    found = solver().solve(points_of(truth, generator), np.full(len(RAYS), 1.0 / CAMERA.fx))
    np.testing.assert_allclose(error(truth, found.pose), 0.0, atol=1e-6)


@pytest.mark.parametrize("seed", range(10))
def test_a_third_of_wrong_points_does_not_matter(seed):
    generator = np.random.default_rng(seed)
    truth = pose_near(generator)
    points = points_of(truth, generator, 0.5)
    wrong = generator.permutation(len(points))[: len(points) // 3]
    points[wrong] += generator.normal(0.0, 1.0, (len(wrong), 3))
    found = solver().solve(points, np.full(len(RAYS), 1.0 / CAMERA.fx))
    assert np.linalg.norm(error(truth, found.pose)[:3]) < 0.01


def turned_by(x, y, z):
    """The matrix exponential of a turn, which also takes complex numbers."""
    cross = np.array([[0.0 * x, -z, y], [z, 0.0 * x, -x], [-y, x, 0.0 * x]])
    term = R = np.eye(3)
    for power in range(1, 25):
        term = term @ cross / power
        R = R + term
    return R


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_the_pose_maximises_the_likelihood(size, optimize):
    """A general optimiser, started at the truth, finds the same pose, in a place of any size."""
    generator = np.random.default_rng(3)
    unit = np.repeat([size, 1.0], 3)
    start = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    for _ in range(3):
        truth = pose_near(generator)
        points = points_of(truth, generator, 1.0)
        wrong = generator.permutation(len(points))[: len(points) // 5]
        points[wrong] += generator.normal(0.0, 0.2, (len(wrong), 3))
        scale = generator.uniform(0.5, 3.0, len(points)) / CAMERA.fx
        found = PoseSolver(RAYS, start, unit * DEVIATION).solve(size * points, scale)
        R, scales = geometry.quaternion_to_matrix(truth[3:]), scale[:, np.newaxis]

        def loss(step, points=points - truth[:3], R=R, scales=scales):
            Y = (points - step[:3]) @ R @ turned_by(*step[3:])
            squared = (((Y[:, :2] / Y[:, 2:] - RAYS) / scales) ** 2).sum(axis=1)
            return (NU + 2.0) / 2.0 * np.log(1.0 + squared / NU).sum()

        def gradient(step, loss=loss):
            """Exact to rounding: derivatives along the imaginary axis."""
            return np.array([loss(step + 1e-30j * each).imag for each in np.eye(6)]) / 1e-30

        oracle = optimize.minimize(
            loss, np.zeros(6), jac=gradient, method="BFGS", options={"gtol": 1e-7}
        )
        turn = geometry.quaternion_exp(oracle.x[3:])
        np.testing.assert_allclose(found.pose[:3] / size, truth[:3] + oracle.x[:3], atol=1e-9)
        expected = geometry.quaternion_multiply(truth[3:], turn)
        np.testing.assert_allclose(found.pose[3:], expected, atol=1e-9)
        assert found.last_step < 1e-4


def test_the_information_predicts_the_errors():
    """Over many frames, errors divided by the stated deviation have deviation 1."""
    generator = np.random.default_rng(4)
    z = []
    for _ in range(300):
        truth = pose_near(generator)
        found = solver().solve(points_of(truth, generator, 1.0), np.full(len(RAYS), 1 / CAMERA.fx))
        factor = np.linalg.cholesky(found.information)
        z.append(factor.T @ error(truth, found.pose))
    assert 0.9 < np.std(z) < 1.1


def test_the_nearest_start_reaches_poses_all_around():
    generator = np.random.default_rng(5)
    turns = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    starts = np.array(
        [[0, 0, 0, *geometry.quaternion_exp([0.0, turn, 0.0])] for turn in turns], float
    )
    for turn in generator.uniform(0.0, 2.0 * np.pi, 20):
        q = geometry.quaternion_multiply(
            geometry.quaternion_exp([0.0, turn, 0.0]),
            geometry.quaternion_exp(generator.normal(0.0, 0.1, 3)),
        )
        truth = np.array([*generator.normal(0.0, 0.3, 3), *geometry.quaternion_normalise(q)])
        found = solver(starts).solve(points_of(truth, generator, 0.5), np.full(len(RAYS), 1 / 234))
        assert np.linalg.norm(error(truth, found.pose)) < 0.05


def test_a_tiny_change_of_the_points_makes_a_tiny_change_of_the_pose():
    generator = np.random.default_rng(6)
    scale = np.full(len(RAYS), 1.0 / CAMERA.fx)
    for _ in range(50):
        points = points_of(pose_near(generator), generator, 2.0)
        found = solver().solve(points, scale)
        moved = points * (1.0 + 1e-6 * generator.standard_normal(points.shape))
        other = solver().solve(moved, scale)
        assert np.abs(error(found.pose, other.pose)).max() < 1e-4


def test_cells_without_a_ray_have_no_weight():
    generator = np.random.default_rng(7)
    truth = pose_near(generator)
    points = points_of(truth, generator)
    rays = RAYS.copy()
    rays[::5] = np.nan
    points[::5] = 1e3
    identity = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    found = PoseSolver(rays, identity, DEVIATION).solve(points, np.full(len(rays), 1 / CAMERA.fx))
    np.testing.assert_allclose(error(truth, found.pose), 0.0, atol=1e-6)
    assert not found.squared[::5].any()


@pytest.mark.parametrize("value", [0.0, 1e8, -1e8])
def test_senseless_points_still_give_a_finite_answer(value):
    found = solver().solve(np.full((len(RAYS), 3), value), np.full(len(RAYS), 1.0 / CAMERA.fx))
    assert np.isfinite(found.pose).all()
    assert np.isfinite(found.information).all()
    assert (np.linalg.eigvalsh(found.information) > 0.0).all()


@pytest.mark.parametrize(
    "turn", [(0.1, 0.2, 0.3), (3.1, 0.1, 0.1), (0.1, 3.1, 0.1), (0.1, 0.1, 3.1)]
)
def test_one_quaternion_is_that_of_the_vectorised_form(turn):
    q = geometry.quaternion_exp(np.array(turn))
    R = geometry.quaternion_to_matrix(q)
    found = _quaternion(*R.ravel().tolist())
    np.testing.assert_allclose(found, geometry.matrix_to_quaternion(R), atol=1e-12)


@pytest.mark.parametrize("factor", [0.25, 1.0, 9.0])
def test_the_dispersion_is_the_factor_of_the_squared_scales(factor, optimize):
    """Squared radii of Student's t with nu = 3 in two dimensions are 2 F(2, nu) distributed."""
    squared = factor * 2.0 * np.random.default_rng(0).f(2.0, NU, 100_000)
    assert dispersion(squared, 60) == pytest.approx(factor, rel=0.03)
    # One step goes a part of the way, from 1.
    one = dispersion(squared, 1)
    assert abs(np.log(one)) < abs(np.log(factor)) + 0.01
    assert np.log(one) * np.log(factor) >= 0.0
    of_scipy = optimize.minimize_scalar(
        lambda v: np.log(v) + (NU + 2) / 2 * np.log1p(squared / (NU * v)).mean(),
        bounds=(0.01, 100.0),
        method="bounded",
        options={"xatol": 1e-6},
    )
    assert dispersion(squared, 60) == pytest.approx(of_scipy.x, rel=1e-3)


def test_cells_without_a_ray_have_no_part_in_what_is_said_of_the_camera():
    generator = np.random.default_rng(20)
    truth = pose_near(generator)
    points, scale = points_of(truth, generator, 0.5), np.full(len(RAYS), 1.0 / CAMERA.fx)
    identity = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    shown = np.arange(len(RAYS)) % 3 > 0
    some = PoseSolver(np.where(shown[:, np.newaxis], RAYS, np.nan), identity, DEVIATION)
    fewer = PoseSolver(RAYS[shown], identity, DEVIATION)
    pose = some.solve(points, scale).pose
    np.testing.assert_allclose(pose, fewer.solve(points[shown], scale[shown]).pose, atol=1e-12)
    for found, expected in zip(
        some.solve(points, scale).lens,
        fewer.solve(points[shown], scale[shown]).lens,
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-9)
    lens, error = some.lens_fit([(points, scale, pose)])
    expected = fewer.lens_fit([(points[shown], scale[shown], pose)])
    np.testing.assert_allclose(lens, expected.lens, atol=1e-9)
    np.testing.assert_allclose(error, expected.error, atol=1e-9)


def test_points_behind_the_camera_contradict_it():
    generator = np.random.default_rng(21)
    truth = pose_near(generator)
    points = points_of(truth, generator)
    R = geometry.quaternion_to_matrix(truth[3:])
    behind = np.column_stack([RAYS[:80], np.full(80, -3.0)])
    points[:80] = behind @ R.T + truth[:3]
    found = solver().solve(points, np.full(len(RAYS), 1.0 / CAMERA.fx))
    assert (found.squared[:80] > 1e3).all()
    assert (found.squared[80:] < 1.0).all()


@pytest.mark.parametrize("deviation", [1e-3, 1e-2, 1.0])
def test_a_place_that_was_seen_from_one_height_is_solved(deviation):
    generator = np.random.default_rng(22)
    damping = np.array([0.5, 0.5, 3.0 * deviation, 0.4, 0.4, 0.4])
    identity = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    for _ in range(20):
        truth = pose_near(generator)
        found = PoseSolver(RAYS, identity, damping).solve(
            points_of(truth, generator, 0.3), np.full(len(RAYS), 0.3 / CAMERA.fx)
        )
        assert found.last_step < 0.05
        assert np.linalg.norm(found.pose[:3] - truth[:3]) < 0.02


def test_a_solver_that_is_held_back_has_not_converged():
    generator = np.random.default_rng(23)
    truth = pose_near(generator)
    identity = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    held = PoseSolver(RAYS, identity, np.full(6, 1e-6))
    found = held.solve(points_of(truth, generator, 0.3), np.full(len(RAYS), 0.3 / CAMERA.fx))
    assert not found.last_step < 1.0


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_a_working_solver_finds_a_known_pose_in_a_place_of_any_size(size):
    start = np.array([[3.0 * size, 2.0 * size, 0.0, 0.5, 0.5, 0.5, 0.5]])
    damping = DEVIATION * np.repeat([size, 1.0], 3)
    assert PoseSolver(RAYS, start, damping).error_on_exact_points() < 1e-12
