"""The network's target: a pose as standardised numbers, and the inverse in the graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cvo_edge import geometry
from cvo_edge.bundle.format import StillDof
from cvo_edge.pose import Chart
from cvo_export.datasets.motion import MAX_SPREAD_RAD, deviation_floor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Target:
    """Standardised numbers of a pose, with mean 0 and deviation 1 over train and fit.

    The numbers are tx ty tz and Log(R_reference^T R), six in all. Where rotations spread too far
    about their mean for one tangent chart (``turns``), they are tx ty tz and the first two columns
    of R_reference^T R, nine in all: the six-dimensional representation of Zhou et al. 2019, section
    4.2, which is continuous over all rotations.

    ``reference_q_xyzw`` (4,); ``mean`` and ``std`` (6,) or (9,); ``deviation`` (6,), the unit of
    each degree of freedom in metres and radians: the deviation of the poses, or a floor for those
    that stand ``still`` (6,).
    """

    reference_q_xyzw: Array
    mean: Array
    std: Array
    deviation: Array
    still: NDArray[np.bool_]

    def arrays(self) -> list[NDArray[Any]]:
        """Return the numbers that ``of_arrays`` restores."""
        return [self.reference_q_xyzw, self.mean, self.std, self.deviation, self.still]

    @classmethod
    def of_arrays(cls, values: Sequence[NDArray[Any]]) -> Target:
        """Restore a stored target; runs of earlier releases have no deviation and stand nowhere."""
        reference, mean, std, *rest = values
        deviation, still = rest or (std, np.zeros(std.shape, np.bool_))
        return cls(reference, mean, std, deviation, still)

    @property
    def turns(self) -> bool:
        """Whether rotations spread too far about their mean for one tangent chart."""
        return self.mean.size > self.deviation.size

    @property
    def still_dof(self) -> tuple[StillDof, ...]:
        """Names of the degrees of freedom that stand still."""
        return tuple(
            name for name, rests in zip(get_args(StillDof), self.still, strict=True) if rests
        )

    @property
    def size(self) -> int:
        """Number of standardised numbers, 6 or 9."""
        return int(self.mean.size)

    @cached_property
    def chart(self) -> Chart:
        """The tangent chart at the mean rotation; it breaks at half a turn from there."""
        return Chart("tangent_reference", self.reference_q_xyzw)

    def coordinates(self, poses: Array) -> Array:
        """Poses (..., 7) -> coordinates (..., 6), m and rad."""
        return self.chart.coordinates(poses, poses)

    def standardised(self, poses: Array) -> Array:
        """Poses (..., 7) -> standardised numbers (..., 6) or (..., 9)."""
        return (self._numbers(poses) - self.mean) / self.std

    def _numbers(self, poses: Array) -> Array:
        if not self.turns:
            return self.coordinates(poses)
        return np.concatenate(
            [poses[..., :3], _columns(poses[..., 3:], self.reference_q_xyzw)], axis=-1
        )


def fit_target(poses: Array, every: Array | None = None) -> Target:
    """Fit the standardised numbers to training poses (n, 7).

    ``every`` has the poses (m, 7) of all frames, by default those of training: if any of them turns
    further than 2 rad from the mean rotation, the target is that for any rotation, because frames
    of other roles would reach the place where the chart breaks. The decision treats the frames of
    ``cal`` and ``test`` alike, so that they stay exchangeable.
    """
    reference = geometry.mean_rotation(poses[:, 3:])
    chart = Chart("tangent_reference", reference)
    coordinates = chart.coordinates(poses, poses)
    judged = coordinates if every is None else chart.coordinates(every, every)
    spread = float(np.linalg.norm(judged[:, 3:], axis=1).max())
    deviation = coordinates.std(axis=0)
    floor = deviation_floor(deviation)
    still = deviation < floor
    deviation = np.maximum(deviation, floor)
    if spread <= MAX_SPREAD_RAD:
        return Target(reference, coordinates.mean(axis=0), deviation, deviation, still)
    columns = _columns(poses[:, 3:], reference)
    # One scale for all six numbers keeps their geometry, which the decoder relies on.
    scale = np.full(6, float(np.sqrt(columns.var(axis=0).mean())))
    return Target(
        reference,
        np.concatenate([coordinates[:, :3].mean(axis=0), columns.mean(axis=0)]),
        np.concatenate([deviation[:3], scale]),
        deviation,
        still,
    )


def _columns(q_xyzw: Array, reference_q_xyzw: Array) -> Array:
    """Quaternions (..., 4) -> the first two columns of R_reference^T R, (..., 6)."""
    inverse = geometry.quaternion_conjugate(reference_q_xyzw)
    R = geometry.quaternion_to_matrix(geometry.quaternion_multiply(inverse, q_xyzw))
    return np.concatenate([R[..., 0], R[..., 1]], axis=-1)


class PoseDecoder(nn.Module):
    """Standardised numbers -> metres and radians, poses, and errors about a prediction."""

    def __init__(self, target: Target) -> None:
        super().__init__()
        self.turns = target.turns
        for name, values in (
            ("mean", target.mean),
            ("std", target.std),
            ("left", _left_product(target.reference_q_xyzw)),
        ):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32))
        deviation = torch.tensor(target.deviation, dtype=torch.float32)
        # Not among the stored numbers, which earlier runs have without it.
        self.register_buffer("deviation", deviation, persistent=False)
        self.mean: Tensor
        self.std: Tensor
        self.deviation: Tensor
        self.left: Tensor

    def forward(self, standardised: Tensor) -> Tensor:
        """Standardised (n, 6) or (n, 9) -> the same numbers in metres and radians."""
        return standardised * self.std + self.mean

    def pose(self, numbers: Tensor) -> Tensor:
        """Numbers (n, 6) or (n, 9) in metres and radians -> poses (n, 7)."""
        return torch.cat([numbers[:, :3], self._rotation(numbers) @ self.left.T], dim=1)

    def errors(self, point: Tensor, y: Tensor) -> Tensor:
        """Standardised points and truths -> errors (n, 6) in units of the deviation.

        The rotation's error is Log(R_predicted^T R) for a target that turns, and the difference of
        the coordinates otherwise.
        """
        if not self.turns:
            return y - point
        predicted, true = self._rotation(self(point)), self._rotation(self(y))
        angle = _log(_product(_conjugate(predicted), true))
        return torch.cat([(y - point)[:, :3], angle / self.deviation[3:]], dim=1)

    def interval(
        self, point: Tensor, lower: Tensor, upper: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Standardised point and bounds -> pose (n, 7), lower and upper (n, 6), m and rad.

        For a target that turns, bounds are offsets (n, 6) from the point in units of the
        deviation, and the result is in the tangent chart at the prediction.
        """
        pose = self.pose(self(point))
        if not self.turns:
            return pose, self(lower), self(upper)
        return pose, self._about(pose, lower), self._about(pose, upper)

    def _about(self, pose: Tensor, offsets: Tensor) -> Tensor:
        offsets = offsets * self.deviation
        return torch.cat([pose[:, :3] + offsets[:, :3], offsets[:, 3:]], dim=1)

    def _rotation(self, numbers: Tensor) -> Tensor:
        """Numbers (n, 6) or (n, 9) -> quaternions (n, 4) of R_reference^T R."""
        if self.turns:
            return _quaternion(_orthonormal(numbers[:, 3:6], numbers[:, 6:]))
        return _exp(numbers[:, 3:])


def _orthonormal(a: Tensor, b: Tensor) -> Tensor:
    """Two vectors (n, 3) -> rotation matrices (n, 3, 3) by Gram-Schmidt, as columns.

    Zhou et al. 2019, appendix B. 1e-12 keeps vectors of length zero finite.
    """
    x = _unit(a)
    y = _unit(b - (x * b).sum(dim=1, keepdim=True) * x)
    z = torch.stack(
        [
            x[:, 1] * y[:, 2] - x[:, 2] * y[:, 1],
            x[:, 2] * y[:, 0] - x[:, 0] * y[:, 2],
            x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0],
        ],
        dim=1,
    )
    return torch.stack([x, y, z], dim=2)


def _unit(vector: Tensor) -> Tensor:
    return vector / (vector.square().sum(dim=1, keepdim=True) + 1e-12).sqrt()


def _quaternion(R: Tensor) -> Tensor:
    """Rotation matrices (n, 3, 3) -> unit quaternions (n, 4), x y z w.

    Four times the outer product of the quaternion with itself is linear in R; its row with the
    largest diagonal is the quaternion, up to its length, without a division by a small number.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(dim=1) for row in R.unbind(dim=1))
    rows = torch.stack(
        [
            torch.stack([1 + a - e - i, b + d, c + g, h - f], dim=1),
            torch.stack([b + d, 1 - a + e - i, f + h, c - g], dim=1),
            torch.stack([c + g, f + h, 1 - a - e + i, d - b], dim=1),
            torch.stack([h - f, c - g, d - b, 1 + a + e + i], dim=1),
        ],
        dim=1,
    )
    largest = rows.diagonal(dim1=1, dim2=2).argmax(dim=1)
    return _unit(rows.gather(1, largest[:, None, None].expand(-1, 1, 4))[:, 0])


def _exp(rotvec: Tensor) -> Tensor:
    """Rotation vectors (n, 3) -> quaternions (n, 4); 1e-12 keeps the quotient at zero finite."""
    angle = (rotvec.square().sum(dim=1, keepdim=True) + 1e-12).sqrt()
    return torch.cat([rotvec * (torch.sin(0.5 * angle) / angle), torch.cos(0.5 * angle)], dim=1)


def _log(q_xyzw: Tensor) -> Tensor:
    """Quaternions (n, 4) -> rotation vectors (n, 3) of at most half a turn."""
    q = q_xyzw * torch.where(q_xyzw[:, 3:] < 0.0, -1.0, 1.0)
    sine = (q[:, :3].square().sum(dim=1, keepdim=True) + 1e-12).sqrt()
    return q[:, :3] * (2.0 * torch.atan2(sine, q[:, 3:]) / sine)


def _conjugate(q_xyzw: Tensor) -> Tensor:
    return torch.cat([-q_xyzw[:, :3], q_xyzw[:, 3:]], dim=1)


def _product(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton product of quaternions (n, 4)."""
    a, b = p[:, :3], q[:, :3]
    vector = p[:, 3:] * b + q[:, 3:] * a + torch.linalg.cross(a, b)
    return torch.cat([vector, p[:, 3:] * q[:, 3:] - (a * b).sum(dim=1, keepdim=True)], dim=1)


def _left_product(q_xyzw: Array) -> Array:
    """Matrix L (4, 4) with L p = q p, the Hamilton product from the left."""
    return geometry.quaternion_multiply(q_xyzw, np.eye(4)).T
