"""The point network: features -> one pose, and its residuals on frames it has not seen."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from msgspec import Meta
from numpy.typing import NDArray
from torch import Tensor, nn

from cvo_edge.errors import UsageError
from cvo_edge.pose import Chart
from cvo_export.networks.heads.base import (
    DOF,
    Learner,
    Lessons,
    Setting,
    Standardise,
    conformalised_score,
    dense,
)
from cvo_export.networks.standardised import PoseDecoder, Target

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Residuals = Annotated[
    Literal["auto", "cross_fitted", "held_out"],
    Meta(
        description="Frames that residuals come from: cross_fitted, held_out, or auto: "
        "cross_fitted below 1500 training frames."
    ),
]
# Fields shared by the options of several methods.
COMPONENTS = "Principal components of the features that the model sees besides the point."
Hidden = Annotated[tuple[int, int], Meta(description="Widths of the two hidden layers.")]
FeatureNoise = Annotated[
    float,
    Meta(ge=0, description="Deviation of the noise added to the features during training."),
]

# With fewer training frames, too few remain if some are set aside for the residual models.
_MANY_FRAMES = 1500
_FOLDS = 3
_LEAST_DEVIATION = 1e-6


class PointNetwork(nn.Module):
    """Features (n, size) -> the ``outputs`` standardised numbers of the pose, 6 or 9."""

    def __init__(
        self,
        size: int,
        outputs: int,
        hidden: tuple[int, int],
        feature_noise: float,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        wide, narrow = hidden
        self.outputs, self.dropout = outputs, dropout
        self.standardise = Standardise(size, feature_noise)
        self.layers = nn.Sequential(
            *dense(size, wide), *dense(wide, narrow, dropout), nn.Linear(narrow, outputs)
        )

    def forward(self, features: Tensor) -> Tensor:
        """Shape (n, size) -> (n, outputs)."""
        point: Tensor = self.layers(self.standardise(features))
        return point

    def passes(self, features: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Features (n, size) -> stochastic passes with dropout, (count, n, outputs).

        MC-dropout (Gal and Ghahramani 2016) after the last hidden layer; the layers before it are
        computed once.
        """
        *trunk, last = (layer for layer in self.layers if not isinstance(layer, nn.Dropout))
        hidden = self.standardise(features)
        for layer in trunk:
            hidden = layer(hidden)
        kept = 1.0 - self.dropout
        mask = torch.rand((count, *hidden.shape), generator=generator) < kept
        point: Tensor = last(hidden * mask / kept)
        return point


class PointLearner(Learner):
    """The point network with mean absolute error, so that it predicts the median."""

    def __init__(
        self,
        size: int,
        target: Target,
        hidden: tuple[int, int],
        feature_noise: float,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.decoder = PoseDecoder(target)
        self.network = PointNetwork(size, target.size, hidden, feature_noise, dropout)
        self.standardise = self.network.standardise

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Features (n, size), truth (n, 6) or (n, 9) -> scalar."""
        error: Tensor = self.network(features) - y
        return error.abs().mean()

    def val_score(self, features: Tensor, y: Array) -> float:
        """See ``Learner``; scores intervals of constant width about the point."""
        truth = torch.from_numpy(y).float()
        error = self.decoder.errors(self.network(features), truth).double().numpy()
        return conformalised_score(np.zeros_like(error), np.zeros_like(error), error)


class HeldOut(NamedTuple):
    """A point network, and networks that predict frames they were not trained on.

    Attributes
    ----------
    network
        The network that is exported.
    rows
        Training images (rows of the lessons) for which a network that has not seen them exists.
    parts
        Rows, each with the network that has not seen them.
    """

    network: PointNetwork
    rows: Indices
    parts: list[tuple[Indices, PointNetwork]]

    def points(self, features: NDArray[np.float16]) -> Array:
        """Features (copies, n, size) -> standardised points (copies, rows, outputs)."""
        found = np.zeros((*features.shape[:2], self.network.outputs))
        for part, network in self.parts:
            with torch.no_grad():
                for copy, values in enumerate(features[:, part]):
                    found[copy, part] = network(torch.from_numpy(values).float()).numpy()
        return found[:, self.rows]

    def passes(self, features: NDArray[np.float16], count: int, seed: int) -> Array:
        """Features (copies, n, size) -> stochastic points (count * copies, rows, outputs)."""
        generator = torch.Generator().manual_seed(seed)
        found = np.zeros((count, *features.shape[:2], self.network.outputs))
        for part, network in self.parts:
            with torch.no_grad():
                for copy, values in enumerate(features[:, part]):
                    drawn = network.passes(torch.from_numpy(values).float(), count, generator)
                    found[:, copy, part] = drawn.numpy()
        return found[:, :, self.rows].reshape(-1, self.rows.size, self.network.outputs)


def learn_held_out(
    lessons: Lessons,
    name: str,
    residuals: Residuals,
    hidden: tuple[int, int],
    feature_noise: float,
    dropout: float = 0.0,
) -> HeldOut:
    """Train the point network and, for cross-fitted residuals, a network per fold.

    ``held_out``: the network learns from the role train; residuals come from the role fit.
    ``auto``: cross-fitted below 1500 training frames. Raises UsageError for cross-fitted residuals
    with a fine-tuned backbone, which has seen all frames.
    """
    everything = np.arange(lessons.n_images)
    cross_fitted = residuals == "cross_fitted"
    if residuals == "auto":
        cross_fitted = not lessons.fine_tuned and lessons.n_run < _MANY_FRAMES
    if cross_fitted and lessons.fine_tuned:
        raise UsageError(
            "residuals: cross_fitted needs a frozen backbone; use held_out with --fine-tune"
        )

    def learn(lesson: str, rows: Indices, candidate: bool = True) -> PointNetwork:
        size = lessons.setting.feature_size
        return lessons.learn(
            lesson,
            lambda: PointLearner(size, lessons.setting.target, hidden, feature_noise, dropout),
            rows,
            candidate=candidate,
        ).network

    if not cross_fitted:
        network = learn(name, everything[: lessons.n_train])
        rows = everything[lessons.n_train :]
        return HeldOut(network, rows, [(rows, network)])
    parts = [
        (fold, learn(f"{name}-fold{number}", np.setdiff1d(everything, fold), candidate=False))
        for number, fold in enumerate(lessons.folds(_FOLDS))
    ]
    return HeldOut(learn(name, everything), everything, parts)


def residuals_of(setting: Setting, point: Array, poses: Array) -> Array:
    """Standardised points (..., k), true poses (..., 7) -> (t - t_hat, Log(R_hat^T R)), (..., 6).

    In metres and radians: the chart ``tangent_predicted`` relative to the prediction's coordinates.
    """
    decoder = PoseDecoder(setting.target)
    flat = torch.from_numpy(point.reshape(-1, setting.target.size)).float()
    predicted = decoder.pose(decoder(flat)).double().numpy()
    chart = Chart("tangent_predicted")
    origin = chart.coordinates(predicted, predicted)
    residual = chart.coordinates(poses.reshape(-1, 7), predicted) - origin
    return np.asarray(residual).reshape(*point.shape[:-1], DOF)


def check_components(lessons: Lessons, count: int) -> None:
    """Raise UsageError if the lessons yield fewer than ``count`` principal components."""
    most = min(lessons.n_images, lessons.setting.feature_size)
    if count > most:
        raise UsageError(
            f"components: expected at most {most}, the lesser of training frames and features, "
            f"found {count}"
        )


def deviation_of(residual: Array) -> Array:
    """Residuals (..., 6) -> robust standard deviation per DoF, (6,), at least 1e-6.

    1.4826 times the median absolute deviation, which equals sigma for a Gaussian.
    """
    flat = residual.reshape(-1, DOF)
    spread = np.median(np.abs(flat - np.median(flat, axis=0)), axis=0)
    return np.asarray(np.maximum(1.4826 * spread, _LEAST_DEVIATION))


def principal_components(
    network: PointNetwork, features: NDArray[np.float16], count: int
) -> Tensor:
    """Features (n, size) -> principal components of the standardised features, (size, count)."""
    with torch.no_grad():
        x = network.standardise(torch.from_numpy(features).float()).double()
    _, _, directions = torch.linalg.svd(x - x.mean(dim=0), full_matrices=False)
    kept: Tensor = directions[:count].T.float().contiguous()
    return kept


def compressed(
    network: PointNetwork, features: NDArray[np.float16], components: Tensor
) -> NDArray[np.float32]:
    """Features (copies, n, size) -> principal components (copies, n, count)."""
    with torch.no_grad():
        found = [network.standardise(torch.from_numpy(f).float()) @ components for f in features]
    return np.stack([values.numpy() for values in found])
