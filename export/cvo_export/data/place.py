"""A place to learn: its sparse map, and what each cell of a training image should say of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.camera import Camera, cell_centres
from cvo_export.data.sparse_map import SparseMap

Array = NDArray[np.float64]
Targets = NDArray[np.float32]

# Columns of a cell's targets: ray x y; rotation R_world_camera, row by row; position; logarithm of
# the prior depth; weight of that prior; whether the cell shows a part of the original image.
RAY, ROTATION, POSITION = slice(0, 2), slice(2, 11), slice(11, 14)
LOG_DEPTH, DEPTH_WEIGHT, SHOWN = 14, 15, 16
COLUMNS = 17

# The prior's depth is a mean of the points about a cell, with a Gaussian weight of this deviation;
# its weight falls with the distance to the nearest point to this least weight. In cells.
_SMOOTHING, _REACH = 0.75, 1.0
_LEAST_WEIGHT = 0.05
# Points nearer than this share of the typical depth are wrong.
_NEAR = 0.02


@dataclass(frozen=True)
class Place:
    """What the training images of one camera show, for networks that predict cell by cell.

    Attributes
    ----------
    map
        Points of the place, observed by the training images.
    camera
        The camera whose images are the model's inputs.
    grid
        Rows and columns of cells.
    zooms
        Focal length of each augmented copy as a multiple of the camera's; the first copy, the
        unchanged images, has 1.
    """

    map: SparseMap
    camera: Camera
    grid: tuple[int, int]
    zooms: Sequence[float]

    @property
    def rays(self) -> Array:
        """Rays (cells, 2) of the camera through the cell centres."""
        return self.camera.rays(self._centres)

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels of the model's input."""
        return self.camera.focal_px

    @property
    def typical_depth(self) -> float:
        """Median depth of the observed points, metres."""
        return self.map.depth

    @property
    def _centres(self) -> Array:
        return cell_centres(self.camera.height, self.camera.width, self.grid)

    def targets(self, poses: Array) -> Targets:
        """Poses of all copies (copies, n, 7) -> targets (copies, n, cells, 17)."""
        count = self.grid[0] * self.grid[1]
        found = np.zeros((*poses.shape[:2], count, COLUMNS), np.float32)
        seen = [self.map.seen_by(row) for row in range(poses.shape[1])]
        for copy, zoom in enumerate(self.zooms):
            camera = self.camera.zoomed(zoom)
            rays = camera.rays(self._centres)
            for row, pose in enumerate(poses[copy]):
                cells = found[copy, row]
                R = geometry.quaternion_to_matrix(pose[3:])
                cells[:, RAY] = np.nan_to_num(rays)
                cells[:, ROTATION], cells[:, POSITION] = R.ravel(), pose[:3]
                R_original = geometry.quaternion_to_matrix(poses[0, row, 3:])
                cells[:, SHOWN] = _shown(rays, self.camera, R, R_original)
                self._set_depth(cells, camera, (seen[row] - pose[:3]) @ R)
        return found

    def _set_depth(self, cells: Targets, camera: Camera, points: Array) -> None:
        """Set the prior of the depth from observed points (n, 3) in the camera frame."""
        cells[:, LOG_DEPTH] = np.log(self.typical_depth)
        cells[:, DEPTH_WEIGHT] = _LEAST_WEIGHT
        points = points[points[:, 2] > _NEAR * self.typical_depth]
        if not len(points):
            return
        size = camera.width / self.grid[1], camera.height / self.grid[0]
        offset = (self._centres[:, np.newaxis] - camera.project(points)) / size
        squared = np.square(offset).sum(axis=2)
        # Relative to the nearest point, so that a cell far from all of them uses that one.
        nearest = squared.min(axis=1)
        weight = np.exp((nearest[:, np.newaxis] - squared) / (2.0 * _SMOOTHING**2))
        cells[:, LOG_DEPTH] = weight @ np.log(points[:, 2]) / weight.sum(axis=1)
        cells[:, DEPTH_WEIGHT] += np.exp(-nearest / (2.0 * _REACH**2))


def _shown(rays: Array, original: Camera, R: Array, R_original: Array) -> NDArray[np.bool_]:
    """Whether rays (cells, 2) of a turned camera meet the original image."""
    ahead = np.column_stack([rays, np.ones(len(rays))]) @ (R.T @ R_original)
    valid = np.isfinite(ahead).all(axis=1) & (ahead[:, 2] > 1e-3)
    ahead[~valid] = 1.0
    x, y = original.project(ahead).T
    inside = (x > -0.5) & (x < original.width - 0.5) & (y > -0.5) & (y < original.height - 0.5)
    return np.asarray(valid & inside)
