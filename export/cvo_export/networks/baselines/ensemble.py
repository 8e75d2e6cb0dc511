"""A deep ensemble: five Gaussian networks with different initial weights.

Lakshminarayanan, Pritzel and Blundell 2017: each member predicts mean and variance and is trained
by maximum likelihood on all data. The mixture is approximated by a Gaussian with the mixture's mean
and variance. The members share the batches of one lesson, but each draws its own feature noise.
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
        """See ``IntervalNetwork``; mean and variance of the mixture, section 2.4 of the paper."""
        means, log_variances = self.moments(features)
        mean = means.mean(dim=1)
        spread = (means - mean[:, None]).square().mean(dim=1)
        return gaussian_interval(mean, (log_variances.exp().mean(dim=1) + spread).sqrt())

    def moments(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Features (n, size) -> the members' means and log variances (n, 5, 6)."""
        # During training, each call draws new noise.
        found = [member(self.standardise(features)) for member in self.members]
        return moments(torch.stack(found, dim=1))

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Return the members' mean negative log likelihood, up to a constant."""
        return gaussian_loss(*self.moments(features), y[:, None])


METHOD = interval_method(EnsembleConfig, EnsembleNetwork)
