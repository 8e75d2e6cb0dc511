"""Monte Carlo dropout: the spread of one network's predictions under 30 dropout masks.

After Gal and Ghahramani 2016: dropout stays on at inference, and the interval is that of a Gaussian
with the mean and variance of the passes. The observation variance 1/tau of the paper is not added:
the interval reflects the spread only. The 30 masks are drawn once, from the run's seed, so that an
image always gets the same prediction. The backbone and the first layer run once per frame.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor, nn

from cvo_export.networks.baselines.base import (
    IntervalNetwork,
    TrunkConfig,
    gaussian_interval,
    interval_method,
    trunk,
)
from cvo_export.networks.heads.base import Setting

PASSES = 30


class McDropoutConfig(
    TrunkConfig, frozen=True, tag="mc-dropout", tag_field="method", forbid_unknown_fields=True
):
    """Options of the network."""

    dropout: Annotated[
        float,
        Meta(gt=0, lt=1, description="Share of each hidden layer's outputs that a mask zeroes."),
    ] = 0.01


class McDropoutNetwork(IntervalNetwork):
    """The point network with dropout after both hidden layers, averaged over fixed masks.

    Buffers ``wide_masks`` (30, wide) and ``narrow_masks`` (30, narrow) hold 0 or 1/(1 - rate).
    """

    def __init__(self, setting: Setting, config: McDropoutConfig) -> None:
        super().__init__(setting.feature_size, config)
        self.layers = trunk(setting.feature_size, config, dropout=config.dropout)
        generator = np.random.default_rng(setting.seed)
        for name, width in zip(("wide_masks", "narrow_masks"), config.hidden, strict=True):
            kept = generator.random((PASSES, width)) >= config.dropout
            self.register_buffer(name, torch.from_numpy(kept).float() / (1.0 - config.dropout))
        self.wide_masks: Tensor
        self.narrow_masks: Tensor

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See ``IntervalNetwork``."""
        points = self.passes(features)
        mean = points.mean(dim=1)
        return gaussian_interval(mean, (points - mean[:, None]).square().mean(dim=1).sqrt())

    def passes(self, features: Tensor) -> Tensor:
        """Features (n, size) -> one point per mask, (n, 30, 6)."""
        first, second, last = self._stages()
        wide = first(self.standardise(features))[:, None] * self.wide_masks
        narrow = second(wide.flatten(0, 1)).unflatten(0, (-1, PASSES)) * self.narrow_masks
        points: Tensor = last(narrow.flatten(0, 1)).unflatten(0, (-1, PASSES))
        return points

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Return the point network's mean absolute error, with new masks for each row."""
        error: Tensor = self.layers(self.standardise(features)) - y
        return error.abs().mean()

    def _stages(self) -> tuple[nn.Module, nn.Module, nn.Module]:
        """Return the layers before, between and after the two dropout layers."""
        return self.layers[0:2], self.layers[3:5], self.layers[6]


METHOD = interval_method(McDropoutConfig, McDropoutNetwork)
