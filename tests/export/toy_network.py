"""Training side of a toy method: a linear network whose only output is a pose."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray
from torch import Tensor, nn

from cvo_edge.heads import Candidate
from cvo_export.bundles.draft import six
from cvo_export.networks.heads.base import (
    DOF,
    ExportedHead,
    Learner,
    Lessons,
    Method,
    Setting,
    Standardise,
    conformalised_score,
)
from cvo_export.networks.standardised import PoseDecoder

from .toy_head import ToyParameters


class ToyConfig(Struct, frozen=True, tag="toy", tag_field="method", forbid_unknown_fields=True):
    """The toy's only option."""

    toy_noise: Annotated[
        float, Meta(ge=0, le=10, description="Noise on the features while training.")
    ] = 0.1


class ToyLearner(Learner):
    """One linear layer, trained with the mean absolute error."""

    def __init__(self, size: int, config: ToyConfig) -> None:
        super().__init__()
        self.standardise = Standardise(size, config.toy_noise)
        self.layer = nn.Linear(size, DOF)

    def forward(self, features: Tensor) -> Tensor:
        point: Tensor = self.layer(self.standardise(features))
        return point

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        return (self(features) - y).abs().mean()

    def val_score(self, features: Tensor, y: NDArray[np.float64]) -> float:
        point = self(features).double().numpy()
        return conformalised_score(point, point, y)


class ToyExport(ExportedHead):
    """Maps features to poses (n, 7)."""

    output_names = ("pose",)
    runtime_method = "toy"

    def __init__(self, learner: ToyLearner, setting: Setting) -> None:
        super().__init__()
        self.learner = learner
        self.decoder = PoseDecoder(setting.target)
        self._unit = six(0.1 * setting.target.std)

    def forward(self, features: Tensor) -> tuple[Tensor]:
        return (self.decoder.pose(self.decoder(self.learner(features))),)

    def candidates(self) -> tuple[Candidate, ...]:
        return (Candidate("toy_distance", ToyParameters(unit=self._unit)),)


def _train(lessons: Lessons, config: ToyConfig) -> ToyExport:
    setting = lessons.setting
    learner = lessons.learn("toy", lambda: ToyLearner(setting.feature_size, config))
    return ToyExport(learner, setting)


def _restore(setting: Setting, config: Any, state: Mapping[str, Tensor]) -> ToyExport:
    head = ToyExport(ToyLearner(setting.feature_size, config), setting)
    head.load_state_dict(state)
    return head


METHOD = Method(ToyConfig, _train, _restore)
