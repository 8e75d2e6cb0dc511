"""A heteroscedastic Gaussian: the network predicts mean and variance per degree of freedom.

Trained by the negative log likelihood (Nix and Weigend 1994; the aleatoric part of Kendall and Gal
2017).
"""

from __future__ import annotations

from torch import Tensor

from cvo_export.networks.baselines.base import (
    IntervalNetwork,
    TrunkConfig,
    gaussian_interval,
    gaussian_loss,
    interval_method,
    moments,
    trunk,
)
from cvo_export.networks.heads.base import DOF, Setting


class GaussianConfig(
    TrunkConfig, frozen=True, tag="gaussian", tag_field="method", forbid_unknown_fields=True
):
    """Options of the network."""


class GaussianNetwork(IntervalNetwork):
    """The trunk with a mean and a log variance per degree of freedom."""

    def __init__(self, setting: Setting, config: GaussianConfig) -> None:
        super().__init__(setting.feature_size, config)
        self.layers = trunk(setting.feature_size, config, 2 * DOF)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See ``IntervalNetwork``."""
        mean, log_variance = self.moments(features)
        return gaussian_interval(mean, (0.5 * log_variance).exp())

    def moments(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Features (n, size) -> mean and log variance (n, 6)."""
        return moments(self.layers(self.standardise(features)))

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Return the negative log likelihood up to a constant; features (n, size), truth (n, 6)."""
        return gaussian_loss(*self.moments(features), y)


METHOD = interval_method(GaussianConfig, GaussianNetwork)
