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
from cvo_export.networks.losses import (
    CombinedCalibrationLoss,
    Gate,
    IntervalForm,
    interval_score_loss,
    kl_divergence,
)
from cvo_export.networks.standardised import PoseDecoder

Array = NDArray[np.float64]
Latent = Literal["mean", "codebook", "sample"]
Bounds = Literal["softplus", "free"]

_CODEBOOK_SIZE = 16


class CjpConfig(Struct, frozen=True, tag="cjp", tag_field="method", forbid_unknown_fields=True):
    """The choices of method and loss.

    The paper's are latent_size 3, latent sample, point_loss squared, gate literal and interval_form
    mean.

    Attributes
    ----------
    latent_size
        Dimension of the latent Gaussian; 3 is a bottleneck for six degrees of freedom.
    latent
        What inference draws: its ``mean``, the average over a fixed ``codebook`` of 16, or a
        seeded ``sample``.
    bounds
        ``softplus``: distances below and above the point, so that they never cross; ``free``:
        three free outputs, sorted.
    hidden
        Widths of the encoder's two layers, mirrored in the decoder.
    sharpness
        lambda of the combined calibration loss, 0 (calibration) to 1 (sharpness).
    point_loss
        Of the point: ``absolute``, as a few frames far off would pull a mean away from the middle
        of the interval, or ``squared``.
    gate, interval_form
        Variants of the loss, see ``cvo_export.networks.losses``.
    kl_weight
        beta of the divergence from the standard Gaussian.
    feature_noise
        Standard deviation of Gaussian noise on the standardised features while training.
    dropout
        Dropout behind the encoder's and decoder's layers while training.
    members
        Networks that began differently, trained beside each other; point and bounds are their mean.
    """

    latent_size: Annotated[int, Meta(ge=1, le=4096)] = 16
    latent: Latent = "mean"
    bounds: Bounds = "softplus"
    hidden: tuple[int, int] = (256, 128)
    sharpness: Annotated[float, Meta(ge=0, le=1)] = 0.5
    point_loss: Literal["absolute", "squared"] = "absolute"
    gate: Gate = "corrected"
    interval_form: IntervalForm = "proper"
    kl_weight: Annotated[float, Meta(ge=0)] = 1e-3
    feature_noise: Annotated[float, Meta(ge=0)] = 0.1
    dropout: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    members: Annotated[int, Meta(ge=1, le=64)] = 1


class CjpPrediction(NamedTuple):
    """Standardised point and bounds (n, 6), and the latent Gaussian (n, latent_size)."""

    point: Tensor
    lower: Tensor
    upper: Tensor
    mu: Tensor
    log_variance: Tensor


class CjpMember(nn.Module):
    """One variational network: standardised features (n, size) -> CjpPrediction."""

    def __init__(self, size: int, config: CjpConfig) -> None:
        super().__init__()
        self.free = config.bounds == "free"
        wide, narrow = config.hidden
        self.encoder = nn.Sequential(
            *dense(size, wide, config.dropout), *dense(wide, narrow, config.dropout)
        )
        self.mu = nn.Linear(narrow, config.latent_size)
        self.log_variance = nn.Linear(narrow, config.latent_size)
        self.decoder = nn.Sequential(
            *dense(config.latent_size, narrow, config.dropout),
            *dense(narrow, wide, config.dropout),
            nn.Linear(wide, 3 * DOF),
        )

    def encode(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Features (n, size) -> mean and log variance of the latent, (n, latent_size) each."""
        hidden = self.encoder(x)
        # Beyond +-10 a variance is zero or infinite in float32; early steps do go there.
        return self.mu(hidden), self.log_variance(hidden).clamp(-10.0, 10.0)

    def decode(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Latent (n, latent_size) -> point, lower, upper (n, 6), standardised."""
        point, a, b = self.decoder(z).split(DOF, dim=1)
        if self.free:
            return point, torch.minimum(a, b), torch.maximum(a, b)
        return point, point - softplus(a), point + softplus(b)

    def forward(self, x: Tensor, noise: Tensor | None = None) -> CjpPrediction:
        """Features (n, size), latent noise (n, latent_size) or None for the latent's mean."""
        mu, log_variance = self.encode(x)
        z = mu if noise is None else mu + noise * torch.exp(0.5 * log_variance)
        return CjpPrediction(*self.decode(z), mu, log_variance)


class CjpNetwork(nn.Module):
    """Features (n, size) -> point, lower, upper (n, 6), standardised: the mean of the members'."""

    def __init__(self, size: int, config: CjpConfig) -> None:
        super().__init__()
        self.config = config
        self.standardise = Standardise(size, config.feature_noise)
        self.members = nn.ModuleList(CjpMember(size, config) for _ in range(config.members))
        self.register_buffer("codebook", _codebook(config.latent_size))
        self.codebook: Tensor

    def forward(
        self, features: Tensor, noise: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Features (n, size), as inference draws the latent.

        noise (n, latent_size) in ``sample`` mode only, the same for all members.
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
        """Features (n, size) -> each member's (members * n, ...), one after the other.

        For training: the latent is sampled, and each member draws noise of its own.
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
            values.reshape(-1, _CODEBOOK_SIZE, DOF).mean(dim=1) for values in decoded
        )
        return point, lower, upper


class CjpLearner(Learner):
    """The network with Eq. 6: point + beta KL + INTSCORE + COMCAL, on standardised numbers."""

    def __init__(self, size: int, config: CjpConfig) -> None:
        super().__init__()
        self.config = config
        self.network = CjpNetwork(size, config)
        self.standardise = self.network.standardise
        self.combined_calibration = CombinedCalibrationLoss(DOF, config.sharpness, config.gate)

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Features (n, size), truth (n, 6) -> scalar; in warm-up without the calibration term."""
        prediction = self.network.samples(features)
        return self.of_prediction(prediction, y.repeat(self.config.members, 1), warm_up)

    def of_prediction(self, prediction: CjpPrediction, y: Tensor, warm_up: bool) -> Tensor:
        """Prediction and truth (n, 6) -> scalar."""
        point, lower, upper, mu, log_variance = prediction
        error = point - y
        loss = (
            (error.abs() if self.config.point_loss == "absolute" else error.square()).mean()
            + self.config.kl_weight * kl_divergence(mu, log_variance)
            + interval_score_loss(lower, upper, y, self.config.interval_form)
        )
        # Running coverages must see the warm-up, too: they gate what comes after it.
        combined = self.combined_calibration(lower, upper, y)
        return loss if warm_up else loss + combined

    def val_score(self, features: Tensor, y: Array) -> float:
        """As ``Learner``; of the network's own bounds with the additive score."""
        _, lower, upper = self.network(features)
        return conformalised_score(lower.double().numpy(), upper.double().numpy(), y)


class CjpHead(ExportedHead):
    """Features -> pose (n, 7), lower and upper (n, 6); noise is an input in ``sample`` mode."""

    output_names = ("pose", "lower", "upper")
    runtime_method = "cjp"

    def __init__(self, network: CjpNetwork, setting: Setting) -> None:
        super().__init__()
        self.network = network
        self.decoder = PoseDecoder(setting.target)
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
        point, lower, upper = (self.decoder(values) for values in self.network(features, noise))
        return self.decoder.pose(point), lower, upper

    def candidates(self) -> tuple[Candidate, ...]:
        """Normalised before additive: factors carry over to harder or easier recordings."""
        return interval_candidates(self._method_parameters)


def _train(lessons: Lessons, config: CjpConfig) -> CjpHead:
    setting = lessons.setting
    learner = lessons.learn("cjp", lambda: CjpLearner(setting.feature_size, config))
    return CjpHead(learner.network, setting)


def _restore(setting: Setting, config: CjpConfig, state: Mapping[str, Tensor]) -> CjpHead:
    head = CjpHead(CjpNetwork(setting.feature_size, config), setting)
    head.load_state_dict(state)
    return head


METHOD = Method(CjpConfig, _train, _restore)


def _codebook(latent_size: int) -> Tensor:
    """Fixed standard-normal points (16, latent_size) from a scrambled Sobol sequence."""
    points = qmc.Sobol(latent_size, seed=0).random(_CODEBOOK_SIZE)
    return torch.tensor(norm.ppf(points), dtype=torch.float32)
