"""Quantile regression with the pinball loss: one network predicts median, 5 % and 95 % quantiles.

After Koenker and Bassett 1978. The three outputs are sorted so that they never cross
(Chernozhukov, Fernandez-Val and Galichon 2010).
"""

from __future__ import annotations

import torch
from torch import Tensor

from cvo_export.networks.baselines.base import IntervalNetwork, TrunkConfig, interval_method, trunk
from cvo_export.networks.heads.base import DOF, Setting
from cvo_export.networks.losses import HIGH, LOW

_LEVELS = torch.tensor([LOW, 0.5, HIGH]).view(3, 1)


class PinballConfig(
    TrunkConfig, frozen=True, tag="pinball", tag_field="method", forbid_unknown_fields=True
):
    """Options of the network."""


class PinballNetwork(IntervalNetwork):
    """The trunk with three quantiles per degree of freedom."""

    def __init__(self, setting: Setting, config: PinballConfig) -> None:
        super().__init__(setting.feature_size, config)
        self.layers = trunk(setting.feature_size, config, 3 * DOF)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See ``IntervalNetwork``; the point is the median."""
        lower, point, upper = self.quantiles(features).sort(dim=1).values.unbind(dim=1)
        return point, lower, upper

    def quantiles(self, features: Tensor) -> Tensor:
        """Features (n, size) -> the three quantiles before sorting, (n, 3, 6)."""
        found: Tensor = self.layers(self.standardise(features)).unflatten(1, (3, DOF))
        return found

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Return the mean pinball loss of the three quantiles; features (n, size), truth (n, 6)."""
        above = y[:, None] - self.quantiles(features)
        return torch.maximum(_LEVELS * above, (_LEVELS - 1.0) * above).mean()


METHOD = interval_method(PinballConfig, PinballNetwork)
