"""The point network: features -> one pose, without any uncertainty of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from cvo_export.heads.base import DOF, Learner, Standardise, conformalised_score, dense

Array = NDArray[np.float64]


class PointNetwork(nn.Module):
    """Features (n, size) -> standardised pose (n, 6)."""

    def __init__(self, size: int, hidden: tuple[int, int], feature_noise: float) -> None:
        super().__init__()
        wide, narrow = hidden
        self.standardise = Standardise(size, feature_noise)
        self.layers = nn.Sequential(
            *dense(size, wide), *dense(wide, narrow), nn.Linear(narrow, DOF)
        )

    def forward(self, features: Tensor) -> Tensor:
        """Shape (n, size) -> (n, 6)."""
        point: Tensor = self.layers(self.standardise(features))
        return point


class PointLearner(Learner):
    """The point network with the mean absolute error: the centre of an interval is a median."""

    def __init__(self, size: int, hidden: tuple[int, int], feature_noise: float) -> None:
        super().__init__()
        self.network = PointNetwork(size, hidden, feature_noise)
        self.standardise = self.network.standardise

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Features (n, size), truth (n, 6) -> scalar."""
        error: Tensor = self.network(features) - y
        return error.abs().mean()

    def val_score(self, features: Tensor, y: Array) -> float:
        """As ``Learner``; of intervals of one width about the point."""
        point = self.network(features).double().numpy()
        return conformalised_score(point, point, y)
