"""Pixels of a camera -> rays, fast enough for every point of every frame."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import Camera

Array = NDArray[np.float64]
Points = NDArray[np.float32]

# OpenCV's iterations stop at these errors, in pixels.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-7)
# Places of an image, apart from each other, at which the lens model is asked for its limits.
_APART_PX = 8
# tan of the angle from the optical axis beyond which a ray has no place in front of the camera.
_WIDEST = 10.0


class Lens:
    """The rays of a camera.

    Attributes
    ----------
    camera
        The camera.
    focal_px
        Pixels per unit of a ray on the optical axis.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.focal_px = camera.focal_px
        self._matrix = camera.matrix
        self._coefficients = np.array(camera.coefficients, np.float64)
        self._valid = None
        if camera.distortion != "none":
            # OpenCV gives some ray for any pixel; those beyond the model's range are wrong.
            x = np.arange(0, camera.width + _APART_PX, _APART_PX)
            y = np.arange(0, camera.height + _APART_PX, _APART_PX)
            nodes = np.stack(np.meshgrid(x, y), axis=-1)
            rays = camera.rays(nodes.reshape(-1, 2)).reshape(nodes.shape)
            size = np.linalg.norm(np.nan_to_num(rays, nan=np.inf), axis=-1)
            self._valid = size < _WIDEST

    def rays(self, pixels: Points) -> Array:
        """Pixels (n, 2) -> rays (3, n) with a third component of 1; NaN outside the lens model."""
        camera = self.camera
        rays = np.ones((3, len(pixels)))
        points = pixels.astype(np.float64)
        if camera.distortion == "none":
            rays[:2] = ((points - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T
            return rays
        if not len(points):
            return rays
        given = points[:, np.newaxis], self._matrix, self._coefficients
        if camera.distortion == "equidistant":
            found = cv2.fisheye.undistortPoints(*given, criteria=_CRITERIA)
        else:
            # OpenCV 4 has another function for it.
            iterate = getattr(cv2, "undistortPointsIter", None)
            if iterate is None:
                found = cv2.undistortPoints(*given, criteria=_CRITERIA)
            else:
                found = iterate(*given, np.eye(3), np.eye(3), _CRITERIA)
        rays[:2] = found[:, 0].T
        if self._valid is not None:
            column, row = np.rint(points / _APART_PX).astype(np.int64).T
            inside = (column >= 0) & (row >= 0)
            inside &= (row < self._valid.shape[0]) & (column < self._valid.shape[1])
            inside[inside] = self._valid[row[inside], column[inside]]
            rays[:, ~inside] = np.nan
        return rays
