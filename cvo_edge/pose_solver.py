"""The camera pose that fits predicted scene coordinates, by a fixed number of Newton steps.

A network predicts for each cell of the image the world point X_i that the cell shows, and a scale
s_i of its reprojection error. The pose maximises the likelihood of a bivariate Student's t
distribution with nu = 3 degrees of freedom (Lange, Little and Taylor 1989) of the reprojection
errors e_i = pi(R^T (X_i - t)) - ray_i:

    minimise  sum_i (nu + 2)/2 log(1 + |e_i|^2 / (nu s_i^2))

The first steps are reweighted Gauss-Newton steps with enlarged scales, which fall to 1 (graduated
non-convexity, Blake and Zisserman 1987), so that a distant start sees a smooth valley; the last are
Newton steps, without the projection's own curvature. Nothing is drawn at random: RANSAC would turn
rounding errors of 1e-6 into other inliers and poses centimetres away, so two processors would
disagree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.reprojection import NU, Cells

Array = NDArray[np.float64]

# Factors of the squared scales in the Gauss-Newton steps, and the number of Newton steps after
# them. On real frames the result is then within a micrometre of the optimum, but for frames whose
# cells contradict each other.
_SMOOTHING = (1000.0, 100.0, 10.0, 3.0, 1.0)
_NEWTON_STEPS = 4
# Steps of a camera's fit, and precision of the prior on its three numbers.
_LENS_STEPS, _LENS_PRECISION = 10, 1.0
# Scale of reprojection errors, normalised, for exact points.
_EXACT_SCALE = 0.01


class LensEvidence(NamedTuple):
    """How the camera seems to differ from the stated one, by one frame.

    The evidence of several frames adds up; ``information^-1 gradient`` is then a first estimate of
    three numbers: the logarithms of the factors of fx and fy, and the additional radial distortion
    k1. A single frame may leave some of them open.

    Attributes
    ----------
    gradient
        Shape (3,): derivative of the log likelihood.
    information
        Shape (3, 3): its negative second derivative, with the pose free to adapt.
    """

    gradient: Array
    information: Array


class Solution(NamedTuple):
    """The pose of one frame and what its cells say about it.

    Attributes
    ----------
    pose
        Shape (7,): tx ty tz qx qy qz qw of ``T_world_camera``, unit quaternion, qw >= 0.
    information
        Shape (6, 6), positive definite: curvature of the loss and of the damping, an inverse
        covariance of (t - t_hat, Log(R_hat^T R)), 1/m and 1/rad.
    squared
        Shape (n,): each cell's squared reprojection error in units of its scale.
    last_step
        Length of the last step in deviations; near 0 if the steps have converged.
    lens
        What the frame says about the camera.
    """

    pose: Array
    information: Array
    squared: Array
    last_step: float
    lens: LensEvidence


class PoseSolver:
    """Solve for the pose of frames whose cells have fixed rays.

    Positions are in units of the damping deviation of the position throughout, so that no pivot
    of a small or a large place comes near to what OpenCV takes for zero.

    Parameters
    ----------
    rays
        Shape (n, 2): normalised image coordinates of the cell centres, without distortion; NaN for
        cells outside the lens model, which have no weight.
    starts
        Shape (k, 7): poses to start from; a frame starts from the one that fits it best.
    damping
        Shape (6,): deviation, m and rad, far beyond which no step goes.

    Attributes
    ----------
    seen
        Shape (n,): which cells have a ray.
    """

    def __init__(self, rays: Array, starts: Array, damping: Array) -> None:
        self.seen = np.asarray(np.isfinite(rays).all(axis=1))
        self._whole = bool(self.seen.all())
        self._rays = np.ascontiguousarray(np.where(self.seen[:, np.newaxis], rays, 0.0).T)
        self._unit = float(damping[:3].mean())
        # (3, k, 4): one product projects the points for all starts.
        self._starts = np.stack([self._to_camera(start) for start in starts], axis=1)
        # The steps are along the camera's axes, which have no part in a deviation of their own.
        self._identity = np.eye(6)
        self._precision = np.diag(np.repeat([1.0, 1.0 / float(damping[3:].mean()) ** 2], 3))

    def solve(self, points: NDArray[np.floating], scale: Array) -> Solution:
        """World points (n, 3), m, and scales (n,) in normalised coordinates -> solution."""
        cells = self._cells(points, scale)
        T = self._starts[:, cells.best(self._starts) if self._starts.shape[1] > 1 else 0]
        for factor in _SMOOTHING:
            _, step = self._step(cells, T, factor)
            T = _moved(T, step[:, 0])
        for last in (False,) * (_NEWTON_STEPS - 1) + (True,):
            system, step = self._step(cells, T, newton=True, lens=last)
            T = _moved(T, step[:, 0])
        # Of the second derivatives by pose and lens together, the Schur complement is what remains
        # for the lens once the pose has adapted, as it has in this step.
        remains = system[6:, 6:] - system[6:, :6] @ step
        information = system[:6, :6]
        R = T[:, :3].T
        position = (-self._unit * (R @ T[:, 3])).tolist()
        in_world = self._identity.copy()
        in_world[:3, :3] = R / self._unit
        return Solution(
            np.array([*position, *_quaternion(*R.ravel().tolist())]),
            in_world @ information @ in_world.T,
            cells.relative(),
            self._length(information, system[:6, 6:7]),
            LensEvidence(-remains[1:, 0], remains[1:, 1:]),
        )

    def error_on_exact_points(self) -> float:
        """Return the error of the pose that is found for points of a known pose near a start.

        The largest of its position errors, in mean deviations of the damping, and its rotation
        error, in rad: rounding only, unless this machine computes wrongly.
        """
        T = _moved(self._starts[:, 0], np.array([*(0.1,) * 3, *(0.05,) * 3]))
        R, rays = T[:, :3].T, self._rays
        depth = 2.0 + np.sin(np.arange(rays.shape[1]))
        X = R @ (depth * np.vstack([rays, np.ones_like(depth)]) - T[:, 3:])
        found = self.solve(self._unit * X.T, np.full(rays.shape[1], _EXACT_SCALE)).pose
        # Entries of R_hat - R are as large as the angle between them.
        turned = np.abs(geometry.quaternion_to_matrix(found[3:]) - R).max()
        return float(max(np.abs(found[:3] / self._unit + R @ T[:, 3]).max(), turned))

    def _cells(self, points: NDArray[np.floating], scale: Array) -> Cells:
        spread = NU * scale.astype(np.float64) ** 2
        if not self._whole:
            spread = np.where(self.seen, spread, np.inf)
        return Cells(points, spread, self._rays, self._unit)

    def _to_camera(self, pose: Array) -> Array:
        """World pose (7,) of a camera -> ``T_camera_world`` (3, 4)."""
        R = geometry.quaternion_to_matrix(pose[3:])
        return np.column_stack([R.T, -(R.T @ pose[:3]) / self._unit])

    def _step(
        self, cells: Cells, T: Array, factor: float = 1.0, newton: bool = False, lens: bool = False
    ) -> tuple[Array, Array]:
        """Return the normal equations at ``T``, and what solves them for the pose.

        The first column of what solves them is the step, the others are by the lens.
        """
        cells.project(T)
        if lens:
            cells.show()
        # Newton's step, if the Hessian is convex.
        for system in cells.normal_equations(factor, lens, newton):
            system[:6, :6] += self._precision
            solved, step = cv2.solve(system[:6, :6], system[:6, 6:], flags=cv2.DECOMP_CHOLESKY)
            if solved:
                break
        return system, np.asarray(step, np.float64)

    def _length(self, information: Array, gradient: Array) -> float:
        """Return a step's length in deviations, as if it had not been damped."""
        solved, undamped = cv2.solve(information - self._precision, gradient, flags=cv2.DECOMP_LU)
        squared = float(undamped[:, 0] @ gradient[:, 0])
        return math.sqrt(squared) if solved and squared >= 0.0 else math.inf

    def lens_fit(self, frames: Sequence[tuple[Array, Array, Array]]) -> LensFit:
        """Fit one camera to several frames, given as (points, scale, pose) each.

        All poses and the three numbers of ``LensEvidence`` take reweighted Gauss-Newton steps
        together, as in a bundle adjustment whose points stay fixed.
        """
        T = [self._to_camera(pose) for _, _, pose in frames]
        cells = [self._cells(points, scale) for points, scale, _ in frames]
        lens = np.zeros(3)
        for _ in range(_LENS_STEPS):
            information, pull = np.diag(np.full(3, _LENS_PRECISION)), _LENS_PRECISION * lens
            systems = []
            for each, T_i in zip(cells, T, strict=True):
                each.project(T_i)
                each.show(lens)
                (system,) = each.normal_equations(1.0, lens=True, newton=False)
                solved = np.linalg.solve(system[:6, :6] + self._precision, system[:6, 6:])
                information = information + system[7:, 7:] - system[7:, :6] @ solved[:, 1:]
                pull = pull + system[7:, 6] - system[7:, :6] @ solved[:, 0]
                systems.append(solved)
            step = np.linalg.solve(information, pull)
            lens = lens - step
            T = [
                _moved(T_i, np.asarray(solved[:, 0] - solved[:, 1:] @ step))
                for T_i, solved in zip(T, systems, strict=True)
            ]
        errors = []
        for each, T_i in zip(cells, T, strict=True):
            each.project(T_i)
            each.show(lens)
            errors.append(np.sqrt(each.squared[self.seen]))
        return LensFit(lens, np.array(errors))


class LensFit(NamedTuple):
    """The camera that fits several frames best.

    Attributes
    ----------
    lens
        Shape (3,): the three numbers of ``LensEvidence``.
    error
        Shape (frames, n): reprojection errors that remain, in normalised coordinates, of the n
        cells that have a ray.
    """

    lens: Array
    error: Array


def dispersion(squared: Array, steps: int) -> float:
    """Squared errors in units of the scales, (n,) -> the common factor of the squared scales.

    Steps of expectation maximisation from 1 towards the maximum of the likelihood (Lange, Little
    and Taylor 1989, section 3): where the cells of a frame disagree more than their scales say, the
    factor exceeds 1, and the pose is less certain.
    """
    factor = 1.0
    for _ in range(steps):
        weighed = squared / (squared / factor + NU)
        factor = (NU + 2.0) / 2.0 * float(weighed.sum()) / len(squared)
    return factor


def _moved(T: Array, step: Array) -> Array:
    """Subtract a step (6,) along and about the camera's axes from ``T_camera_world`` (3, 4)."""
    along = T.copy()
    along[:, 3] += step[:3]
    return _rotation(*step[3:].tolist()) @ along


def _rotation(x: float, y: float, z: float) -> Array:
    """Rotation vector -> matrix (3, 3), Rodrigues' formula; plain Python is faster for one."""
    angle = math.sqrt(x * x + y * y + z * z)
    a = math.sin(angle) / angle if angle > 1e-8 else 1.0
    half = math.sin(0.5 * angle) / angle if angle > 1e-8 else 0.5
    b = 2.0 * half * half
    return np.array(
        (
            (1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y),
            (b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x),
            (b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)),
        )
    )


def _quaternion(
    xx: float,
    xy: float,
    xz: float,
    yx: float,
    yy: float,
    yz: float,
    zx: float,
    zy: float,
    zz: float,
) -> tuple[float, float, float, float]:
    """Rotation matrix by rows -> unit quaternion x y z w, w >= 0 (Shepperd 1978).

    For one matrix, plain Python takes a tenth of the time of ``geometry.matrix_to_quaternion``.
    """
    if xx + yy + zz > 0.0:
        q = (zy - yz, xz - zx, yx - xy, 1.0 + xx + yy + zz)
    elif xx >= yy and xx >= zz:
        q = (1.0 + xx - yy - zz, xy + yx, xz + zx, zy - yz)
    elif yy >= zz:
        q = (xy + yx, 1.0 - xx + yy - zz, yz + zy, xz - zx)
    else:
        q = (xz + zx, yz + zy, 1.0 - xx - yy + zz, yx - xy)
    scale = math.copysign(1.0 / math.hypot(*q), q[3])
    return q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale
