"""Interface between a method and the training side: what is trained and what is exported."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
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
from cvo_export.data.augment import AugmentConfig
from cvo_export.data.place import Place
from cvo_export.networks.standardised import Target
from cvo_export.networks.stem import Upper

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

DOF = 6

_ROWS_AT_ONCE = 65536


class Standardise(nn.Module):
    """Scale features (n, size) to mean 0 and deviation 1 over the training images.

    During training, Gaussian noise of deviation ``noise`` is added.
    """

    def __init__(self, size: int, noise: float) -> None:
        super().__init__()
        self.noise = noise
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))
        self.mean: Tensor
        self.std: Tensor

    def fit(self, features: NDArray[np.float16] | NDArray[np.float32]) -> None:
        """Set mean and deviation from features (copies, n, size)."""
        mean = features.mean((0, 1), dtype=np.float64)
        deviation = deviation_of(features.reshape(-1, features.shape[-1]), mean)
        self.mean.copy_(torch.from_numpy(mean))
        # Without a floor, a feature that is nearly always zero would explode where it is not.
        self.std.copy_(torch.from_numpy(deviation + 0.1 * deviation.mean()))

    def forward(self, features: Tensor) -> Tensor:
        """Shape (n, size) -> (n, size)."""
        x = (features - self.mean) / self.std
        return x + self.noise * torch.randn_like(x) if self.training else x


def deviation_of(rows: NDArray[Any], mean: Array) -> Array:
    """Return the standard deviation of rows (n, size) with a known mean (size,).

    Equal to numpy's bit by bit, which would need memory for all rows in float64.
    """
    total = np.zeros_like(mean)
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        squared = np.square(rows[start : start + _ROWS_AT_ONCE] - mean)
        total = np.add.reduce(np.concatenate([total[np.newaxis], squared]))
    return np.asarray(np.sqrt(total / len(rows)))


def dense(inputs: int, outputs: int, dropout: float = 0.0) -> list[nn.Module]:
    """Return one layer of a trunk: linear, PReLU and, if ``dropout`` is above 0, dropout."""
    layer: list[nn.Module] = [nn.Linear(inputs, outputs), nn.PReLU(outputs)]
    return [*layer, nn.Dropout(dropout)] if dropout > 0 else layer


class Learner(nn.Module):
    """A network and its loss, trained by one lesson of the training loop.

    The training loop calls ``fit_inputs`` before the first step.
    """

    standardise: Standardise

    def fit_inputs(self, inputs: NDArray[Any]) -> None:
        """Fit the standardisation to inputs (copies, n, size) before the first step."""
        self.standardise.fit(inputs)

    def groups(self, rate: float) -> list[dict[str, Any]]:
        """Return the optimiser's groups of parameters, each with its peak learning rate."""
        return [{"params": list(self.parameters()), "peak": rate}]

    @abstractmethod
    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Features (n, size), standardised truth (n, 6) or (n, 9) -> scalar."""

    @abstractmethod
    def val_score(self, features: Tensor, y: Array) -> float:
        """Return the val score: mean interval score at 90 % for standardised truths (n, 6 or 9).

        It is close to the figure that judges the bundle, but its thresholds come from val itself.
        """


def conformalised_score(lower: Array, upper: Array, y: Array) -> float:
    """Return the mean interval score at 90 % of bounds (n, 6) calibrated on the same truths."""
    scores = np.maximum(lower - y, y - upper)
    q_hat = np.array([conformal_quantile(scores[:, dof], 0.9) for dof in range(DOF)])
    lower, upper = lower - q_hat, upper + q_hat
    distance = np.maximum(np.maximum(lower - y, y - upper), 0.0)
    return float(interval_score(upper - lower, distance, 0.1).mean())


L = TypeVar("L", bound=Learner)


class ExportedHead(nn.Module):
    """Features (n, size) -> the method's exported outputs, in metres and radians.

    Attributes
    ----------
    output_names
        Names of the outputs that ``forward`` returns; the first is ``pose`` (n, 7).
    runtime_method
        The runtime method that reads these outputs.
    rotation
        The chart of the six numbers.
    extra_inputs
        Name -> example value of each additional argument of ``forward``.
    point_outputs
        Names of outputs that are points, (..., 3): one number of a far point may be near zero.
    """

    output_names: tuple[str, ...]
    runtime_method: str
    rotation: Rotation = "tangent_reference"
    extra_inputs: Mapping[str, Tensor] = {}
    point_outputs: tuple[str, ...] = ()

    @abstractmethod
    def candidates(self) -> tuple[Candidate, ...]:
        """Return the scores val chooses from; the first wins unless another is clearly better."""

    def deployed(self) -> nn.Module:
        """Return the module to export, by default itself: the same outputs at a lower cost.

        For a method with cells, it also returns the map of the last stage, after the outputs.
        """
        return self

    def choices(self) -> Mapping[str, float]:
        """Return what val chose inside this head, for the provenance; empty by default."""
        return {}

    def completed(self, content: bytes) -> bytes:
        """Add the parts that torch cannot export to an exported model; by default nothing."""
        return content

    def completed_outputs(self, outputs: Mapping[str, NDArray[Any]]) -> Mapping[str, NDArray[Any]]:
        """Return the completed model's expected outputs, given the exported model's ``outputs``."""
        return outputs


class Setting(NamedTuple):
    """Inputs to every head's constructor.

    Number of features, target, the run's seed and, for a method with cells, the stages after the
    stem, with pretrained weights in a new run.
    """

    feature_size: int
    target: Target
    seed: int
    upper: Upper | None = None

    def cells(self) -> Upper:
        """Return the stages after the stem of a method with cells."""
        if self.upper is None:
            raise TypeError("expected a method with cells")
        return self.upper


class Schedule(NamedTuple):
    """Steps of a lesson (None: the run's), examples per step, learning rate and torch's threads.

    Most lessons use one thread, because a batch of 64 rows is too small to split; None uses all.
    """

    steps: int | None
    batch_size: int
    learning_rate: float
    threads: int | None = 1


class Examples(NamedTuple):
    """Training data of a lesson that does not learn from features.

    Inputs (copies, n, ...) and truths (copies, n, ...) of the training images, for any number of
    copies, in the shapes that the learner's loss takes; inputs and truths (n_val, ...) of val.
    """

    x: NDArray[np.float16] | NDArray[np.float32]
    y: NDArray[Any]
    val_x: Tensor
    val_y: Array


class Lessons(Protocol):
    """What the training loop offers a method."""

    setting: Setting
    # Number of training images: the first n_train have the role train, the rest the role fit.
    n_images: int
    n_train: int
    # Training images of the run: more than n_images in a fold of a crossed run. What the amount of
    # data decides follows this number, so that the heads of all folds are of one kind.
    n_run: int
    # Whether the backbone is trained as well; residuals on frames it has seen are then too small.
    fine_tuned: bool

    def learn(
        self,
        name: str,
        build: Callable[[], L],
        rows: Indices | None = None,
        examples: Examples | None = None,
        candidate: bool = True,
        schedule: Schedule | None = None,
    ) -> L:
        """Train the network made by ``build`` on these rows (default: all).

        The result is stored and resumed by name. Uses features and standardised poses unless
        ``examples`` are given. Pass ``candidate=False`` for a network that is discarded or only
        models residuals: its val score is not the run's. ``schedule`` None uses the run's options.
        """

    def folds(self, count: int) -> list[Indices]:
        """Split the rows of the training images into folds, by the unit of the data split."""

    def poses(self) -> Array:
        """Return the poses (n, 7) of the training images."""

    def val(self) -> tuple[Tensor, Array]:
        """Return features (n_val, size) and poses (n_val, 7) of val."""

    def place(self) -> Place:
        """Return the place that the training images show; for methods with cells.

        Raises UsageError if the data set does not state its camera.
        """

    def features(self) -> tuple[NDArray[np.float16], Array]:
        """Features (copies + 1, n, size), poses (copies + 1, n, 7); copy 0 is not augmented.

        For a method with cells, features are the stem's maps.
        """


@dataclass(frozen=True)
class Method:
    """One method: its options, its training, and how to restore a trained head.

    ``restore`` rebuilds a head from its state dict, given the setting and options of its training.
    ``cells``: whether the head reads the map of a stem and trains the stages after it. ``size``
    (width and height of the input), ``copies``, ``steps`` and ``augment`` are the defaults of a
    run; with cells, large data sets get fewer copies. ``turns``: whether it learns targets of nine
    numbers, for rotations of any size.
    """

    config: type[Struct]
    train: Callable[[Lessons, Any], ExportedHead]
    restore: Callable[[Setting, Any, Mapping[str, Tensor]], ExportedHead]
    cells: bool = False
    size: tuple[int, int] = (192, 144)
    copies: int = 48
    steps: int = 10_000
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    turns: bool = False


def interval_candidates(parameters: Struct) -> tuple[Candidate, ...]:
    """Put the normalised score first: its factors transfer to harder or easier recordings."""
    return (Candidate("normalised", parameters), Candidate("additive", parameters))


def half_width_floor(target: Target) -> Six:
    """Return the least half-width per DoF for the normalised score, from the poses' deviation."""
    return six(HALF_WIDTH_FLOOR * target.deviation)
