"""Reprojection errors of one frame's cells, with their derivatives by the pose and the lens.

A camera at ``T_camera_world`` sees the point X_i at Y_i = T X_i and shows it at the normalised
coordinates (u, v) = (Y_x, Y_y) / Y_z. Derivatives are by motion along and rotation about the
camera's axes, with Y(delta) = Y - motion - rotation x Y; and by the lens (a, b, k), with which a
ray (u, v) is shown at (1 + k r^2) (e^a u, e^b v), r^2 = u^2 + v^2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Degrees of freedom of the errors' distribution, Student's t.
NU = 3.0
# Points closer to the image plane than this, or behind it, have no weight.
_NEAR = 0.01
# Squared error, normalised, of such points where a start is chosen, and in units of the scale.
_BEHIND_SQUARED, _BEHIND = 1e6, 1e6
_SIGNS = np.array([[1.0], [-1.0]])
# The row of the errors, after the six of the pose and before the three of the lens.
ERROR = 6


class Cells:
    """World points of cells, and how a camera sees them.

    Just after an inference, a call of numpy takes much longer than its arithmetic. So all rows
    lie in one array, which gives every product of the normal equations at once.

    Parameters
    ----------
    points
        Shape (n, 3): world points.
    spread
        Shape (n,): nu times the squared scales of the errors; infinite for cells without a ray.
    rays
        Shape (2, n): normalised coordinates of the cells.
    unit
        The unit of lengths in what follows, in that of the points.

    Attributes
    ----------
    rows
        Shape (10, 2, n): derivatives of the image by the pose, its error, derivatives by the lens.
    squared
        Shape (n,): squared errors at the last pose, and the last lens if one was given.
    """

    def __init__(
        self, points: NDArray[np.floating], spread: Array, rays: Array, unit: float
    ) -> None:
        count = rays.shape[1]
        self.spread, self._rays = spread, rays
        self._points = np.empty((4, count))
        self._points[:3] = points.T
        self._points[:3] *= 1.0 / unit
        self._points[3] = 1.0
        self.rows = np.zeros((10, 2, count))
        # Views of the rows, without the zeros of the first two; ``_middle`` is what a turn about x
        # or y adds to the middle of the image.
        self._sideways = self.rows[:2].reshape(4, count)[::3]
        self._forward, self._tilt, self._roll = self.rows[2], self.rows[3:5], self.rows[5]
        self._middle = self._tilt.reshape(4, count)[1:3]
        self._error = self.rows[ERROR]

    def best(self, poses: Array) -> int:
        """Return which of the poses (3, k, 4), the rows of k ``T_camera_world``, fits best."""
        Y = (poses.reshape(-1, 4) @ self._points).reshape(3, poses.shape[1], -1)
        error, depth = Y[:2], Y[2]
        # In place: the inference has emptied the caches.
        error /= np.maximum(depth, _NEAR)
        error -= self._rays[:, np.newaxis]
        error *= error
        squared = np.where(depth > _NEAR, error[0] + error[1], _BEHIND_SQUARED)
        squared /= self.spread
        return int(np.log1p(squared, out=squared).sum(axis=1).argmin())

    def project(self, T: Array) -> None:
        """Write the rows of the pose and the error at ``T_camera_world`` (3, 4)."""
        Y = T @ self._points
        depth = Y[2]
        self.ahead = depth > _NEAR
        inverse = 1.0 / np.maximum(depth, _NEAR)
        self.image = image = Y[:2] * inverse
        np.multiply(inverse, -1.0, out=self._sideways)
        np.multiply(image, inverse, out=self._forward)
        # (v, -u), whose products with u and v are the other turns.
        np.multiply(image[::-1], _SIGNS, out=self._roll)
        np.multiply(self._roll[:, np.newaxis], image, out=self._tilt)
        self._middle += _SIGNS
        error = np.subtract(image, self._rays, out=self._error)
        error = error * error
        self.squared = error[0] + error[1]

    def show(self, lens: Array | None = None) -> None:
        """Write the rows of the lens, by default at zero, after ``project``."""
        rows, shown = self.rows, self.image
        bent = (shown[0] * shown[0] + shown[1] * shown[1]) * shown
        if lens is not None:
            # d shown = zoom ((1 + k r^2) d image + 2 k image (image . d image)).
            pose, image, k = rows[:ERROR], self.image, lens[2]
            zoom, along = np.exp(lens[:2])[:, np.newaxis], (pose * image).sum(axis=1)
            r2 = (image * image).sum(axis=0)
            pose[:] = zoom * ((1.0 + k * r2) * pose + 2.0 * k * image * along[:, np.newaxis])
            shown, bent = zoom * (1.0 + k * r2) * image, zoom * bent
            rows[ERROR] = shown - self._rays
            self.squared = np.square(rows[ERROR]).sum(axis=0)
        rows[7, 0], rows[8, 1], rows[9] = shown[0], shown[1], bent

    def normal_equations(self, factor: float, lens: bool, newton: bool) -> tuple[Array, ...]:
        """Return the weighted products of all rows, (7, 7) or with those of the lens (10, 10).

        These are the second derivatives of the loss with the squared scales enlarged by a factor,
        and its first ones in the error's column. For ``newton`` there are two: with all second
        derivatives, and without those of the weights.
        """
        rows = self.rows if lens else self.rows[: ERROR + 1]
        weight = (NU + 2.0) / (factor * self.spread + self.squared)
        weight *= self.ahead
        weighted = rows * weight
        products = weighted.reshape(len(rows), -1) @ rows.reshape(len(rows), -1).T
        if not newton:
            return (products,)
        # The weights fall with the error: second term of the Hessian.
        along = weighted * self._error
        pull = along[:, 0] + along[:, 1]
        pull[ERROR] = 0.0
        return products - (2.0 / (NU + 2.0) * pull) @ pull.T, products

    def relative(self) -> Array:
        """Return the squared errors in units of the squared scales, (n,)."""
        return np.where(self.ahead, self.squared * (NU / self.spread), _BEHIND)
