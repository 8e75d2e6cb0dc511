"""Multivariate conformalized quantile regression: a region for the residual of a point network.

The paper's section IV-A. A point network gives the pose. From its compressed features and that pose
(the condition c) an autoencoder with directional quantiles
(``cvo_export.networks.directional``) gives a
region of its residual

    e = (t - t_hat, Log(R_hat^T R))

as a codebook of points, one static graph. Residuals come from frames that their network has not
seen, as in CQR. The paper multiplies them by MC-dropout: stochastic passes of the point network,
each with its own residual (``augmentation``).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
import torch
from msgspec import Meta, Struct
from numpy.typing import NDArray
from torch import Tensor

from cvo_edge.heads import Candidate
from cvo_edge.heads.mcqr import McqrParameters
from cvo_export.networks.directional import (
    KAPPAS,
    Choice,
    RegionConfig,
    RegionNetwork,
    mean_volume,
    thrifty_choice,
)
from cvo_export.networks.heads.base import (
    DOF,
    Examples,
    ExportedHead,
    Learner,
    Lessons,
    Method,
    Setting,
    Standardise,
    half_width_floor,
    interval_candidates,
)
from cvo_export.networks.heads.point import (
    PointNetwork,
    Residuals,
    check_components,
    compressed,
    deviation_of,
    learn_held_out,
    principal_components,
    residuals_of,
)
from cvo_export.networks.standardised import PoseDecoder

Array = NDArray[np.float64]

# What early stopping looks at: one inflation, and few draws for the volume.
_USUAL_KAPPA = 0.8
_FEW_DRAWS = 100
# Training rows that show which points of the codebook are of use.
_USAGE_ROWS = 4000
_DROPOUT, _PASSES = 0.05, 20


class McqrConfig(Struct, frozen=True, tag="mcqr", tag_field="method", forbid_unknown_fields=True):
    """The choices of the region and of its point network.

    The paper's are augmentation predictions and scale constant.

    Attributes
    ----------
    augmentation
        What MC-dropout passes of the point network add to the region's training data: with
        ``predictions`` each pass is a point of its own, with its own condition and residual; with
        ``labels`` the condition stays that of the deterministic point; ``none``: no passes.
    passes
        Stochastic passes of each frame; None: 20.
    dropout
        Behind the point network's last hidden layer; None: 0.05 where there are passes, else 0.
    components
        Principal components of the features in the condition, beside the point's six numbers.
    scale
        ``local``: the codebook's unit is a matrix that the condition decides; ``constant``: the
        spread of all residuals.
    kappa
        Inflation of the learned region; None lets val choose.
    directions, rays
        Directions whose quantiles are learned; rays of the codebook, with three points each.
    tau
        Level of the directional quantiles.
    kl_weight
        beta of the autoencoder.
    condition_noise
        Standard deviation of Gaussian noise on the standardised condition while training.
    residuals
        ``cross_fitted``, ``held_out``, or ``auto``: cross-fitted below 1500 training frames.
    hidden, feature_noise
        Of the point network, as in CQR.
    """

    augmentation: Literal["none", "predictions", "labels"] = "none"
    passes: Annotated[int, Meta(ge=1, le=1000)] | None = None
    dropout: Annotated[float, Meta(ge=0, lt=1)] | None = None
    components: Annotated[int, Meta(ge=0, le=4096)] = 16
    scale: Literal["local", "constant"] = "local"
    kappa: Annotated[float, Meta(gt=0)] | None = None
    directions: Annotated[int, Meta(ge=8, le=4096)] = 128
    rays: Annotated[int, Meta(ge=1, le=192)] = 128
    tau: Annotated[float, Meta(gt=0, lt=0.5)] = 0.05
    kl_weight: Annotated[float, Meta(ge=0)] = 0.01
    condition_noise: Annotated[float, Meta(ge=0)] = 0.05
    residuals: Residuals = "auto"
    hidden: tuple[int, int] = (256, 128)
    feature_noise: Annotated[float, Meta(ge=0)] = 0.1

    def __post_init__(self) -> None:
        """Refuse passes that are all the same, and their number where there are none."""
        if self.augmentation == "none" and self.passes is not None:
            raise ValueError(
                f"passes: expected with the augmentation predictions or labels, found "
                f"{self.passes} with none"
            )
        if self.augmentation != "none" and self.dropout == 0.0:
            raise ValueError(
                f"dropout: expected more than 0 for the passes of {self.augmentation}, found 0"
            )

    @property
    def point_dropout(self) -> float:
        """Dropout of the point network."""
        if self.dropout is not None:
            return self.dropout
        return 0.0 if self.augmentation == "none" else _DROPOUT


class RegionLearner(Learner):
    """The region's networks on scaled residuals, given the condition."""

    def __init__(self, config: McqrConfig) -> None:
        super().__init__()
        condition = config.components + DOF
        self.standardise = Standardise(condition, config.condition_noise)
        self.network = RegionNetwork(
            RegionConfig(
                response=DOF,
                condition=condition,
                directions=config.directions,
                rays=config.rays,
                tau=config.tau,
                kl_weight=config.kl_weight,
                local_scale=config.scale == "local",
            )
        )

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Condition (n, components + 6), scaled residual (n, 6) -> scalar."""
        return self.network.loss(self.standardise(features), y)

    def val_score(self, features: Tensor, y: Array) -> float:
        """Mean volume of the region at 90 %, to the power 1/6; the radius is taken on these frames.

        Condition (n, components + 6) and scaled residuals (n, 6).
        """
        usual = Choice(_USUAL_KAPPA, np.arange(len(self.network.shells)))
        return mean_volume(self.network, self.standardise(features), y, usual, _FEW_DRAWS)


class McqrHead(ExportedHead):
    """Features -> pose (n, 7), codebook (n, J, 6) and scale (n, 6, 6), in metres and radians.

    Both in the chart about the prediction: codebook points are (t_hat, 0) + e.
    """

    output_names = ("pose", "codebook", "scale")
    runtime_method = "mcqr"
    rotation = "tangent_predicted"

    def __init__(
        self,
        point: PointNetwork,
        components: Tensor,
        learner: RegionLearner,
        unit: Tensor,
        kappa: Tensor,
        points: Tensor,
        setting: Setting,
    ) -> None:
        super().__init__()
        self.point = point
        self.decoder = PoseDecoder(setting.target)
        self.standardise = learner.standardise
        self.region = learner.network
        for name, values in (
            ("components", components),
            ("unit", unit),
            ("kappa", kappa),
            ("points", points),
        ):
            self.register_buffer(name, values)
        # Of the predicted position alone: a prediction's own rotation numbers are zero.
        self.register_buffer("origin", torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
        self.components: Tensor
        self.unit: Tensor
        self.kappa: Tensor
        self.points: Tensor
        self.origin: Tensor
        self._method_parameters = McqrParameters(
            points=len(self.region.shells), half_width_floor=half_width_floor(setting.target)
        )

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return pose, codebook and scale."""
        point = self.point(features)
        small = self.point.standardise(features) @ self.components
        c = self.standardise(torch.cat([small, point], dim=1))
        coordinates = self.decoder(point)
        scale = self.unit[:, None] * self.region.scale(c)
        codebook = self.region.codebook(c, self.kappa) @ scale.transpose(1, 2)
        codebook = codebook + (coordinates * self.origin)[:, None]
        return self.decoder.pose(coordinates), codebook, scale

    def candidates(self) -> tuple[Candidate, ...]:
        """As for CQR; of the six intervals alone."""
        return interval_candidates(self._method_parameters)

    def choices(self) -> Mapping[str, float]:
        """Inflation of the region, and how many points of its codebook stayed."""
        return {"kappa": float(self.kappa), "points": len(self.points)}


def _train(lessons: Lessons, config: McqrConfig) -> McqrHead:
    check_components(lessons, config.components)
    setting, passes = lessons.setting, config.augmentation != "none"
    held_out = learn_held_out(
        lessons,
        "mcqr",
        config.residuals,
        config.hidden,
        config.feature_noise,
        config.point_dropout,
    )
    network, rows = held_out.network, held_out.rows
    features, poses = lessons.features()
    components = principal_components(network, features[0], config.components)
    small = compressed(network, features[:, rows], components)
    known = point = held_out.points(features)
    poses = poses[:, rows]
    if passes:
        count = config.passes or _PASSES
        point = held_out.passes(features, count, setting.seed)
        poses, small = np.tile(poses, (count, 1, 1)), np.tile(small, (count, 1, 1))
        known = point if config.augmentation == "predictions" else np.tile(known, (count, 1, 1))
    residual = residuals_of(setting, point, poses)
    unit = deviation_of(residual)
    val_features, val_poses = lessons.val()
    with torch.no_grad():
        val_point = network(val_features)
        val_small = network.standardise(val_features) @ components
    val_residual = residuals_of(setting, val_point.double().numpy(), val_poses)
    examples = Examples(
        np.concatenate([small, known.astype(np.float32)], axis=2),
        residual / unit,
        torch.cat([val_small, val_point], dim=1),
        val_residual / unit,
    )
    learner = lessons.learn("mcqr-region", lambda: RegionLearner(config), examples=examples)
    choice = _choice(learner, examples, config, setting.seed)
    points = torch.from_numpy(choice.points)
    learner.network.keep(points)
    return McqrHead(
        network,
        components,
        learner,
        torch.from_numpy(unit).float(),
        torch.tensor(choice.kappa),
        points,
        setting,
    )


def _choice(learner: RegionLearner, examples: Examples, config: McqrConfig, seed: int) -> Choice:
    """Return inflation and points of the codebook, on val and a sample of the training rows."""
    generator = np.random.default_rng(seed)
    copy = generator.integers(len(examples.x), size=_USAGE_ROWS)
    row = generator.integers(examples.x.shape[1], size=_USAGE_ROWS)
    with torch.no_grad():
        c = learner.standardise(torch.from_numpy(examples.x[copy, row]).float())
        val_c = learner.standardise(examples.val_x)
    kappas = KAPPAS if config.kappa is None else (config.kappa,)
    train, val = (c, examples.y[copy, row]), (val_c, examples.val_y)
    return thrifty_choice(learner.network, train, val, kappas)


def _restore(setting: Setting, config: McqrConfig, state: Mapping[str, Tensor]) -> McqrHead:
    point = PointNetwork(
        setting.feature_size, config.hidden, config.feature_noise, config.point_dropout
    )
    learner = RegionLearner(config)
    learner.network.keep(state["points"])
    head = McqrHead(
        point,
        state["components"],
        learner,
        state["unit"],
        state["kappa"],
        state["points"],
        setting,
    )
    head.load_state_dict(state)
    return head


METHOD = Method(McqrConfig, _train, _restore)
