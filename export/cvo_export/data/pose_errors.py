"""Errors of estimated poses, and of the mean pose, which any useful network must beat."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry

Array = NDArray[np.float64]

# Below this, a camera stands still, and no error is large in comparison.
_LEAST_M, _LEAST_DEG = 1e-3, 1e-2


class MedianError(NamedTuple):
    """Median error of some frames, in metres and degrees."""

    position_m: float
    rotation_deg: float

    def __str__(self) -> str:
        """Return e.g. ``0.0412 m 1.2 deg``."""
        return f"{self.position_m:.3g} m {self.rotation_deg:.3g} deg"

    def shares(self, of: MedianError) -> tuple[float, float]:
        """Return position and rotation error as multiples of another's."""
        return (
            self.position_m / max(of.position_m, _LEAST_M),
            self.rotation_deg / max(of.rotation_deg, _LEAST_DEG),
        )


def pose_errors(poses: Array, true_poses: Array) -> tuple[Array, Array]:
    """Return the position errors (n,) in metres and the rotation errors (n,) in degrees.

    Poses and true poses (n, 7) have unit quaternions.
    """
    distance = np.linalg.norm(poses[:, :3] - true_poses[:, :3], axis=1)
    difference = geometry.quaternion_multiply(
        geometry.quaternion_conjugate(poses[:, 3:]), true_poses[:, 3:]
    )
    angle = np.rad2deg(np.linalg.norm(geometry.quaternion_log(difference), axis=1))
    return distance, angle


def median_error(poses: Array, true_poses: Array) -> MedianError:
    """Return the median errors of poses (n, 7); a pose with NaN counts as infinitely wrong."""
    distance, angle = (np.nan_to_num(each, nan=np.inf) for each in pose_errors(poses, true_poses))
    return MedianError(float(np.median(distance)), float(np.median(angle)))


def mean_pose_error(true_poses: Array) -> MedianError:
    """Return the error of a network that always answers with the mean of these poses (n, 7)."""
    mean = np.concatenate(
        [true_poses[:, :3].mean(axis=0), geometry.mean_rotation(true_poses[:, 3:])]
    )
    return median_error(np.tile(mean, (len(true_poses), 1)), true_poses)
