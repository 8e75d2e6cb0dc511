"""The covariance of a pose, for filters that need one, from its conformal set.

A set states where the truth lies with a probability; a filter wants second moments. The conversion
takes the errors for normal, with the set as their central part, and is a convention: the guarantee
is that of the set alone. For degree of freedom d, with half-width h_d, midpoint m_d and pose p_d,

    S = diag(h_d / z)^2 + (m - p)(m - p)^T

is the second moment about the pose. z is the normal quantile at which the set holds one degree of
freedom: that of (1 + c)/2 for the confidence c in the marginal scope, and of (1 + c^(1/6))/2 in the
joint one, where six independent errors are inside at once. A region of ellipsoids with centres y_j,
scale B and radius r has correlations, too:

    S = mean_j (y_j - p)(y_j - p)^T + r^2 / q B B^T

with q the chi-square quantile of six degrees of freedom at c.

S is in the chart of the bundle. Filters follow ``geometry_msgs/PoseWithCovariance``: x y z, then
small rotations w about the fixed axes of the world, R_true = Exp(w) R. To first order,

    Sigma = G S G^T,  G = diag(I, A)

with A = R Jr(r) for ``tangent_reference``, Jr the right Jacobian of SO(3) (Sola, Deray and
Atchuthan 2018, eq. 143), A = R for ``tangent_predicted``, and [Rz Ry ex, Rz ey, ez] for
``euler_zyx``.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.errors import UsageError
from cvo_edge.pose import Chart, Pose
from cvo_edge.sets import ConformalSet
from cvo_edge.vocabulary import Scope

Array = NDArray[np.float64]

_SIX = 6
_NEWTON_STEPS = 50


def in_chart(found: ConformalSet, point: Array, confidence: float, scope: Scope) -> Array:
    """Return S (6, 6) in m and rad, infinite where the set is unbounded.

    ``point`` (6,): coordinates of the pose in the chart.
    """
    if found.ellipsoids is not None and math.isfinite(found.ellipsoids.radius):
        region = found.ellipsoids
        off = region.centres.astype(np.float64) - point
        B = region.scale.astype(np.float64)
        share = region.radius**2 / chi_square_quantile(confidence)
        return np.asarray(off.T @ off / len(off) + share * B @ B.T)
    one = confidence ** (1.0 / _SIX) if scope == "joint" else confidence
    z = NormalDist().inv_cdf(0.5 + 0.5 * one)
    variance = ((found.upper - found.lower) / (2.0 * z)) ** 2
    known = np.isfinite(variance)
    off = np.zeros(_SIX)
    off[known] = 0.5 * (found.lower[known] + found.upper[known]) - point[known]
    return np.asarray(np.diag(variance) + np.outer(off, off))


def in_world(chart_covariance: Array, chart: Chart, pose: Pose, point: Array) -> Array:
    """Return Sigma (6, 6): x y z (m), then rotations about the world's fixed axes (rad).

    An infinite variance leaves nothing known: all six are then infinite.
    """
    if not np.isfinite(chart_covariance).all():
        return np.diag(np.full(_SIX, np.inf))
    G = np.eye(_SIX)
    G[3:, 3:] = _rotation_axes(chart, pose, point[3:])
    return np.asarray(G @ chart_covariance @ G.T)


def moved(world_covariance: Array, lever_m: Array, R_map_world: Array) -> Array:
    """Return the covariance (6, 6) of another point of the body, in another frame.

    Parameters
    ----------
    world_covariance
        Of the camera, about the world's axes.
    lever_m
        From the camera to the point, (3,), in the world's axes.
    R_map_world
        Shape (3, 3).
    """
    if not np.isfinite(world_covariance).all():
        return world_covariance
    # A rotation w moves the point by w x lever.
    x, y, z = lever_m.tolist()
    G = np.eye(_SIX)
    G[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    T = np.kron(np.eye(2), R_map_world) @ G
    return np.asarray(T @ world_covariance @ T.T)


def chi_square_quantile(level: float) -> float:
    """Return the quantile of the chi-square distribution of six degrees of freedom.

    Its distribution function is 1 - exp(-x/2) (1 + x/2 + x^2/8).
    """
    if not 0.0 < level < 1.0:
        raise UsageError(f"level: expected a number between 0 and 1, found {level}")
    x = float(_SIX)
    for _ in range(_NEWTON_STEPS):
        left = math.exp(-0.5 * x)
        step = (1.0 - left * (1.0 + 0.5 * x + 0.125 * x * x) - level) / (left * x * x / 16.0)
        # Half the way to zero at most: far in the tail, Newton's step overshoots.
        x = max(x - step, 0.5 * x)
        if abs(step) < 1e-12 * x:
            break
    return x


def nees(errors: Array, covariances: Array) -> Array:
    """Return e^T Sigma^-1 e (n,) of errors (n, 6) with covariances (n, 6, 6).

    Its mean is six where the covariances fit (Bar-Shalom, Li and Kirubarajan 2001, section 5.4).
    """
    solved = np.linalg.solve(covariances, errors[:, :, np.newaxis])[:, :, 0]
    return np.asarray(np.sum(errors * solved, axis=1))


def euler_axes(turn: Array) -> Array:
    """Return [Rz Ry ex, Rz ey, ez] (3, 3): what roll, pitch and yaw (3,) turn about."""
    _, pitch, yaw = turn.tolist()
    cp, sp, cy, sy = math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
    return np.array([[cy * cp, -sy, 0.0], [sy * cp, cy, 0.0], [-sp, 0.0, 1.0]])


def _rotation_axes(chart: Chart, pose: Pose, turn: Array) -> Array:
    """Return A (3, 3): what the rotation numbers turn about, in the world's axes."""
    if chart.rotation == "euler_zyx":
        return euler_axes(turn)
    R = geometry.quaternion_to_matrix(pose.q_xyzw)
    if chart.rotation == "tangent_predicted":
        return R
    return np.asarray(R @ _right_jacobian(turn))


def _right_jacobian(turn: Array) -> Array:
    """Return Jr (3, 3) with Exp(r + d) = Exp(r) Exp(Jr(r) d) to first order."""
    x, y, z = turn.tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle2 = float(turn @ turn)
    if angle2 < 1e-8:
        first, second = 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        angle = math.sqrt(angle2)
        first = (1.0 - math.cos(angle)) / angle2
        second = (angle - math.sin(angle)) / (angle2 * angle)
    return np.asarray(np.eye(3) - first * cross + second * cross @ cross)
