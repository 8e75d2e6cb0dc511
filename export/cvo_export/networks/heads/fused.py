"""Scene coordinates and a regressed pose from one backbone, fused in the runtime.

After scene coordinate regression has been trained (``cvo_export.networks.heads.scr``), the network
of conformalized joint prediction learns the pose from the same last map, averaged to a coarse grid.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cvo_edge.heads import Candidate
from cvo_edge.heads.fused import FusedParameters
from cvo_export.networks.backbone import Pooled
from cvo_export.networks.heads.base import (
    Examples,
    ExportedHead,
    Lessons,
    Method,
    Schedule,
    Setting,
)
from cvo_export.networks.heads.cjp import CjpConfig, CjpLearner, CjpNetwork
from cvo_export.networks.heads.scr import METHOD as SCR
from cvo_export.networks.heads.scr import (
    DeployedScr,
    ScrConfig,
    ScrHead,
    restored_scr,
    trained_scr,
)
from cvo_export.networks.standardised import PoseDecoder
from cvo_export.networks.stem import Upper

Array = NDArray[np.float64]

_REGRESSION = CjpConfig()
_REGRESSION_STEPS = 6000


class FusedConfig(ScrConfig, frozen=True, tag="fused", tag_field="method"):
    """Options of the cells' network; the regression has CJP's defaults."""


class FusedHead(ExportedHead):
    """Map of the stem -> the outputs of SCR, regression (n, 7) and half_width (n, 6)."""

    output_names = ("coordinates", "log_scale_px", "regression", "half_width")
    point_outputs = ScrHead.point_outputs
    runtime_method = "fused"
    rotation = "tangent_predicted"

    def __init__(self, scr: ScrHead, regression: CjpNetwork, setting: Setting) -> None:
        super().__init__()
        self.scr, self.regression = scr, regression
        self.pooled = Pooled(scr.upper.shape)
        self.decoder = PoseDecoder(setting.target)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return coordinates, log scales, regressed pose and half-widths, m and rad."""
        upper = self.scr.upper
        deep = upper.deep(features)
        points, log_scale = self.scr.network(upper.cells(features, deep))
        return points, log_scale, *self.regressed(deep)

    def deployed(self) -> nn.Module:
        """As ``ExportedHead``."""
        return _DeployedFused(self)

    def regressed(self, deep: Tensor) -> tuple[Tensor, Tensor]:
        """Map of the last stage -> pose (n, 7) and half-widths (n, 6)."""
        pose, lower, upper = self.decoder.interval(*self.regression(self.pooled(deep)))
        return pose, 0.5 * (upper - lower)

    def candidates(self) -> tuple[Candidate, ...]:
        """Return the only score."""
        alone = self.scr.candidates()[0].parameters
        fields = {name: getattr(alone, name) for name in alone.__struct_fields__}
        parameters = FusedParameters(**fields, fusion=None, disagreement_limit=None)
        return (Candidate("normalised", parameters),)


class _DeployedFused(nn.Module):
    def __init__(self, head: FusedHead) -> None:
        super().__init__()
        self.scr, self.head = DeployedScr(head.scr), head

    def forward(self, stem_map: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        points, log_scale, deep = self.scr(stem_map)
        return points, log_scale, *self.head.regressed(deep), deep


def _train(lessons: Lessons, config: FusedConfig) -> FusedHead:
    scr = trained_scr(lessons, config)
    place, target = lessons.place(), lessons.setting.target
    pooled = Pooled(scr.upper.shape)
    maps, poses = lessons.features()
    val_maps, val_poses = lessons.val()
    # The regression learns one focal length.
    own = np.flatnonzero(np.equal(place.zooms, 1.0))
    features = np.stack([_features(scr.upper, pooled, maps[copy]) for copy in own])
    learner = lessons.learn(
        "cjp",
        lambda: CjpLearner(pooled.size, _REGRESSION, target),
        examples=Examples(
            features,
            target.standardised(poses[own]),
            torch.from_numpy(_features(scr.upper, pooled, val_maps.numpy())).float(),
            target.standardised(val_poses),
        ),
        schedule=Schedule(_REGRESSION_STEPS, 64, 1e-3),
        candidate=False,
    )
    return FusedHead(scr, learner.network, lessons.setting)


def _features(upper: Upper, pooled: Pooled, maps: NDArray[Any]) -> NDArray[np.float16]:
    """Maps of the stem (n, ...) -> pooled features of the last map (n, size)."""
    with torch.no_grad():
        parts = torch.split(torch.from_numpy(maps), 64)
        return torch.cat([pooled(upper.deep(part.float())).half() for part in parts]).numpy()


def _restore(setting: Setting, config: FusedConfig, state: Mapping[str, Tensor]) -> FusedHead:
    own = {name.removeprefix("scr."): v for name, v in state.items() if name.startswith("scr.")}
    scr = restored_scr(setting, config, own)
    size = Pooled(scr.upper.shape).size
    head = FusedHead(scr, CjpNetwork(size, _REGRESSION, setting.target.size), setting)
    head.load_state_dict(state)
    return head


METHOD = Method(
    FusedConfig,
    _train,
    _restore,
    cells=True,
    size=SCR.size,
    copies=SCR.copies,
    steps=SCR.steps,
    augment=SCR.augment,
    turns=True,
)
