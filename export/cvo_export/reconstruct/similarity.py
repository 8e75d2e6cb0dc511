"""Similarity transformations of the world: scale, rotation and translation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry

Array = NDArray[np.float64]


class Similarity(NamedTuple):
    """``x -> scale R x + translation``; ``rotation`` is R as qx qy qz qw."""

    scale: float
    rotation: Array
    translation: Array

    def points(self, points: Array) -> Array:
        """Transform points (n, 3)."""
        turned = points @ geometry.quaternion_to_matrix(self.rotation).T
        return np.asarray(self.scale * turned + self.translation)

    def poses(self, poses: Array) -> Array:
        """Transform poses ``T_world_camera`` (n, 7)."""
        turned = geometry.quaternion_multiply(self.rotation, poses[:, 3:])
        return np.concatenate([self.points(poses[:, :3]), geometry.quaternion_normalise(turned)], 1)


def between_points(source: Array, target: Array) -> Similarity:
    """Return the least squares similarity from points (n, 3) to points (n, 3) (Umeyama 1991).

    It needs three points that do not lie on a line.
    """
    centre, aim = source.mean(axis=0), target.mean(axis=0)
    covariance = (target - aim).T @ (source - centre)
    R = geometry.nearest_rotation(covariance)
    scale = float(np.sum(R * covariance) / np.sum((source - centre) ** 2))
    return Similarity(scale, geometry.matrix_to_quaternion(R), aim - scale * R @ centre)


def between_poses(source: Array, target: Array) -> Similarity:
    """Return the similarity from poses (n, 7) to poses (n, 7), for two or more.

    The orientations give the rotation, which two positions alone leave open; the positions give
    scale and translation by least squares.
    """
    turns = geometry.quaternion_multiply(
        target[:, 3:], geometry.quaternion_conjugate(source[:, 3:])
    )
    rotation = geometry.mean_rotation(turns)
    turned = source[:, :3] @ geometry.quaternion_to_matrix(rotation).T
    centre, aim = turned.mean(axis=0), target[:, :3].mean(axis=0)
    inner = np.sum((turned - centre) * (target[:, :3] - aim))
    scale = float(inner / np.sum((turned - centre) ** 2))
    return Similarity(scale, rotation, aim - scale * centre)
