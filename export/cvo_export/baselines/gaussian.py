"""A heteroscedastic Gaussian: the network gives mean and variance of each degree of freedom.

Trained by the negative log likelihood (Nix and Weigend 1994; the aleatoric part of Kendall and Gal
2017), each term weighted by the variance to the power beta (Seitzer et al. 2022), which keeps
frames that are hard at first from being given up.
"""

from __future__ import annotations

from typing import Annotated

import torch
from msgspec import Meta
from torch import Tensor

from cvo_export.baselines.base import (
    IntervalNetwork,
    TrunkConfig,
    gaussian_interval,
    interval_method,
    trunk,
)
from cvo_export.heads.base import DOF, Setting


class GaussianConfig(
    TrunkConfig, frozen=True, tag="gaussian", tag_field="method", forbid_unknown_fields=True
):
    """The choices of network and loss.

    Attributes
    ----------
    beta
        Power of the variance that weights the likelihood; 0 is the plain likelihood.
    """

    beta: Annotated[float, Meta(ge=0, le=1)] = 0.0


class GaussianNetwork(IntervalNetwork):
    """The trunk with a mean and a log variance for each degree of freedom."""

    def __init__(self, setting: Setting, config: GaussianConfig) -> None:
        super().__init__(setting.feature_size, config)
        self.beta = config.beta
        self.layers = trunk(setting.feature_size, config, 2 * DOF)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As ``IntervalNetwork``."""
        mean, log_variance = self.moments(features)
        return gaussian_interval(mean, torch.exp(0.5 * log_variance))

    def moments(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Features (n, size) -> mean and log variance (n, 6)."""
        mean, log_variance = self.layers(self.standardise(features)).split(DOF, dim=1)
        # Beyond +-10 a variance is zero or infinite in float32; early steps do go there.
        return mean, log_variance.clamp(-10.0, 10.0)

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Negative log likelihood up to a constant, weighted; features (n, size), truth (n, 6)."""
        mean, log_variance = self.moments(features)
        terms = 0.5 * (log_variance + (y - mean).square() * torch.exp(-log_variance))
        return (terms * torch.exp(self.beta * log_variance.detach())).mean()


METHOD = interval_method(GaussianConfig, GaussianNetwork)
