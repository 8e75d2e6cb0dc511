"""Two covariances of an estimator's motion, for filters that need one.

Neither follows from the intervals' guarantee. A covariance fits when the normalised squared error

    NEES = x^T Sigma^-1 x

has a mean of six, and is at most the chi-square quantile 12.6 (0.95) or 10.6 (0.9) as often as
these say (Bar-Shalom, Li and Kirubarajan 2001, section 5.4). One covariance cannot do both jobs:

``interval``
    of the motion over one horizon: Sigma = kappa U M U + b b^T, with the scales u of the interval
    on the diagonal of U, the correlation of scaled residuals M, and kappa such that 90 % of the
    first term's NEES are at most 10.6. The bias b, the middle of the interval, makes it the second
    moment about the motion that is given. It is for gates and for single measurements.
``integrated``
    of one step, for a filter that adds steps up as if their errors were independent, which they
    are not: Q = diag(f u^2), with six factors f such that sums over 1, 2, 5 and 10 s are as large
    as errors over these times. Single steps then look too uncertain; that is the price.

x = (t, Log R) is in the body frame at the end of the motion, as everywhere here. A sum of steps
carries errors along by x' = Ad(e^-1) x for each later step e.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.covariance import nees
from cvo_edge.motion.relative import motion, residual
from cvo_edge.motion.thresholds import Scores
from cvo_edge.motion.trace import Rows
from cvo_edge.spread import Spread

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# The chi-square quantile of six degrees of freedom at 0.9.
LEVEL, CHI_SQUARE = 0.9, 10.6446
# Times over which an integrated covariance is fitted, and tabled.
SPANS_S = (1.0, 2.0, 5.0, 10.0)
# Of all calibration recordings together; anchors of one are evenly apart.
MOST_ANCHORS = 1200
_ROUNDS = 25
# So many anchors' steps are in memory at once.
_AT_ONCE = 64
_STEP = 0.7
# Squares are clipped at so many times the predicted variance: outliers decide on no variance.
_CLIP = 16.0
_LEAST = 1e-12
# Variances of 0.1 um and 0.1 urad more: of a planar robot, filters could not factorise the others.
FLOOR = 1e-14 * np.eye(6)
_RIDGE = 1e-4


class Shape(NamedTuple):
    """kappa M (6, 6): the covariance of residuals that are divided by their scales."""

    matrix: Array

    def covariance(self, scales: Array, bias: Array) -> Array:
        """Return Sigma (m, 6, 6) of motions with scales (m, 8 or 6) and bias (m, 6)."""
        u = scales[:, :6]
        about_bias = u[:, :, np.newaxis] * self.matrix * u[:, np.newaxis] + FLOOR
        return np.asarray(about_bias + bias[:, :, np.newaxis] * bias[:, np.newaxis])


def adjoint(steps: Array) -> Array:
    """Return Ad(e^-1) (n, 6, 6) of steps e (n, 7), for twists (t, w)."""
    inverse = np.swapaxes(geometry.quaternion_to_matrix(steps[:, 3:]), 1, 2)
    carried = np.zeros((len(steps), 6, 6))
    carried[:, :3, :3] = carried[:, 3:, 3:] = inverse
    x, y, z = steps[:, :3].T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    carried[:, :3, 3:] = -inverse @ cross
    return carried


def in_fixed_axes(covariance: Array, q_xyzw: Array) -> Array:
    """Return covariances (n, 6, 6) about the axes of the frame that rotations (n, 4) lead to.

    A motion dE with a residual of covariance Sigma in its end's body frame has, in the frame where
    it starts, the covariance of ``geometry_msgs/PoseWithCovariance``: x y z, then rotations about
    the fixed axes. With dE Exp(x) that is B Sigma B^T, B = diag(R, R), R the rotation of dE.
    """
    R = geometry.quaternion_to_matrix(q_xyzw)
    B = np.zeros((len(R), 6, 6))
    B[:, :3, :3] = B[:, 3:, 3:] = R
    return np.asarray(B @ covariance @ np.swapaxes(B, 1, 2))


def fit_shape(scaled: Spread[Array], groups: Sequence[str]) -> Shape:
    """Return the shape of residuals without bias, divided by their scales, (m, 6) each."""
    spread = np.mean(scaled.map(_clipped_moments).collect(), axis=0)
    # A degree of freedom that never errs, as of a planar robot, still needs a variance.
    deviation = np.sqrt(np.maximum(np.diag(spread), _LEAST))
    matrix = spread + _RIDGE * np.diag(deviation**2)
    whole = scaled.map(partial(_nees_of, matrix=matrix)).collect()
    q = Scores(whole, groups).thresholds("mean", LEVEL)
    return Shape(matrix * float(q[0]) / CHI_SQUARE)


def _nees_of(residuals: Array, matrix: Array) -> Array:
    """Return NEES (n, 1) of residuals (n, 6) with one covariance (6, 6)."""
    solved = np.linalg.solve(matrix, residuals.T)
    return np.asarray(np.sum(residuals.T * solved, axis=0))[:, np.newaxis]


def _clipped_moments(values: Array) -> Array:
    """Return the second moments (6, 6) of values (m, 6) without outliers."""
    clipped = _clipped(values)
    return np.asarray(clipped.T @ clipped / len(values))


def _clipped(values: Array) -> Array:
    usual = np.sqrt(_CLIP) * np.maximum(np.median(np.abs(values), axis=0), 1e-12)
    return np.asarray(np.clip(values, -usual, usual))


class Sums(NamedTuple):
    """Sums of steps after anchors, over one time.

    Attributes
    ----------
    parts
        Shape (m, 6, 6, 6): covariance that a unit variance of each degree of freedom of all steps,
        in units of its scale, comes to.
    residuals
        Shape (m, 6).
    """

    parts: Array
    residuals: Array

    def covariance(self, factors: Array) -> Array:
        """Return the covariance (m, 6, 6) for factors f (6,)."""
        return np.asarray(np.einsum("mdij,d->mij", self.parts, factors))


def sums_of(
    rows: Rows, truth: Array, scales: Array, spans_s: Sequence[float], apart: int
) -> list[Sums]:
    """Return sums over several ascending times after anchors ``apart`` rows from each other.

    ``scales`` (n, 6): of the step that ends at each row. Sums that cross a break are left out.
    """
    usual = float(np.median(np.diff(rows.stamps_ns)))
    lengths = [max(1, round(1e9 * span / usual)) for span in spans_s]
    anchors = np.arange(0, len(rows.part) - lengths[-1] - 1, apart)
    found: list[list[Sums]] = [[] for _ in lengths]
    for first in range(0, max(1, len(anchors)), _AT_ONCE):
        start = anchors[first : first + _AT_ONCE]
        later = start[:, np.newaxis] + np.arange(1, lengths[-1] + 1)
        # Variances of all steps, in the anchor's frame: first those up to the shortest time.
        back = motion(rows.poses[later], rows.poses[start][:, np.newaxis])
        columns = adjoint(back.reshape(-1, 7)).reshape(*later.shape, 6, 6)
        columns = np.ascontiguousarray(
            (columns * scales[later][:, :, np.newaxis]).transpose(0, 3, 2, 1)
        )
        variances, before = np.zeros((len(start), 6, 6, 6)), 0
        for sums, length in zip(found, lengths, strict=True):
            steps = columns[..., before:length]
            variances, before = variances + steps @ np.swapaxes(steps, -1, -2), length
            end = start + length
            moved = motion(rows.poses[start], rows.poses[end])
            off = residual(moved, motion(truth[start], truth[end]))
            fine = np.isfinite(off).all(axis=1) & (rows.part[start] == rows.part[end])
            A = adjoint(moved[fine])[:, np.newaxis]
            sums.append(Sums(A @ variances[fine] @ np.swapaxes(A, -1, -2), off[fine]))
    return [Sums(*map(np.concatenate, zip(*sums, strict=True))) for sums in found]


def fit_factors(recordings: Sequence[Sequence[Sums]], groups: Sequence[str]) -> Array:
    """Return the factors f (6,), from the sums over each time of each recording.

    Each round multiplies a factor by how much larger errors are than predicted, as a geometric mean
    over times; at the end, one number scales all, so that over drives and times, 90 % of NEES are
    at most 10.6 on average.
    """
    factors = np.ones(6)
    for _ in range(_ROUNDS):
        growth = np.zeros(6)
        for over in zip(*recordings, strict=True):
            ratios = np.mean([_variance_ratio(sums, factors) for sums in over], axis=0)
            growth += np.log(np.maximum(ratios, 1e-12)) / len(recordings[0])
        # A degree of freedom that never errs would shrink beyond what numbers hold.
        factors = np.maximum(factors * np.exp(_STEP * growth), _LEAST)
    scores = [
        np.concatenate([nees(sums.residuals, sums.covariance(factors)) for sums in each])
        for each in recordings
    ]
    q = Scores([each[:, np.newaxis] for each in scores], groups)
    inflated = factors * float(q.thresholds("mean", LEVEL)[0]) / CHI_SQUARE
    return np.asarray(np.maximum(inflated, _LEAST))


def _variance_ratio(sums: Sums, factors: Array) -> Array:
    predicted = np.einsum("mdii,d->mi", sums.parts, factors)
    return np.asarray(np.mean(np.minimum(sums.residuals**2 / (predicted + _LEAST), _CLIP), axis=0))
