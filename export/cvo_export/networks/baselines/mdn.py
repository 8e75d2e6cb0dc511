"""A mixture density network: a mixture of Gaussians per degree of freedom.

After Bishop 1994, trained by the negative log likelihood. The bounds are the mixture's 5 % and
95 % quantiles, found by bisection in the graph.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Annotated

import torch
from msgspec import Meta
from torch import Tensor

from cvo_export.networks.baselines.base import IntervalNetwork, TrunkConfig, interval_method, trunk
from cvo_export.networks.heads.base import DOF, Setting
from cvo_export.networks.losses import HIGH, LOW

# Bisects a bracket of ten standard deviations down to float32 precision.
_BISECTIONS = 24


class MdnConfig(
    TrunkConfig, frozen=True, tag="mdn", tag_field="method", forbid_unknown_fields=True
):
    """Options of the network."""

    components: Annotated[
        int, Meta(ge=1, le=64, description="Gaussians in the mixture of each degree of freedom.")
    ] = 3


class MdnNetwork(IntervalNetwork):
    """The trunk with weights, means and deviations of all six mixtures."""

    def __init__(self, setting: Setting, config: MdnConfig) -> None:
        super().__init__(setting.feature_size, config)
        self.components = config.components
        self.layers = trunk(setting.feature_size, config, 3 * DOF * config.components)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See ``IntervalNetwork``; the point is the mixture's mean."""
        log_weight, mean, log_deviation = self.mixture(features)
        weight, deviation = log_weight.exp(), log_deviation.exp()
        lower, upper = mixture_quantiles(weight, mean, deviation, (LOW, HIGH)).unbind(dim=1)
        return (weight * mean).sum(dim=-1), lower, upper

    def mixture(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features (n, size) -> log weights, means and log deviations (n, 6, components)."""
        outputs = self.layers(self.standardise(features))
        logits, mean, log_deviation = outputs.unflatten(1, (3, DOF, self.components)).unbind(dim=1)
        # Clamp to +-10: early steps go further, where the variance under- or overflows in float32.
        return torch.log_softmax(logits, dim=-1), mean, log_deviation.clamp(-5.0, 5.0)

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Return the negative log likelihood up to a constant; features (n, size), truth (n, 6)."""
        log_weight, mean, log_deviation = self.mixture(features)
        z = (y[..., None] - mean) * torch.exp(-log_deviation)
        return -torch.logsumexp(log_weight - log_deviation - 0.5 * z.square(), dim=-1).mean()


def mixture_quantiles(
    weight: Tensor, mean: Tensor, deviation: Tensor, levels: tuple[float, ...]
) -> Tensor:
    """Compute quantiles (n, levels, dof) of mixtures of Gaussians (n, dof, components).

    A mixture's quantile lies between the smallest and the largest quantile of its components; the
    bisection starts from this bracket.
    """
    weight, mean, deviation = weight[:, None], mean[:, None], deviation[:, None]
    z = torch.tensor([NormalDist().inv_cdf(level) for level in levels]).view(-1, 1, 1)
    ends = mean + z * deviation
    low, high = ends.amin(dim=-1), ends.amax(dim=-1)
    # P(Y < y) = sum w (1 + erf((y - mean)/(sqrt(2) deviation)))/2, compared with the level.
    wanted = 2.0 * torch.tensor(levels).view(-1, 1) - 1.0
    scale = 1.0 / (math.sqrt(2.0) * deviation)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        found = (weight * torch.erf((middle[..., None] - mean) * scale)).sum(dim=-1)
        low = torch.where(found < wanted, middle, low)
        high = torch.where(found < wanted, high, middle)
    return 0.5 * (low + high)


METHOD = interval_method(MdnConfig, MdnNetwork)
