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

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry

Array = NDArray[np.float64]

NU = 3.0
# Factors of the squared scales in the Gauss-Newton steps, and the number of Newton steps after
# them. On real frames the result is then within a micrometre of the optimum, but for frames whose
# cells contradict each other.
_SMOOTHING = (1000.0, 100.0, 10.0, 3.0, 1.0)
_NEWTON_STEPS = 4
# Steps of a camera's fit, and precision of the prior on its three numbers.
_LENS_STEPS, _LENS_PRECISION = 10, 1.0
# Points closer to the image plane than this share of the damping deviation of the position, or
# behind it, have no weight.
_NEAR = 0.01
# Squared error in units of the scale of such points.
_BEHIND = 1e6
# Squared error, normalised, of such points where a start is chosen.
_BEHIND_SQUARED = 1e6
# Scale of reprojection errors, normalised, for exact points.
_EXACT_SCALE = 0.01


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
    """

    pose: Array
    information: Array
    squared: Array
    last_step: float


class PoseSolver:
    """Solve for the pose of frames whose cells have fixed rays.

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
        self._R = geometry.quaternion_to_matrix(starts[:, 3:])
        self._t = np.ascontiguousarray(starts[:, :3])
        # The steps are along the camera's axes, which have no part in a deviation of their own.
        self._precision = 1.0 / np.square(np.repeat([damping[:3].mean(), damping[3:].mean()], 3))
        self._near = _NEAR * float(damping[:3].mean())

    def solve(self, points: Array, scale: Array) -> Solution:
        """World points (n, 3), m, and scales (n,) in normalised coordinates -> solution."""
        X = np.ascontiguousarray(points.T, dtype=np.float64)
        spread = NU * np.square(scale, dtype=np.float64)
        if not self._whole:
            spread = np.where(self.seen, spread, np.inf)
        R, t = self._start(X, spread)
        for factor in _SMOOTHING:
            R, t, found = self._step(R, t, X, factor * spread, newton=False)
        for _ in range(_NEWTON_STEPS):
            R, t, found = self._step(R, t, X, spread, newton=True)
        pose = np.array([*t.tolist(), *_quaternion(*R.ravel().tolist())])
        return Solution(pose, _in_world(found.information, R), found.squared, self._length(found))

    def error_on_exact_points(self) -> float:
        """Return the error of the pose that is found for points of a known pose near a start.

        The largest of its position errors, in mean deviations of the damping, and its rotation
        error, in rad: rounding only, unless this machine computes wrongly.
        """
        reach, rays = self._near / _NEAR, self._rays
        R, t = _moved(self._R[0], self._t[0], np.array([*(0.1 * reach,) * 3, *(0.05,) * 3]))
        depth = reach * (2.0 + np.sin(np.arange(rays.shape[1])))
        X = R @ (depth * np.vstack([rays, np.ones_like(depth)])) + t[:, np.newaxis]
        found = self.solve(X.T, np.full(rays.shape[1], _EXACT_SCALE)).pose
        # Entries of R_hat - R are as large as the angle between them.
        turned = np.abs(geometry.quaternion_to_matrix(found[3:]) - R).max()
        return float(max(np.abs(found[:3] - t).max() / reach, turned))

    def _start(self, X: Array, spread: Array) -> tuple[Array, Array]:
        """Return the rotation (3, 3) and position (3,) of the start with the best likelihood."""
        if len(self._t) == 1:
            return self._R[0], self._t[0]
        Y = np.matmul(self._R.transpose(0, 2, 1), X - self._t[:, :, np.newaxis])
        ahead = Y[:, 2] > self._near
        depth = np.where(ahead, Y[:, 2], 1.0)
        error = Y[:, :2] / depth[:, np.newaxis] - self._rays
        squared = np.where(ahead, np.square(error).sum(axis=1), _BEHIND_SQUARED)
        best = int(np.log1p(squared / spread).sum(axis=1).argmin())
        return self._R[best], self._t[best]

    def _step(
        self, R: Array, t: Array, X: Array, spread: Array, newton: bool
    ) -> tuple[Array, Array, _Step]:
        """One step from R (3, 3) and t (3,); ``spread`` (n,) are nu times the squared scales."""
        image, J, ahead = self._projected(R, t, X)
        error = image - self._rays
        squared = error[0] * error[0] + error[1] * error[1]
        weight = (NU + 2.0) / (spread + squared)
        weight *= ahead
        weighted = J * weight
        rows = weighted.reshape(6, -1)
        information = rows @ J.reshape(6, -1).T
        information.flat[::7] += self._precision
        gradient = rows @ error.reshape(-1)
        if newton:
            # The weights fall with the error: second term of the Hessian, if it stays convex.
            pull = weighted[:, 0] * error[0] + weighted[:, 1] * error[1]
            hessian = information - (2.0 / (NU + 2.0)) * (pull @ pull.T)
            information = hessian if _positive_definite(hessian) else information
        step = np.linalg.solve(information, gradient)
        squared = np.where(ahead, squared * (NU / spread), _BEHIND)
        return *_moved(R, t, step), _Step(information, squared, gradient)

    def _length(self, step: _Step) -> float:
        """Return a step's length in deviations, as if it had not been damped."""
        try:
            undamped = np.linalg.solve(step.information - np.diag(self._precision), step.gradient)
        except np.linalg.LinAlgError:
            return math.inf
        squared = float(undamped @ step.gradient)
        return math.sqrt(squared) if squared >= 0.0 else math.inf

    def _projected(self, R: Array, t: Array, X: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Project points (3, n): image (2, n), its derivatives (6, 2, n), and which are ahead.

        The derivatives are by motion along and rotation about the camera's axes, with
        Y(delta) = Y - motion - rotation x Y.
        """
        Y = R.T @ (X - t[:, np.newaxis])
        ahead = Y[2] > self._near
        inverse = 1.0 / np.where(ahead, Y[2], 1.0)
        image = Y[:2] * inverse
        u, v = image
        J = np.zeros((6, 2, X.shape[1]))
        J[0, 0] = J[1, 1] = -inverse
        np.multiply(image, inverse, out=J[2])
        np.multiply(u, v, out=J[3, 0])
        J[3, 1] = 1.0 + v * v
        J[4, 0] = -1.0 - u * u
        np.negative(J[3, 0], out=J[4, 1])
        J[5, 0] = v
        np.negative(u, out=J[5, 1])
        return image, J, ahead

    def lens_evidence(self, points: Array, scale: Array, pose: Array) -> LensEvidence:
        """Return what a solved frame says about the camera; arguments as for ``solve``.

        The image of a ray (u, v) becomes (1 + k r^2) (e^a u, e^b v), with r^2 = u^2 + v^2. Of the
        second derivatives by the pose and (a, b, k) together, the Schur complement is what remains
        for (a, b, k) once the pose has adapted.
        """
        R = geometry.quaternion_to_matrix(pose[3:])
        hessian, gradient = self._lens_system(points, scale, R, pose[:3], np.zeros(3), newton=True)
        by_pose = np.linalg.solve(hessian[:6, :6], hessian[:6, 6:]).T
        return LensEvidence(
            by_pose @ gradient[:6] - gradient[6:], hessian[6:, 6:] - by_pose @ hessian[:6, 6:]
        )

    def lens_fit(self, frames: Sequence[tuple[Array, Array, Array]]) -> LensFit:
        """Fit one camera to several frames, given as (points, scale, pose) each.

        All poses and the three numbers of ``lens_evidence`` take reweighted Gauss-Newton steps
        together, as in a bundle adjustment whose points stay fixed.
        """
        R = [geometry.quaternion_to_matrix(pose[3:]) for _, _, pose in frames]
        t = [pose[:3] for _, _, pose in frames]
        lens = np.zeros(3)
        for _ in range(_LENS_STEPS):
            information, pull = np.diag(np.full(3, _LENS_PRECISION)), _LENS_PRECISION * lens
            systems = []
            for (points, scale, _), R_i, t_i in zip(frames, R, t, strict=True):
                hessian, gradient = self._lens_system(points, scale, R_i, t_i, lens, newton=False)
                solved = np.linalg.solve(hessian[:6, :6], np.c_[hessian[:6, 6:], gradient[:6]])
                information = information + hessian[6:, 6:] - hessian[6:, :6] @ solved[:, :3]
                pull = pull + gradient[6:] - hessian[6:, :6] @ solved[:, 3]
                systems.append(solved)
            step = np.linalg.solve(information, pull)
            lens = lens - step
            for number, solved in enumerate(systems):
                move = np.asarray(solved[:, 3] - solved[:, :3] @ step)
                R[number], t[number] = _moved(R[number], t[number], move)
        seen = self.seen
        errors = [
            np.linalg.norm(
                _distorted(self._projected(R_i, t_i, points[seen].T)[0], lens)
                - self._rays[:, seen],
                axis=0,
            )
            for (points, _, _), R_i, t_i in zip(frames, R, t, strict=True)
        ]
        return LensFit(lens, np.array(errors))

    def _lens_system(
        self, points: Array, scale: Array, R: Array, t: Array, lens: Array, newton: bool
    ) -> tuple[Array, Array]:
        """Return the second (9, 9) and first (9,) derivatives of one frame's loss.

        The nine are the pose, as in ``_projected``, and the lens (a, b, k).
        """
        X = np.ascontiguousarray(points.T, dtype=np.float64)
        spread = NU * np.square(scale, dtype=np.float64)
        image, J, ahead = self._projected(R, t, X)
        r2 = image[0] * image[0] + image[1] * image[1]
        shown, bent = image, r2 * image
        if lens.any():
            # d shown = zoom ((1 + k r^2) d image + 2 k image (image . d image)).
            zoom, along = np.exp(lens[:2])[:, np.newaxis], (J * image).sum(axis=1)[:, np.newaxis]
            J = zoom * ((1.0 + lens[2] * r2) * J + 2.0 * lens[2] * image * along)
            shown, bent = _distorted(image, lens), zoom * bent
        full = np.zeros((9, *image.shape))
        full[:6], full[6, 0], full[7, 1], full[8] = J, shown[0], shown[1], bent
        error = shown - self._rays
        squared = error[0] * error[0] + error[1] * error[1]
        weight = (NU + 2.0) / (spread + squared)
        weight *= ahead if self._whole else ahead & self.seen
        weighted = full * weight
        rows = weighted.reshape(9, -1)
        hessian = rows @ full.reshape(9, -1).T
        if newton:
            pull = weighted[:, 0] * error[0] + weighted[:, 1] * error[1]
            hessian -= (2.0 / (NU + 2.0)) * (pull @ pull.T)
        hessian.flat[: 6 * 9 : 10] += self._precision
        return hessian, rows @ error.reshape(-1)


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


def _distorted(image: Array, lens: Array) -> Array:
    """Image coordinates (2, n) as a camera that differs by ``lens`` (3,) would show them."""
    r2 = image[0] * image[0] + image[1] * image[1]
    return np.asarray(np.exp(lens[:2])[:, np.newaxis] * (1.0 + lens[2] * r2) * image)


def _moved(R: Array, t: Array, step: Array) -> tuple[Array, Array]:
    """Subtract a step (6,) or longer in the camera frame from a pose."""
    return R @ _rotation(*(-step[3:6]).tolist()), t - R @ step[:3]


def dispersion(squared: Array, steps: int) -> float:
    """Squared errors in units of the scales, (n,) -> the common factor of the squared scales.

    Steps of expectation maximisation from 1 towards the maximum of the likelihood (Lange, Little
    and Taylor 1989, section 3): where the cells of a frame disagree more than their scales say, the
    factor exceeds 1, and the pose is less certain.
    """
    factor = 1.0
    for _ in range(steps):
        factor = float(np.mean(squared * (NU + 2.0) / (NU + squared / factor))) / 2.0
    return factor


class _Step(NamedTuple):
    """A step's information and gradient in the camera frame, and squared errors."""

    information: Array
    squared: Array
    gradient: Array


def _positive_definite(matrix: Array) -> bool:
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


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


def _in_world(information: Array, R: Array) -> Array:
    """Express the position's part of a camera-frame information (6, 6) along the world's axes."""
    found = information.copy()
    found[:3, :3] = R @ information[:3, :3] @ R.T
    found[:3, 3:] = R @ information[:3, 3:]
    found[3:, :3] = found[:3, 3:].T
    return found
