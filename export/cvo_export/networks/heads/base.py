"""What every method provides to the training side: what is trained, and what is exported."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from msgspec import Struct
from numpy.typing import NDArray
from torch import Tensor, nn

from cvo_edge.bundle.format import Six
from cvo_edge.conformal import conformal_quantile, interval_score
from cvo_edge.heads import Candidate
from cvo_edge.pose import Rotation
from cvo_export.bundles.draft import HALF_WIDTH_FLOOR, six
from cvo_export.networks.standardised import Target

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

DOF = 6


class Standardise(nn.Module):
    """Features (n, size) -> features of mean 0 and deviation 1 over the training images.

    While training, Gaussian noise of deviation ``noise`` is added.
    """

    def __init__(self, size: int, noise: float) -> None:
        super().__init__()
        self.noise = noise
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))
        self.mean: Tensor
        self.std: Tensor

    def fit(self, features: NDArray[np.float16] | NDArray[np.float32]) -> None:
        """Take mean and deviation from features (copies, n, size)."""
        deviation = features.std((0, 1), dtype=np.float64)
        self.mean.copy_(torch.from_numpy(features.mean((0, 1), dtype=np.float64)))
        # A feature that is nearly always zero would be blown up where it is not.
        self.std.copy_(torch.from_numpy(deviation + 0.1 * deviation.mean()))

    def forward(self, features: Tensor) -> Tensor:
        """Shape (n, size) -> (n, size)."""
        x = (features - self.mean) / self.std
        return x + self.noise * torch.randn_like(x) if self.training else x


def dense(inputs: int, outputs: int, dropout: float = 0.0) -> list[nn.Module]:
    """Return a layer of the trunks: linear, PReLU and, where asked for, dropout."""
    layer: list[nn.Module] = [nn.Linear(inputs, outputs), nn.PReLU(outputs)]
    return [*layer, nn.Dropout(dropout)] if dropout > 0 else layer


class Learner(nn.Module):
    """What one lesson of the training loop trains: a network with its loss.

    ``standardise`` is filled in before the first step.
    """

    standardise: Standardise

    @abstractmethod
    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Features (n, size), standardised truth (n, 6) -> scalar."""

    @abstractmethod
    def val_score(self, features: Tensor, y: Array) -> float:
        """Return the figure that decides on val: mean interval score at 90 %, standardised (n, 6).

        Close to what the bundle will be judged by; but thresholds are taken on val itself.
        """


def conformalised_score(lower: Array, upper: Array, y: Array) -> float:
    """Mean interval score at 90 % of bounds (n, 6), corrected on these very truths (n, 6)."""
    scores = np.maximum(lower - y, y - upper)
    q_hat = np.array([conformal_quantile(scores[:, dof], 0.9) for dof in range(DOF)])
    lower, upper = lower - q_hat, upper + q_hat
    distance = np.maximum(np.maximum(lower - y, y - upper), 0.0)
    return float(interval_score(upper - lower, distance, 0.1).mean())


L = TypeVar("L", bound=Learner)


class ExportedHead(nn.Module):
    """Features (n, size) -> the method's outputs in metres and radians, as they are exported.

    Attributes
    ----------
    output_names
        Of the tuple that ``forward`` returns; the first is ``pose`` (n, 7).
    runtime_method
        The method of the runtime that reads these outputs.
    rotation
        The chart of the six numbers.
    extra_inputs
        Name -> an example of every further argument of ``forward``.
    """

    output_names: tuple[str, ...]
    runtime_method: str
    rotation: Rotation = "tangent_reference"
    extra_inputs: Mapping[str, Tensor] = {}

    @abstractmethod
    def candidates(self) -> tuple[Candidate, ...]:
        """Return what val chooses among; the first stands unless another is clearly better."""

    def choices(self) -> Mapping[str, float]:
        """What val chose inside of this head, for the provenance; by default nothing."""
        return {}

    def completed(self, content: bytes) -> bytes:
        """Add to an exported model what torch cannot export; by default nothing."""
        return content

    def completed_outputs(self, outputs: Mapping[str, NDArray[Any]]) -> Mapping[str, NDArray[Any]]:
        """What the completed model must give where the exported one gives ``outputs``."""
        return outputs


class Setting(NamedTuple):
    """What every head is built from: number of features, target, and the run's seed."""

    feature_size: int
    target: Target
    seed: int


class Examples(NamedTuple):
    """What a lesson learns from, where that is not the features.

    Inputs (copies, n, size) and truths (copies, n, 6) of the training images in any number of
    copies; inputs (n_val, size) and truths (n_val, 6) of val.
    """

    x: NDArray[np.float16] | NDArray[np.float32]
    y: Array
    val_x: Tensor
    val_y: Array


class Lessons(Protocol):
    """What the training loop offers to a method."""

    setting: Setting
    # Number of training images; the first n_train have the role train, those after them fit.
    n_images: int
    n_train: int
    # Whether the backbone learns, too: then residuals on frames that it has seen are too small.
    fine_tuned: bool

    def learn(
        self,
        name: str,
        build: Callable[[], L],
        rows: Indices | None = None,
        examples: Examples | None = None,
    ) -> L:
        """Train what ``build`` makes on these rows, all by default; kept and resumed by name.

        On features and standardised poses, unless other ``examples`` are given.
        """

    def folds(self, count: int) -> list[Indices]:
        """Rows of the training images, dealt into folds by the split's own unit."""

    def poses(self) -> Array:
        """Poses (n, 7) of the training images."""

    def val(self) -> tuple[Tensor, Array]:
        """Features (n_val, size) and poses (n_val, 7) of val."""

    def features(self) -> tuple[NDArray[np.float16], Array]:
        """Features (copies + 1, n, size) and poses (copies + 1, n, 7); the first is unchanged."""


@dataclass(frozen=True)
class Method:
    """One method: its options, how it is trained, and how a finished one is read back.

    ``restore`` takes the state of a finished head and returns it, of the same setting and options.
    """

    config: type[Struct]
    train: Callable[[Lessons, Any], ExportedHead]
    restore: Callable[[Setting, Any, Mapping[str, Tensor]], ExportedHead]


def interval_candidates(parameters: Struct) -> tuple[Candidate, ...]:
    """Normalised before additive: factors carry over to harder or easier recordings."""
    return (Candidate("normalised", parameters), Candidate("additive", parameters))


def half_width_floor(target: Target) -> Six:
    """Least half-width per DoF in the normalised score, from the poses' deviation."""
    return six(HALF_WIDTH_FLOOR * target.std)
