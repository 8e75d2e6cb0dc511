"""Covariances of motions: their axes, sums of steps, and how they fit errors."""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from cvo_edge import geometry
from cvo_edge.motion.audit import audit
from cvo_edge.motion.conformalize import conformalize
from cvo_edge.motion.covariance import (
    CHI_SQUARE,
    LEVEL,
    Shape,
    Sums,
    adjoint,
    fit_factors,
    fit_shape,
    in_fixed_axes,
    nees,
)
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.intervals import MotionCalibration
from cvo_edge.motion.relative import residual
from cvo_edge.spread import Here

from .simulated_drives import composed, drive, twist

Array = NDArray[np.float64]


def any_covariance(generator: np.random.Generator, size: float) -> Array:
    root = size * generator.normal(size=(6, 6))
    return root @ root.T


def test_fixed_axes_are_those_of_samples() -> None:
    """True motions around an estimated one, seen from the frame where it starts."""
    generator = np.random.default_rng(0)
    moved = twist(np.array([1.0, -2.0, 0.5, 0.8, -0.3, 1.2]))
    covariance = any_covariance(generator, 0.002)
    drawn = generator.normal(size=(20_000, 6))
    # Samples with exactly this second moment: only what is left out of the formula shows.
    root = np.linalg.cholesky(drawn.T @ drawn / len(drawn))
    x = np.linalg.solve(root, drawn.T).T @ np.linalg.cholesky(covariance).T
    true = composed(np.tile(moved, (len(x), 1)), twist(x))
    turned = geometry.quaternion_multiply(true[:, 3:], geometry.quaternion_conjugate(moved[3:]))
    off = np.concatenate([true[:, :3] - moved[:3], geometry.quaternion_log(turned)], axis=1)
    found = in_fixed_axes(covariance[np.newaxis], moved[np.newaxis, 3:])[0]
    scale = np.sqrt(np.diag(found))
    assert np.abs((off.T @ off / len(off) - found) / np.outer(scale, scale)).max() < 0.01


def test_a_step_carries_small_errors_along() -> None:
    generator = np.random.default_rng(1)
    before, step = twist(generator.normal(size=6)), twist(generator.normal(size=6))
    for x in 1e-5 * generator.normal(size=(5, 6)):
        # The estimate before * step, the truth before * Exp(x) * step.
        off = residual(composed(before, step), composed(composed(before, twist(x)), step))
        carried = adjoint(step[np.newaxis])[0] @ x
        np.testing.assert_allclose(off, carried, atol=1e-8)


def test_a_shape_fits_normal_residuals() -> None:
    generator = np.random.default_rng(2)
    covariance = any_covariance(generator, 1.0)
    samples = [generator.multivariate_normal(np.zeros(6), covariance, 4000) for _ in range(4)]
    shape = fit_shape(Here(samples), "abcd")
    np.testing.assert_allclose(shape.matrix, covariance, atol=0.1 * np.abs(covariance).max())
    scales = np.array([[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]])
    bias = generator.normal(size=(1, 6))
    found = Shape(covariance).covariance(scales, bias)[0]
    about_bias = np.diag(scales[0]) @ covariance @ np.diag(scales[0])
    np.testing.assert_allclose(found, about_bias + np.outer(bias, bias))


def test_the_quantile_is_chi_squares() -> None:
    assert abs(CHI_SQUARE - chi2(6).ppf(LEVEL)) < 1e-4
    generator = np.random.default_rng(3)
    covariance = any_covariance(generator, 1.0)
    x = generator.multivariate_normal(np.zeros(6), covariance, 2000)
    expected = np.einsum("ni,ij,nj->n", x, np.linalg.inv(covariance), x)
    np.testing.assert_allclose(nees(x, np.tile(covariance, (2000, 1, 1))), expected)


def test_both_covariances_fit_drives_with_independent_steps() -> None:
    horizons = (Horizon.parse("1f"), Horizon.parse("1s"))
    pairs = [drive(60 + seed, 500) for seed in range(8)]
    calibration = MotionCalibration(conformalize(Here(pairs[:5]), "test", horizons, []))
    report = audit(calibration, calibration.level(), pairs[5:])
    rows = [(*recording.horizons, *recording.integrated) for recording in report.recordings]
    for over in zip(*rows, strict=True):
        assert 0.6 < np.mean([each.nees for each in over]) < 1.5, over
        assert np.mean([each.nees_inside for each in over]) > 0.8, over
    assert [each.seconds for each in report.recordings[0].integrated] == [1.0, 2.0, 5.0, 10.0]


def test_filters_can_factorise_the_covariance_of_a_planar_robot() -> None:
    """Height, roll and pitch never err, and their scale tends to nothing."""
    generator = np.random.default_rng(3)
    plane = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    shape = fit_shape(Here([plane * generator.normal(size=(200, 6)) for _ in range(3)]), "abc")
    scales = np.where(plane > 0.0, 1e-2, 4e-9)[np.newaxis]
    turn = geometry.quaternion_exp(np.array([[0.3, -0.2, 2.0]]))
    (covariance,) = in_fixed_axes(shape.covariance(scales, np.zeros((1, 6))), turn)
    np.linalg.cholesky(covariance)
    assert np.sqrt(np.linalg.eigvalsh(covariance)[0]) > 0.5e-7


def test_factors_of_a_degree_of_freedom_that_never_errs_are_numbers() -> None:
    generator = np.random.default_rng(4)
    moves = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    parts = np.einsum("di,dj->dij", np.eye(6), np.eye(6))
    sums = [
        Sums(np.tile(count * parts, (50, 1, 1, 1)), moves * generator.normal(size=(50, 6)))
        for count in (10, 20, 50, 100)
    ]
    factors = fit_factors([sums, sums], ["a", "b"])
    assert (factors[:3] > 1e-4).all()
    assert (factors < 10.0).all()
