"""The network's target: a pose as six standardised numbers, and the inverse in the graph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cvo_edge import geometry
from cvo_edge.errors import UsageError
from cvo_edge.pose import Chart
from cvo_export.bundles.draft import MAX_SPREAD_RAD

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Target:
    """Standardised degrees of freedom: tx ty tz and Log(R_reference^T R), over train and fit.

    ``reference_q_xyzw`` (4,); ``mean`` and ``std`` (6,) in metres and radians.
    """

    reference_q_xyzw: Array
    mean: Array
    std: Array

    @property
    def chart(self) -> Chart:
        """The chart of the coordinates that are standardised."""
        return Chart("tangent_reference", self.reference_q_xyzw)

    def coordinates(self, poses: Array) -> Array:
        """Poses (..., 7) -> coordinates (..., 6), m and rad."""
        return self.chart.coordinates(poses, poses)

    def standardised(self, poses: Array) -> Array:
        """Poses (..., 7) -> numbers (..., 6) with mean 0 and deviation 1 over train and fit."""
        return (self.coordinates(poses) - self.mean) / self.std


def fit_target(poses: Array) -> Target:
    """Compute mean rotation, mean and deviation of training poses (n, 7).

    Raises UsageError if rotations spread too far for one tangent chart or a DoF never changes.
    """
    reference = geometry.mean_rotation(poses[:, 3:])
    coordinates = Chart("tangent_reference", reference).coordinates(poses, poses)
    spread = float(np.linalg.norm(coordinates[:, 3:], axis=1).max())
    if spread > MAX_SPREAD_RAD:
        raise UsageError(
            f"poses: expected rotations within {MAX_SPREAD_RAD:g} rad of their mean, found one at "
            f"{spread:.2f} rad; one tangent chart cannot represent a full turn"
        )
    deviation = coordinates.std(axis=0)
    if not (deviation > 1e-6).all():
        raise UsageError(
            "poses: expected motion in every degree of freedom, found standard deviations "
            f"{deviation.tolist()}"
        )
    return Target(reference, coordinates.mean(axis=0), deviation)


class PoseDecoder(nn.Module):
    """Standardised numbers -> coordinates in metres and radians, and poses."""

    def __init__(self, target: Target) -> None:
        super().__init__()
        for name, values in (
            ("mean", target.mean),
            ("std", target.std),
            ("left", _left_product(target.reference_q_xyzw)),
        ):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32))
        self.mean: Tensor
        self.std: Tensor
        self.left: Tensor

    def forward(self, standardised: Tensor) -> Tensor:
        """Standardised (n, 6) -> coordinates (n, 6), m and rad."""
        return standardised * self.std + self.mean

    def pose(self, coordinates: Tensor) -> Tensor:
        """Coordinates (n, 6) -> poses (n, 7): R = R_reference Exp(r), as quaternions."""
        q_xyzw = _exp(coordinates[:, 3:]) @ self.left.T
        return torch.cat([coordinates[:, :3], q_xyzw], dim=1)


def _exp(rotvec: Tensor) -> Tensor:
    """Rotation vectors (n, 3) -> quaternions (n, 4); 1e-12 keeps the quotient at zero finite."""
    angle = (rotvec.square().sum(dim=1, keepdim=True) + 1e-12).sqrt()
    return torch.cat([rotvec * (torch.sin(0.5 * angle) / angle), torch.cos(0.5 * angle)], dim=1)


def _left_product(q_xyzw: Array) -> Array:
    """Matrix L (4, 4) with L p = q p, the Hamilton product from the left."""
    return geometry.quaternion_multiply(q_xyzw, np.eye(4)).T
