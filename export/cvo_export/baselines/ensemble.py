"""A deep ensemble: the spread of five point networks that began differently.

After Lakshminarayanan, Pritzel and Blundell 2017: each member is trained on all the data from an
initialisation of its own, and their answers are taken as a Gaussian. Theirs have variances of their
own, too; here the interval is of the spread alone. The members share the batches of one lesson, but
not the noise on the features.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cvo_export.baselines.base import (
    IntervalNetwork,
    TrunkConfig,
    interval_method,
    interval_of_spread,
    trunk,
)
from cvo_export.heads.base import Setting

MEMBERS = 5


class EnsembleConfig(
    TrunkConfig, frozen=True, tag="ensemble", tag_field="method", forbid_unknown_fields=True
):
    """The choices of the members."""


class EnsembleNetwork(IntervalNetwork):
    """Five trunks on the same features."""

    def __init__(self, setting: Setting, config: EnsembleConfig) -> None:
        super().__init__(setting.feature_size, config)
        self.members = nn.ModuleList(trunk(setting.feature_size, config) for _ in range(MEMBERS))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As ``IntervalNetwork``."""
        return interval_of_spread(self.points(features))

    def points(self, features: Tensor) -> Tensor:
        """Features (n, size) -> the members' points (n, 5, 6)."""
        # Each call draws noise of its own while training.
        found = [member(self.standardise(features)) for member in self.members]
        return torch.stack(found, dim=1)

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Mean absolute error of the members, as of the point network."""
        return (self.points(features) - y[:, None]).abs().mean()


METHOD = interval_method(EnsembleConfig, EnsembleNetwork)
