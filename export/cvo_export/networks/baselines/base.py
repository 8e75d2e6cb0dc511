"""Shared code of the baselines: a network that predicts a point and its own 90 % interval.

Baselines define no score. The graph outputs ``pose``, ``lower`` and ``upper``, and the runtime's
conformalized quantile regression (``cvo_edge.heads.cqr``) makes the bounds valid with the split
conformal correction of Romano, Patterson and Candes 2019.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from statistics import NormalDist
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from torch import Tensor, nn

from cvo_edge.heads import Candidate
from cvo_edge.heads.cqr import CqrParameters
from cvo_export.networks.heads.base import (
    DOF,
    ExportedHead,
    Learner,
    Lessons,
    Method,
    Setting,
    Standardise,
    conformalised_score,
    dense,
    half_width_floor,
    interval_candidates,
)
from cvo_export.networks.heads.point import FeatureNoise, Hidden
from cvo_export.networks.losses import HIGH
from cvo_export.networks.standardised import PoseDecoder

Array = NDArray[np.float64]

# 90 % of a Gaussian lies within 1.645 standard deviations of its mean.
Z = NormalDist().inv_cdf(HIGH)


class TrunkConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """Options shared by all baselines."""

    hidden: Hidden = (256, 128)
    feature_noise: FeatureNoise = 0.1


class IntervalNetwork(Learner):
    """Features (n, size) -> standardised point, lower and upper (n, 6); defines its loss."""

    def __init__(self, size: int, config: TrunkConfig) -> None:
        super().__init__()
        self.standardise = Standardise(size, config.feature_noise)

    @abstractmethod
    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features (n, size) -> point, lower, upper (n, 6)."""

    def val_score(self, features: Tensor, y: Array) -> float:
        """See ``Learner``; scores the network's own bounds with the additive score."""
        _, lower, upper = self(features)
        return conformalised_score(lower.double().numpy(), upper.double().numpy(), y)


class IntervalHead(ExportedHead):
    """Features -> pose (n, 7), lower and upper (n, 6) in metres and radians."""

    output_names = ("pose", "lower", "upper")
    runtime_method = "cqr"

    def __init__(self, network: IntervalNetwork, setting: Setting) -> None:
        super().__init__()
        self.network = network
        self.decoder = PoseDecoder(setting.target)
        self._method_parameters = interval_parameters(setting)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return pose, lower and upper."""
        return self.decoder.interval(*self.network(features))

    def candidates(self) -> tuple[Candidate, ...]:
        """Put the normalised score first: its factors transfer to harder or easier recordings."""
        return interval_candidates(self._method_parameters)


def interval_method(
    config: type[TrunkConfig], build: Callable[[Setting, Any], IntervalNetwork]
) -> Method:
    """Return a method that trains the network made by ``build`` in one lesson."""

    def train(lessons: Lessons, chosen: TrunkConfig) -> IntervalHead:
        setting = lessons.setting
        name = str(config.__struct_config__.tag)
        return IntervalHead(lessons.learn(name, lambda: build(setting, chosen)), setting)

    def restore(setting: Setting, chosen: TrunkConfig, state: Mapping[str, Tensor]) -> IntervalHead:
        head = IntervalHead(build(setting, chosen), setting)
        head.load_state_dict(state)
        return head

    return Method(config, train, restore)


def interval_parameters(setting: Setting) -> CqrParameters:
    """Return the ``method_parameters`` that every baseline's bundle stores."""
    return CqrParameters(half_width_floor=half_width_floor(setting.target), sides="symmetric")


def trunk(
    size: int, config: TrunkConfig, outputs: int = DOF, dropout: float = 0.0
) -> nn.Sequential:
    """Return the layers from standardised features (n, size) to (n, outputs)."""
    wide, narrow = config.hidden
    return nn.Sequential(
        *dense(size, wide, dropout), *dense(wide, narrow, dropout), nn.Linear(narrow, outputs)
    )


def gaussian_interval(mean: Tensor, deviation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and standard deviation (n, 6) -> point, lower, upper (n, 6)."""
    return mean, mean - Z * deviation, mean + Z * deviation


def moments(outputs: Tensor) -> tuple[Tensor, Tensor]:
    """Split trunk outputs (..., 12) into mean and log variance (..., 6)."""
    mean, log_variance = outputs[..., :DOF], outputs[..., DOF:]
    # Clamp to +-10: early steps go further, where the variance under- or overflows in float32.
    return mean, log_variance.clamp(-10.0, 10.0)


def gaussian_loss(mean: Tensor, log_variance: Tensor, y: Tensor) -> Tensor:
    """Return the mean negative log likelihood, up to a constant; shapes (..., 6)."""
    terms = 0.5 * (log_variance + (y - mean).square() * (-log_variance).exp())
    return terms.mean()
