"""Multivariate conformalized quantile regression: a region for a point network's residual.

The paper's section IV-A. A point network predicts the pose. Its compressed features and that pose
form the condition c. From c, an autoencoder with directional quantiles
(``cvo_export.networks.directional``) predicts a region of the residual

    e = (t - t_hat, Log(R_hat^T R))

as a codebook of points, in one static graph. As in CQR, residuals come from frames that their
network has not seen. The paper generates more of them with MC-dropout: stochastic passes of the
point network, each with its own residual (``augmentation``).
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
    COMPONENTS,
    FeatureNoise,
    Hidden,
    PointNetwork,
    Residuals,
    check_components,
    compressed,
    deviation_of,
    learn_held_out,
    principal_components,
    residuals_of,
)
from cvo_export.networks.standardised import PoseDecoder, Target

Array = NDArray[np.float64]

# Early stopping evaluates one inflation and estimates volumes from few draws.
_USUAL_KAPPA = 0.8
_FEW_DRAWS = 100
# Training rows used to find the useful points of the codebook.
_USAGE_ROWS = 4000
_DROPOUT, _PASSES = 0.05, 20


class McqrConfig(Struct, frozen=True, tag="mcqr", tag_field="method", forbid_unknown_fields=True):
    """Options of the region and of its point network.

    The paper uses augmentation predictions and scale constant. With ``predictions``, each
    MC-dropout pass has its own point, condition and residual; with ``labels``, passes keep the
    condition of the deterministic point.
    """

    augmentation: Annotated[
        Literal["none", "predictions", "labels"],
        Meta(description="MC-dropout passes as training data; the paper uses predictions."),
    ] = "none"
    passes: Annotated[
        Annotated[int, Meta(ge=1, le=1000)] | None,
        Meta(description="Stochastic passes per frame; 20 with augmentation."),
    ] = None
    dropout: Annotated[
        Annotated[float, Meta(ge=0, lt=1)] | None,
        Meta(
            description="Dropout after the point network's last hidden layer; if not given, 0.05 "
            "with augmentation, otherwise 0."
        ),
    ] = None
    components: Annotated[int, Meta(ge=0, le=4096, description=COMPONENTS)] = 16
    scale: Annotated[
        Literal["local", "constant"],
        Meta(
            description="Unit of the codebook: a matrix for each condition (local) or the spread "
            "of all residuals (constant, the paper)."
        ),
    ] = "local"
    kappa: Annotated[
        Annotated[float, Meta(ge=0.01)] | None,
        Meta(description="Inflation of the learned region; if not given, val chooses."),
    ] = None
    directions: Annotated[
        int, Meta(ge=8, le=4096, description="Directions whose quantiles are learned.")
    ] = 128
    rays: Annotated[
        int, Meta(ge=1, le=192, description="Rays of the codebook, three points each.")
    ] = 128
    tau: Annotated[float, Meta(gt=0, lt=0.5, description="Level of the directional quantiles.")] = (
        0.05
    )
    kl_weight: Annotated[
        float,
        Meta(ge=0, description="Weight of the divergence from the standard Gaussian (beta)."),
    ] = 0.01
    condition_noise: Annotated[
        float,
        Meta(ge=0, description="Deviation of the noise added to the condition during training."),
    ] = 0.05
    residuals: Residuals = "auto"
    hidden: Hidden = (256, 128)
    feature_noise: FeatureNoise = 0.1

    def __post_init__(self) -> None:
        """Reject augmentation without dropout, and ``passes`` without augmentation."""
        if self.augmentation == "none" and self.passes is not None:
            raise ValueError(
                f"passes: expected only with augmentation predictions or labels, found "
                f"{self.passes} with augmentation none"
            )
        if self.augmentation != "none" and self.dropout == 0.0:
            raise ValueError(
                f"dropout: expected more than 0 with augmentation {self.augmentation}, found 0"
            )

    @property
    def point_dropout(self) -> float:
        """Dropout rate of the point network."""
        if self.dropout is not None:
            return self.dropout
        return 0.0 if self.augmentation == "none" else _DROPOUT


class RegionLearner(Learner):
    """The region's networks, trained on scaled residuals given the condition."""

    def __init__(self, config: McqrConfig, target: Target) -> None:
        super().__init__()
        condition = config.components + target.size
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
        """Condition (n, components + 6 or 9), scaled residual (n, 6) -> scalar."""
        return self.network.loss(self.standardise(features), y)

    def val_score(self, features: Tensor, y: Array) -> float:
        """Return the region's mean volume at 90 %, to the power 1/6, calibrated on these frames.

        Condition (n, components + 6 or 9) and scaled residuals (n, 6).
        """
        usual = Choice(_USUAL_KAPPA, np.arange(len(self.network.shells)))
        return mean_volume(self.network, self.standardise(features), y, usual, _FEW_DRAWS)


class McqrHead(ExportedHead):
    """Features -> pose (n, 7), codebook (n, J, 6) and scale (n, 6, 6), in metres and radians.

    Codebook and scale are in the chart centred at the prediction: points are (t_hat, 0) + e.
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
        # Position only: in its own tangent chart, the prediction's rotation is zero.
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
        pose = self.decoder.pose(self.decoder(point))
        scale = self.unit[:, None] * self.region.scale(c)
        codebook = self.region.codebook(c, self.kappa) @ scale.transpose(1, 2)
        codebook = codebook + (pose[:, :DOF] * self.origin)[:, None]
        return pose, codebook, scale

    def candidates(self) -> tuple[Candidate, ...]:
        """Return the candidates of CQR; they apply to the six marginal intervals only."""
        return interval_candidates(self._method_parameters)

    def choices(self) -> Mapping[str, float]:
        """Return the region's inflation and the number of codebook points kept."""
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
    learner = lessons.learn(
        "mcqr-region",
        lambda: RegionLearner(config, setting.target),
        examples=examples,
        candidate=False,
    )
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
    """Choose inflation and codebook points on val and a sample of the training rows."""
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
    size = setting.feature_size, setting.target.size
    point = PointNetwork(*size, config.hidden, config.feature_noise, config.point_dropout)
    learner = RegionLearner(config, setting.target)
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


METHOD = Method(McqrConfig, _train, _restore, turns=True)
