"""Refine the motion between two images: Gauss-Newton on Sampson errors, and on rotations alone.

The motion takes points of the later camera to the earlier one, X1 = R X2 + t, with t on the unit
sphere. For rays x1 and x2 whose third component is 1, and E = [t]x R,

    e = x1^T E x2,    a = E x2,    b = E^T x1
    r = e / sqrt(a1^2 + a2^2 + b1^2 + b2^2)

is the distance of the pair of rays from the nearest pair that fits (Sampson 1982; Hartley and
Zisserman 2004, section 11.4.3). R changes to R Exp(w), t by a step along the sphere: five unknowns.
Without translation, the error is x1 - proj(R x2), with three unknowns: R becomes Exp(w) R. Both
have the weights of Cauchy's loss (Huber and Ronchetti 2009), with a scale by the median error.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STEPS = 10
# Steps (rad) that are shorter change nothing that matters: a few thousandths of a pixel.
_CONVERGED = 3e-6
# Cauchy's scale over the median absolute error: 1.4826 times that is the deviation of normal
# errors, and 2.385 deviations keep 95 % of the efficiency of least squares.
_CAUCHY = 1.4826 * 2.385
_RIDGE = 1e-9


class Refined(NamedTuple):
    """A motion and how well it fits.

    Attributes
    ----------
    R, t
        Shape (3, 3) and (3,): X1 = R X2 + t, with t of unit length, or zero for a rotation alone.
    errors
        Shape (n,): Sampson errors, or the lengths of the errors of a rotation.
    scale
        Cauchy's scale, in the unit of the errors.
    information
        Shape (5, 5) for w and t, (3, 3) for w: second derivative of the loss.
    """

    R: Array
    t: Array
    errors: Array
    scale: float
    information: Array


def sampson(x1: Array, x2: Array, R: Array, t: Array) -> Array:
    """Return the Sampson errors (n,) of rays x1 and x2 (3, n)."""
    E = _skew(t) @ R
    a, b = E @ x2, E.T @ x1
    e = (x1 * a).sum(axis=0)
    return np.asarray(e / np.sqrt(np.maximum(_square(a, b), 1e-300)))


def sampson_slopes(x1: Array, x2: Array, R: Array, t: Array) -> tuple[Array, Array]:
    """Return the Sampson errors (n,) of rays (3, n), and their derivatives (6, n).

    The derivatives are by w in R Exp(w), and by t as if it were free.
    """
    y = R @ x2
    a, b = _cross(t, y), R.T @ _cross(x1, t)
    e = (x1 * a).sum(axis=0)
    inverse = 1.0 / np.sqrt(np.maximum(_square(a, b), 1e-300))
    r = e * inverse
    # Of half the square under the root, over the square.
    shrink = r * inverse * inverse
    a *= shrink
    a[2] = 0.0
    c = b * shrink
    c[2] = 0.0
    Rc, Ea = R @ c, R.T @ _cross(a, t)
    J = np.empty((6, x1.shape[1]))
    # de = w . (x2 x b),  a . da = w . (x2 x E^T a),  b . db = w . (b' x b) with b' = (b1, b2, 0).
    J[:3] = _cross(x2, b * inverse - Ea) - _cross(c, b)
    # de = dt . (y x x1),  a . da = dt . (y x a'),  b . db = dt . (R b' x x1).
    J[3:] = _cross(y, x1 * inverse - a) - _cross(Rc, x1)
    return r, J


def tangent(t: Array) -> Array:
    """Return two unit vectors (3, 2) that are orthogonal to a unit vector and to each other."""
    x, y, z = t.tolist()
    # Duff et al. 2017: without a branch on the smallest component.
    sign = math.copysign(1.0, z)
    p = -1.0 / (sign + z)
    q = x * y * p
    return np.array([[1.0 + sign * x * x * p, q], [sign * q, sign + y * y * p], [-sign * x, -y]])


def refine_motion(x1: Array, x2: Array, R: Array, t: Array, least: float) -> Refined:
    """Refine R (3, 3) and t (3,) on rays (3, n).

    ``least``: of Cauchy's scale, in normalised coordinates.
    """
    scale = math.inf
    for step in range(_STEPS + 1):
        r, slopes = sampson_slopes(x1, x2, R, t)
        basis = tangent(t)
        J = np.concatenate([slopes[:3], basis.T @ slopes[3:]])
        scale = min(scale, max(_CAUCHY * float(np.median(np.abs(r))), least))
        weighted = J / (1.0 + np.square(r / scale))
        information = weighted @ J.T
        if step == _STEPS:
            break
        d = _solved(information, weighted @ r)
        R = R @ rotation(-d[:3])
        t = t - basis @ d[3:]
        t = t / np.linalg.norm(t)
        if np.abs(d).max() < _CONVERGED:
            break
    return Refined(R, t, r, scale, information)


def refine_rotation(x1: Array, x2: Array, R: Array, least: float) -> Refined:
    """Refine a rotation (3, 3) alone on rays (3, n); ``least`` as for ``refine_motion``."""
    scale = math.inf
    J = np.empty((3, 2, x1.shape[1]))
    for step in range(_STEPS + 1):
        y = R @ x2
        u, v = y[:2] / y[2]
        error = x1[:2] - (u, v)
        size = np.sqrt((error * error).sum(axis=0))
        scale = min(scale, max(_CAUCHY * float(np.median(size)), least))
        # y moves by w x y.
        J[0, 0], J[0, 1] = u * v, 1.0 + v * v
        J[1, 0], J[1, 1] = -1.0 - u * u, -u * v
        J[2, 0], J[2, 1] = v, -u
        weighted = (J / (1.0 + np.square(size / scale))).reshape(3, -1)
        information = weighted @ J.reshape(3, -1).T
        if step == _STEPS:
            break
        d = _solved(information, weighted @ error.reshape(-1))
        R = rotation(-d) @ R
        if np.abs(d).max() < _CONVERGED:
            break
    return Refined(R, np.zeros(3), size, scale, information)


def rotation(w: Array) -> Array:
    """Return the matrix (3, 3) of a rotation vector (3,): Rodrigues' formula."""
    angle = math.sqrt(float(w @ w))
    W = _skew(w)
    # sin(a) / a and (1 - cos(a)) / a^2, also at zero.
    first, half = np.sinc(angle / math.pi), np.sinc(0.5 * angle / math.pi)
    return np.asarray(np.eye(3) + first * W + 0.5 * half * half * (W @ W))


def _solved(information: Array, gradient: Array) -> Array:
    damped = information.copy()
    damped.flat[:: len(gradient) + 1] *= 1.0 + _RIDGE
    # A picture without any structure along some axis leaves it as it is.
    damped.flat[:: len(gradient) + 1] += 1e-12
    return np.asarray(np.linalg.solve(damped, gradient))


def _square(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * a[0] + a[1] * a[1] + b[0] * b[0] + b[1] * b[1])


def _skew(t: Array) -> Array:
    x, y, z = t
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _cross(a: Array, b: Array) -> Array:
    """Return the cross products (3, n) of vectors (3, n) or (3,); faster than numpy's."""
    ax, ay, az = a
    bx, by, bz = b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
