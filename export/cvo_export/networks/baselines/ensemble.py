"""A deep ensemble: five Gaussian networks that began differently.

Lakshminarayanan, Pritzel and Blundell 2017: each member gives mean and variance and is trained by
the likelihood on all the data, from an initialisation of its own; their mixture is taken as the
Gaussian of its mean and variance. The members share the batches of one lesson, but not the noise on
the features.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

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

MEMBERS = 5


class EnsembleConfig(
    TrunkConfig, frozen=True, tag="ensemble", tag_field="method", forbid_unknown_fields=True
):
    """Options of the members."""


class EnsembleNetwork(IntervalNetwork):
    """Five trunks on the same features, each with a mean and a log variance."""

    def __init__(self, setting: Setting, config: EnsembleConfig) -> None:
        super().__init__(setting.feature_size, config)
        size = setting.feature_size
        self.members = nn.ModuleList(trunk(size, config, 2 * DOF) for _ in range(MEMBERS))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As ``IntervalNetwork``: mean and variance of the mixture, their section 2.4."""
        means, log_variances = self.moments(features)
        mean = means.mean(dim=1)
        spread = (means - mean[:, None]).square().mean(dim=1)
        return gaussian_interval(mean, (log_variances.exp().mean(dim=1) + spread).sqrt())

    def moments(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Features (n, size) -> the members' means and log variances (n, 5, 6)."""
        # Each call draws noise of its own while training.
        found = [member(self.standardise(features)) for member in self.members]
        return moments(torch.stack(found, dim=1))

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Mean over the members of the negative log likelihood, up to a constant."""
        return gaussian_loss(*self.moments(features), y[:, None])


METHOD = interval_method(EnsembleConfig, EnsembleNetwork)
