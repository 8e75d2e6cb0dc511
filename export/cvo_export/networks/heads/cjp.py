"""Conformalized joint prediction: one variational network for the pose and both bounds.

The paper's Fig. 3b and Eq. 4 to 6: pooled features -> encoder -> latent Gaussian -> decoder ->
point m and bounds Q_l, Q_h of all six degrees of freedom, trained with one loss.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, NamedTuple, cast

import numpy as np
import torch
from msgspec import Meta, Struct
from numpy.typing import NDArray
from scipy.stats import norm, qmc
from torch import Tensor, nn
from torch.nn.functional import softplus

from cvo_edge.heads import Candidate
from cvo_edge.heads.cjp import CjpParameters
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
from cvo_export.networks.losses import (
    CombinedCalibrationLoss,
    Gate,
    IntervalForm,
    interval_score_loss,
    kl_divergence,
)
from cvo_export.networks.standardised import PoseDecoder, Target

Array = NDArray[np.float64]
Latent = Literal["mean", "codebook", "sample"]
Bounds = Literal["softplus", "free"]

_CODEBOOK_SIZE = 16


class CjpConfig(Struct, frozen=True, tag="cjp", tag_field="method", forbid_unknown_fields=True):
    """Options of the network and its loss; see ``cvo_export.networks.losses`` for the variants.

    The paper uses latent_size 3, latent sample, point_loss squared, gate literal and interval_form
    mean.
    """

    latent_size: Annotated[
        int, Meta(ge=1, le=4096, description="Dimension of the latent Gaussian; the paper uses 3.")
    ] = 16
    latent: Annotated[
        Latent,
        Meta(
            description="Latent that inference uses: the mean, the average over a "
            "codebook of 16, or a seeded sample (the paper)."
        ),
    ] = "mean"
    bounds: Annotated[
        Bounds,
        Meta(
            description="softplus: distances from the point, which never cross; free: three free "
            "outputs, sorted."
        ),
    ] = "softplus"
    hidden: Hidden = (256, 128)
    sharpness: Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="Lambda of the combined calibration loss: 0 calibration, 1 sharpness.",
        ),
    ] = 0.5
    point_loss: Annotated[
        Literal["absolute", "squared"],
        Meta(description="Loss of the point; the paper uses squared."),
    ] = "absolute"
    gate: Annotated[
        Gate,
        Meta(
            description="Coverage that gates the calibration loss: each bound's own (corrected) "
            "or the interval's (literal, Eq. 5a)."
        ),
    ] = "corrected"
    interval_form: Annotated[
        IntervalForm,
        Meta(description="Penalty in the interval score; the paper uses mean."),
    ] = "proper"
    kl_weight: Annotated[
        float,
        Meta(ge=0, description="Weight of the divergence from the standard Gaussian (beta)."),
    ] = 1e-3
    feature_noise: FeatureNoise = 0.1
    dropout: Annotated[
        float, Meta(ge=0, lt=1, description="Dropout after the hidden layers during training.")
    ] = 0.0
    members: Annotated[
        int,
        Meta(
            ge=1,
            le=64,
            description="Networks with different initial weights; point and bounds are averaged.",
        ),
    ] = 1


class CjpPrediction(NamedTuple):
    """Standardised point and bounds, and the latent Gaussian (n, latent_size).

    The point has the numbers of the target (n, 6) or (n, 9). Bounds (n, 6) are standardised
    coordinates, or offsets from the point if the target turns.
    """

    point: Tensor
    lower: Tensor
    upper: Tensor
    mu: Tensor
    log_variance: Tensor


class CjpMember(nn.Module):
    """One variational network: standardised features (n, size) -> CjpPrediction."""

    def __init__(self, size: int, config: CjpConfig, outputs: int) -> None:
        super().__init__()
        self.free = config.bounds == "free"
        self.sizes = [outputs, 2 * DOF]
        wide, narrow = config.hidden
        self.encoder = nn.Sequential(
            *dense(size, wide, config.dropout), *dense(wide, narrow, config.dropout)
        )
        self.mu = nn.Linear(narrow, config.latent_size)
        self.log_variance = nn.Linear(narrow, config.latent_size)
        self.decoder = nn.Sequential(
            *dense(config.latent_size, narrow, config.dropout),
            *dense(narrow, wide, config.dropout),
            nn.Linear(wide, sum(self.sizes)),
        )

    def encode(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Features (n, size) -> mean and log variance of the latent, (n, latent_size) each."""
        hidden = self.encoder(x)
        # Clamp to +-10: early steps go further, where the variance under- or overflows in float32.
        return self.mu(hidden), self.log_variance(hidden).clamp(-10.0, 10.0)

    def decode(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Latent (n, latent_size) -> point, lower, upper, standardised."""
        point, sides = self.decoder(z).split(self.sizes, dim=1)
        # One node of the exported graph for both sides: a node takes microseconds.
        a, b = (sides if self.free else softplus(sides)).split(DOF, dim=1)
        if self.free:
            return point, torch.minimum(a, b), torch.maximum(a, b)
        # A point of nine numbers has no sides: bounds are offsets from it.
        centre = point if point.shape == a.shape else torch.zeros_like(a)
        return point, centre - a, centre + b

    def forward(self, x: Tensor, noise: Tensor | None = None) -> CjpPrediction:
        """Features (n, size), latent noise (n, latent_size); without noise, uses the mean."""
        mu, log_variance = self.encode(x)
        z = mu if noise is None else mu + noise * torch.exp(0.5 * log_variance)
        return CjpPrediction(*self.decode(z), mu, log_variance)


class CjpNetwork(nn.Module):
    """Features (n, size) -> standardised point, lower, upper, averaged over the members.

    ``outputs``: numbers of the point, see ``CjpPrediction``.
    """

    def __init__(self, size: int, config: CjpConfig, outputs: int) -> None:
        super().__init__()
        self.config = config
        self.standardise = Standardise(size, config.feature_noise)
        self.members = nn.ModuleList(
            CjpMember(size, config, outputs) for _ in range(config.members)
        )
        self.register_buffer("codebook", _codebook(config.latent_size))
        self.codebook: Tensor

    def forward(
        self, features: Tensor, noise: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Predict from features (n, size), with the latent that inference uses.

        noise (n, latent_size) is used in ``sample`` mode only and shared by all members.
        """
        x = self.standardise(features)
        found = [self._drawn(cast("CjpMember", member), x, noise) for member in self.members]
        if len(found) == 1:
            return found[0]
        point, lower, upper = (
            torch.stack(values).mean(dim=0) for values in zip(*found, strict=True)
        )
        return point, lower, upper

    def samples(self, features: Tensor) -> CjpPrediction:
        """Features (n, size) -> predictions of all members, concatenated to (members * n, ...).

        For training: the latent is sampled, and each member draws its own noise.
        """
        found = []
        for member in self.members:
            noise = torch.randn(len(features), self.config.latent_size)
            found.append(member(self.standardise(features), noise))
        return CjpPrediction(*(torch.cat(values) for values in zip(*found, strict=True)))

    def _drawn(
        self, member: CjpMember, x: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        if self.config.latent != "codebook":
            point, lower, upper, _, _ = member(x, noise)
            return point, lower, upper
        mu, log_variance = member.encode(x)
        spread = torch.exp(0.5 * log_variance)
        z = mu[:, None, :] + self.codebook * spread[:, None, :]
        decoded = member.decode(z.flatten(0, 1))
        point, lower, upper = (
            values.reshape(-1, _CODEBOOK_SIZE, values.shape[1]).mean(dim=1) for values in decoded
        )
        return point, lower, upper


class CjpLearner(Learner):
    """The network with the loss of Eq. 6: point + beta KL + INTSCORE + COMCAL, standardised."""

    def __init__(self, size: int, config: CjpConfig, target: Target) -> None:
        super().__init__()
        self.config = config
        self.decoder = PoseDecoder(target)
        self.network = CjpNetwork(size, config, target.size)
        self.standardise = self.network.standardise
        self.combined_calibration = CombinedCalibrationLoss(DOF, config.sharpness, config.gate)

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Features (n, size), truth (n, k) -> scalar; warm-up omits the calibration term."""
        prediction = self.network.samples(features)
        return self.of_prediction(prediction, y.repeat(self.config.members, 1), warm_up)

    def of_prediction(self, prediction: CjpPrediction, y: Tensor, warm_up: bool) -> Tensor:
        """Prediction and truth (n, k) -> scalar."""
        point, lower, upper, mu, log_variance = prediction
        error = point - y
        bounded = self._bounded(point, y)
        loss = (
            (error.abs() if self.config.point_loss == "absolute" else error.square()).mean()
            + self.config.kl_weight * kl_divergence(mu, log_variance)
            + interval_score_loss(lower, upper, bounded, self.config.interval_form)
        )
        # Update running coverages during warm-up: they gate the calibration term afterwards.
        combined = self.combined_calibration(lower, upper, bounded)
        return loss if warm_up else loss + combined

    def val_score(self, features: Tensor, y: Array) -> float:
        """See ``Learner``; scores the network's own bounds with the additive score."""
        point, lower, upper = self.network(features)
        bounded = self._bounded(point, torch.from_numpy(y).float()).double().numpy()
        return conformalised_score(lower.double().numpy(), upper.double().numpy(), bounded)

    def _bounded(self, point: Tensor, y: Tensor) -> Tensor:
        """Return what the bounds (n, 6) are about: the truth, or its offset from the point."""
        return self.decoder.errors(point, y) if self.decoder.turns else y


class CjpHead(ExportedHead):
    """Features -> pose (n, 7), lower and upper (n, 6); noise is an input in ``sample`` mode."""

    output_names = ("pose", "lower", "upper")
    runtime_method = "cjp"

    def __init__(self, network: CjpNetwork, setting: Setting) -> None:
        super().__init__()
        self.network = network
        self.decoder = PoseDecoder(setting.target)
        if setting.target.turns:
            self.rotation = "tangent_predicted"
        config = network.config
        if config.latent == "sample":
            self.extra_inputs = {"latent_noise": torch.zeros((1, config.latent_size))}
        self._method_parameters = CjpParameters(
            half_width_floor=half_width_floor(setting.target),
            latent=config.latent,
            latent_size=config.latent_size,
            noise_seed=setting.seed,
        )

    def forward(
        self, features: Tensor, noise: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return pose, lower and upper in metres and radians."""
        return self.decoder.interval(*self.network(features, noise))

    def candidates(self) -> tuple[Candidate, ...]:
        """Put the normalised score first: its factors transfer to harder or easier recordings."""
        return interval_candidates(self._method_parameters)


def _train(lessons: Lessons, config: CjpConfig) -> CjpHead:
    setting = lessons.setting
    learner = lessons.learn("cjp", lambda: CjpLearner(setting.feature_size, config, setting.target))
    return CjpHead(learner.network, setting)


def _restore(setting: Setting, config: CjpConfig, state: Mapping[str, Tensor]) -> CjpHead:
    network = CjpNetwork(setting.feature_size, config, setting.target.size)
    head = CjpHead(network, setting)
    head.load_state_dict(state)
    return head


METHOD = Method(CjpConfig, _train, _restore, turns=True)


def _codebook(latent_size: int) -> Tensor:
    """Fixed standard-normal points (16, latent_size) from a scrambled Sobol sequence."""
    points = qmc.Sobol(latent_size, seed=0).random(_CODEBOOK_SIZE)
    return torch.tensor(norm.ppf(points), dtype=torch.float32)
