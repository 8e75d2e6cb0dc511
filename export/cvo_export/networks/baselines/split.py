"""Plain split conformal prediction on a point network: all frames get intervals of equal width.

After Lei, G'Sell, Rinaldo, Tibshirani and Wasserman 2018: the score is the absolute residual.
"""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from cvo_edge.heads import Candidate
from cvo_export.networks.baselines.base import TrunkConfig, interval_parameters
from cvo_export.networks.heads.base import ExportedHead, Lessons, Method, Setting
from cvo_export.networks.heads.point import PointLearner, PointNetwork
from cvo_export.networks.standardised import PoseDecoder


class SplitConfig(
    TrunkConfig, frozen=True, tag="split", tag_field="method", forbid_unknown_fields=True
):
    """Options of the point network."""


class SplitHead(ExportedHead):
    """Features -> pose (n, 7) only."""

    output_names = ("pose",)
    runtime_method = "cqr"

    def __init__(self, network: PointNetwork, setting: Setting) -> None:
        super().__init__()
        self.network = network
        self.decoder = PoseDecoder(setting.target)
        self._method_parameters = interval_parameters(setting)

    def forward(self, features: Tensor) -> tuple[Tensor]:
        """Return pose in metres."""
        return (self.decoder.pose(self.decoder(self.network(features))),)

    def candidates(self) -> tuple[Candidate, ...]:
        """Return the absolute residual, the only score that needs no bounds."""
        return (Candidate("residual", self._method_parameters),)


def _train(lessons: Lessons, config: SplitConfig) -> SplitHead:
    size = lessons.setting.feature_size
    learner = lessons.learn(
        "split",
        lambda: PointLearner(size, lessons.setting.target, config.hidden, config.feature_noise),
    )
    return SplitHead(learner.network, lessons.setting)


def _restore(setting: Setting, config: SplitConfig, state: Mapping[str, Tensor]) -> SplitHead:
    size = setting.feature_size, setting.target.size
    network = PointNetwork(*size, config.hidden, config.feature_noise)
    head = SplitHead(network, setting)
    head.load_state_dict(state)
    return head


METHOD = Method(SplitConfig, _train, _restore)
