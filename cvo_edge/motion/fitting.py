"""Bias and scale of errors, fitted on other recordings than those that they are applied to.

With the numbers a of a motion (``trace.motion_numbers``) and v (``trace.scale_numbers``), for each
degree of freedom d

    bias  b_d = B_d (1, a)            ridge regression of x_d
    scale u_d = exp(U_d (1, v))       ridge regression of log |x_d - b_d|

Neither has to be right: conformal scores |x_d - b_d| / u_d only become narrower where they are.
Recordings count equally. A recording whose errors are ten times those of others has no more to say
about the bias: each one is divided by its own usual error.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.motion.relative import norms

Array = NDArray[np.float64]

# Six degrees of freedom, then the position error and the rotation angle.
ERRORS = 8
_RIDGE_BIAS, _RIDGE_SCALE = 3e-3, 1e-1
# Errors beyond so many times the median are clipped before the bias is fitted.
_CLIP = 6.0
# Of the median error: smaller errors are luck, not skill.
_LEAST = 0.2
# Numbers are clipped at so many standard deviations: no extrapolation.
_RANGE = 3.0
# Numbers that vary less, such as the height of a planar robot, are noise of rounding.
_ROUNDING = 1e-7
# Of any scale in a file, whoever wrote it.
_LARGEST_LOG = 20.0


class Normal(NamedTuple):
    """Weighted sums over recordings: A^T A (..., k, k) and A^T y (..., k) or (k, targets)."""

    left: Array
    right: Array

    def plus(self, other: Normal) -> Normal:
        """Return the sums over both."""
        return Normal(self.left + other.left, self.right + other.right)


class Scale(NamedTuple):
    """Coefficients U (k, 8), and the range (k - 1,) that numbers are clipped to."""

    coefficients: Array
    lowest: Array
    highest: Array


def bias_sums(numbers: Array, errors: Array) -> Normal:
    """Return the normal equations of one recording's bias: left (6, k, k), right (6, k)."""
    A = _with_one(numbers)
    usual = np.maximum(np.median(np.abs(errors), axis=0), 1e-12)
    clipped = np.clip(errors, -_CLIP * usual, _CLIP * usual)
    weight = 1.0 / (len(errors) * usual**2)
    gram, moments = A.T @ A, A.T @ clipped
    return Normal(weight[:, np.newaxis, np.newaxis] * gram, weight[:, np.newaxis] * moments.T)


def solve_bias(sums: Normal) -> Array:
    """Return B (k, 6)."""
    pairs = zip(sums.left, sums.right, strict=True)
    return np.stack([_ridge(left, right, _RIDGE_BIAS) for left, right in pairs], axis=1)


def predict_bias(coefficients: Array, numbers: Array) -> Array:
    """Return the biases (n, 6) of motions with numbers (n, k - 1)."""
    return np.asarray(coefficients[0] + numbers @ coefficients[1:])


def scale_sums(numbers: Array, errors: Array) -> Normal:
    """Return the normal equations of one recording's scales; errors (n, 6) without their bias."""
    A, sizes = _with_one(numbers), eight(errors)
    least = _LEAST * np.maximum(np.median(sizes, axis=0), 1e-9)
    y = np.log(sizes + least)
    return Normal(A.T @ A / len(A), A.T @ y / len(A))


def solve_scale(sums: Normal) -> Scale:
    """Return the coefficients and the range of their numbers."""
    mean, variance = _moments(sums.left)
    reach = _RANGE * np.sqrt(variance)
    return Scale(
        _ridge(sums.left, sums.right, _RIDGE_SCALE), (mean - reach)[1:], (mean + reach)[1:]
    )


def predict_scale(scale: Scale, numbers: Array) -> Array:
    """Return the scales (n, 8) of motions with numbers (n, k - 1); clips the numbers."""
    inside = np.clip(numbers, scale.lowest, scale.highest)
    logarithms = scale.coefficients[0] + inside @ scale.coefficients[1:]
    return np.asarray(np.exp(np.clip(logarithms, -_LARGEST_LOG, _LARGEST_LOG)))


def predicted_bias(coefficients: Array, numbers: Array) -> Array:
    """Return the biases (6, m) of motions with numbers (k - 1, m).

    Coefficients are (k, 6, 1), or (k, 6, m) if each motion has its own. A motion gets the same bits
    however many are predicted with it, which products of matrices do not promise.
    """
    return np.asarray(_in_order(numbers, coefficients[1:]) + coefficients[0])


def predicted_scale(scale: Scale, numbers: Array) -> Array:
    """Return the scales (8, m) of motions with numbers (k - 1, m), as ``predicted_bias``.

    The ranges are (k - 1, 1) or (k - 1, m).
    """
    inside = np.minimum(np.maximum(numbers, scale.lowest), scale.highest)
    logarithms = _in_order(inside, scale.coefficients[1:]) + scale.coefficients[0]
    return np.asarray(np.exp(np.minimum(np.maximum(logarithms, -_LARGEST_LOG), _LARGEST_LOG)))


def _in_order(numbers: Array, coefficients: Array) -> Array:
    """Return sums over the first axis of (k, m) times (k, d, 1 or m), each in its order."""
    products = np.multiply(numbers[:, np.newaxis], coefficients, order="C")
    return np.asarray(np.add.reduce(products, axis=0))


def eight(errors: Array) -> Array:
    """Errors (n, 6) -> their sizes and the two norms, (n, 8)."""
    return np.concatenate([np.abs(errors), norms(errors)], axis=1)


def _ridge(left: Array, right: Array, strength: float) -> Array:
    """Solve for coefficients; each column of A is penalised in units of its own variance."""
    variance = np.maximum(_moments(left)[1], _ROUNDING**2)
    penalty = strength * left[0, 0] * variance + 1e-9 * np.diag(left) + 1e-300
    penalty[0] = 0.0
    return np.asarray(np.linalg.solve(left + np.diag(penalty), right))


def _moments(left: Array) -> tuple[Array, Array]:
    mean = left[0] / left[0, 0]
    return mean, np.maximum(np.diag(left) / left[0, 0] - mean**2, 0.0)


def _with_one(numbers: Array) -> Array:
    return np.concatenate([np.ones((len(numbers), 1)), numbers], axis=1)
