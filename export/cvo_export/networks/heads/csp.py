"""Conformalized set prediction: K classes and a softmax per degree of freedom.

The paper's section III-B. Class edges are quantiles of the training poses, so that classes are
narrow where poses are dense. A shared trunk outputs the logits of all six degrees of freedom.

Where rotations spread too far for one chart, a point network predicts the rotation, and the classes
of the three rotation coordinates divide its errors on frames that it has not seen.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from msgspec import Meta, Struct
from msgspec.structs import replace
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import one_hot

from cvo_edge.conformal import conformal_quantile, interval_score
from cvo_edge.heads import Candidate
from cvo_edge.heads.csp import CspParameters, class_scores
from cvo_export.networks.heads.base import (
    DOF,
    Examples,
    ExportedHead,
    Learner,
    Lessons,
    Method,
    Setting,
    Standardise,
    dense,
)
from cvo_export.networks.heads.point import (
    FeatureNoise,
    Hidden,
    PointNetwork,
    Residuals,
    learn_held_out,
    residuals_of,
)
from cvo_export.networks.standardised import PoseDecoder, Target

Array = NDArray[np.float64]

# Margin of the workspace beyond the training poses, as a fraction of each DoF's range.
_MARGIN = 0.1
_TEMPERATURES = np.exp(np.linspace(np.log(0.1), np.log(10.0), 97))
# Values from the appendix of Angelopoulos et al. 2021; the best one depends on the network.
_PENALTIES = (0.001, 0.01, 0.1, 0.2, 0.5)
_FREE_RANKS = 5
# Narrow labels suit classes as wide as the errors, wide labels suit new recordings. The middle
# value is used where only one network can be trained.
_SIGMAS = (1.5, 4.0, 10.0)
# Of two classes, the fewest that a degree of freedom may have.
_LEAST_EDGES = 3


class CspConfig(Struct, frozen=True, tag="csp", tag_field="method", forbid_unknown_fields=True):
    """Options of classes, labels and network; the paper uses one_hot labels."""

    classes: Annotated[
        int,
        Meta(
            ge=2,
            le=256,
            description="Classes per degree of freedom (K); fewer if training poses repeat.",
        ),
    ] = 128
    labels: Annotated[
        Literal["ordinal", "one_hot"],
        Meta(description="ordinal: a Gaussian over the classes; one_hot: the paper's."),
    ] = "ordinal"
    label_sigma: Annotated[
        Annotated[float, Meta(ge=0.01)] | None,
        Meta(
            description="Deviation of ordinal labels in classes; if not given, val chooses among "
            "1.5, 4 and 10."
        ),
    ] = None
    hidden: Hidden = (256, 128)
    feature_noise: FeatureNoise = 0.1
    dropout: Annotated[
        float, Meta(ge=0, lt=1, description="Dropout after the hidden layers during training.")
    ] = 0.0


class Classes(nn.Module):
    """The classes of all six degrees of freedom, in standardised numbers.

    Buffers: ``edges`` (6, K + 1), where a DoF with fewer classes repeats its last edge; ``medians``
    (6, K) of the training poses in each class; and ``used`` (6, K).
    """

    def __init__(self, edges: Tensor, medians: Tensor) -> None:
        super().__init__()
        self.register_buffer("edges", edges)
        self.register_buffer("medians", medians)
        self.register_buffer("used", edges[:, 1:] > edges[:, :-1])
        self.edges: Tensor
        self.medians: Tensor
        self.used: Tensor

    @classmethod
    def cut(cls, y: Array, count: int, reach: Array | None = None) -> Classes:
        """Cut standardised training poses (n, 6) into at most ``count`` classes per DoF.

        The outermost classes end at least at +-``reach`` (6,), by default a tenth of the range
        beyond the training poses.
        """
        rows, middles = [], []
        for dof, values in enumerate(y.T):
            # A camera at rest repeats poses: use no more classes than there are gaps between poses.
            shares = min(count, np.unique(values).size - 1)
            edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, max(shares, 1) + 1)))
            margin = _MARGIN * (edges[-1] - edges[0])
            if edges.size < _LEAST_EDGES:
                # It stands still: one unit, the floor of its deviation, on either side.
                edges, margin = np.array([edges[0], values.mean(), edges[-1]]), 1.0
            edges[0] -= margin
            edges[-1] += margin
            if reach is not None:
                edges[0], edges[-1] = min(edges[0], -reach[dof]), max(edges[-1], reach[dof])
            index = np.searchsorted(edges[1:-1], values, side="right")
            medians = [
                np.median(values[index == k]) if (index == k).any() else edges[k : k + 2].mean()
                for k in range(edges.size - 1)
            ]
            missing = count + 1 - edges.size
            rows.append(np.append(edges, [edges[-1]] * missing))
            middles.append(np.append(medians, [0.0] * missing))
        table = torch.from_numpy(np.array(rows))
        # Drop classes that no DoF uses.
        most = int((table[:, 1:] > table[:, :-1]).sum(dim=1).max())
        return cls(table[:, : most + 1], torch.from_numpy(np.array(middles))[:, :most])

    @property
    def count(self) -> int:
        """K, the largest number of classes of any DoF."""
        return int(self.used.shape[1])

    def index(self, y: Tensor) -> Tensor:
        """Standardised truth (n, 6) -> class index (n, 6), clipped to the outermost classes."""
        inside = torch.arange(1, self.count) < self.used.sum(dim=1, keepdim=True)
        inner = torch.where(inside, self.edges[:, 1:-1], torch.inf)
        return torch.searchsorted(inner, y.double().T.contiguous(), right=True).T

    def position(self, y: Tensor) -> Tensor:
        """Standardised truth (n, 6) -> position on the class axis; the middle of class k is k."""
        index = self.index(y).T
        low, high = self.edges.gather(1, index), self.edges.gather(1, index + 1)
        within = ((y.double().T - low) / (high - low)).clamp(0.0, 1.0)
        return (index + within - 0.5).T.float()

    def widths(self) -> Array:
        """Width of every class, (6, K)."""
        widths: Array = np.diff(self.edges.numpy(), axis=1)
        return widths


class CspNetwork(nn.Module):
    """Features (n, size) -> logits (n, 6, K); unused classes get large negative logits."""

    def __init__(self, size: int, config: CspConfig, classes: Classes) -> None:
        super().__init__()
        wide, narrow = config.hidden
        self.classes = classes
        self.standardise = Standardise(size, config.feature_noise)
        self.layers = nn.Sequential(
            *dense(size, wide, config.dropout),
            *dense(wide, narrow, config.dropout),
            nn.Linear(narrow, DOF * classes.count),
        )
        self.register_buffer("blocked", torch.where(classes.used, 0.0, -1e9).float())
        self.blocked: Tensor

    def forward(self, features: Tensor) -> Tensor:
        """Shape (n, size) -> (n, 6, K)."""
        logits: Tensor = self.layers(self.standardise(features))
        return logits.reshape(-1, DOF, self.classes.count) + self.blocked


class CspLearner(Learner):
    """The network with the cross-entropy loss against ordinal or one-hot labels."""

    def __init__(self, size: int, config: CspConfig, classes: Classes, sigma: float) -> None:
        super().__init__()
        self.one_hot = config.labels == "one_hot"
        self.sigma = sigma
        self.network = CspNetwork(size, config, classes)
        self.standardise = self.network.standardise

    def labels(self, y: Tensor) -> Tensor:
        """Standardised truth (n, 6) -> target probabilities (n, 6, K)."""
        classes = self.network.classes
        if self.one_hot:
            return one_hot(classes.index(y), classes.count).float()
        distance = torch.arange(classes.count) - classes.position(y)[..., None]
        weight = torch.exp(-0.5 * (distance / self.sigma) ** 2) * classes.used
        return weight / weight.sum(dim=-1, keepdim=True)

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Features (n, size), truth (n, 6) -> scalar."""
        logarithm = torch.log_softmax(self.network(features), dim=-1)
        return -(self.labels(y) * logarithm).sum(dim=-1).mean()

    def val_score(self, features: Tensor, y: Array) -> float:
        """See ``Learner``; scores the sets of the ``aps`` score."""
        probabilities = torch.softmax(self.network(features), dim=-1).double().numpy()
        return float(set_score(self.network.classes, probabilities, y).mean())


def set_score(classes: Classes, probabilities: Array, y: Array) -> Array:
    """Return the interval score at 90 % of the ``aps`` sets, (n, 6), calibrated on the same frames.

    Probabilities (n, 6, K), standardised truth (n, 6).
    """
    scores = class_scores(probabilities, "aps")
    edges = classes.edges.numpy()
    index = classes.index(torch.from_numpy(y)).numpy()[..., np.newaxis]
    of_truth = np.take_along_axis(scores, index, axis=-1)[..., 0]
    outside = (y < edges[:, 0]) | (y > edges[:, -1])
    of_truth = np.where(outside, np.inf, of_truth)
    q_hat = np.array([conformal_quantile(of_truth[:, dof], 0.9) for dof in range(DOF)])
    inside = (scores <= q_hat[:, np.newaxis]) & classes.used.numpy()
    np.put_along_axis(inside, probabilities.argmax(axis=-1)[..., np.newaxis], True, axis=-1)
    low, high, truth = edges[:, :-1], edges[:, 1:], y[..., np.newaxis]
    gap = np.maximum(np.maximum(low - truth, truth - high), 0.0)
    distance = np.where(inside, gap, np.inf).min(axis=-1)
    return interval_score((inside * classes.widths()).sum(axis=-1), distance, 0.1)


class CspHead(ExportedHead):
    """Features -> pose (n, 7), the expected class median, and probabilities (n, 6, K)."""

    output_names = ("pose", "probabilities")
    runtime_method = "csp"

    def __init__(
        self,
        network: CspNetwork,
        temperature: Tensor,
        setting: Setting,
        point: PointNetwork | None,
    ) -> None:
        super().__init__()
        self.network, self.point = network, point
        self.decoder = PoseDecoder(setting.target)
        if point is not None:
            self.rotation = "tangent_predicted"
        self.register_buffer("temperature", temperature)
        self.temperature: Tensor
        self.register_buffer("medians", network.classes.medians.float())
        self.medians: Tensor
        classes = network.classes
        scale, origin = (values[:, np.newaxis] for values in _units(setting.target))
        edges = classes.edges.numpy() * scale + origin
        used = classes.used.sum(dim=1).tolist()
        self._edges = [
            tuple(float(f"{edge:.9g}") for edge in row[: count + 1].tolist())
            for row, count in zip(edges, used, strict=True)
        ]

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return pose (n, 7) in metres and probabilities (n, 6, K)."""
        logits = self.network(features) / self.temperature[:, None]
        probabilities = torch.softmax(logits, dim=-1)
        middle = (probabilities * self.medians).sum(dim=-1)
        if self.point is not None:
            middle = torch.cat([middle[:, :3], self.point(features)[:, 3:]], dim=1)
        return self.decoder.pose(self.decoder(middle)), probabilities

    def candidates(self) -> tuple[Candidate, ...]:
        """List ``aps`` first, then the paper's ``lac``, then ``raps`` with increasing penalties."""
        a, b, c, d, e, f = self._edges
        plain = CspParameters(edges=(a, b, c, d, e, f), penalty=0.0, free_ranks=0)
        return (
            Candidate("aps", plain),
            Candidate("lac", plain),
            *(
                Candidate("raps", replace(plain, penalty=penalty, free_ranks=_FREE_RANKS))
                for penalty in _PENALTIES
            ),
        )


def _units(target: Target) -> tuple[Array, Array]:
    """Return unit and zero of the six standardised coordinates that classes divide, m and rad."""
    if not target.turns:
        return target.std, target.mean
    return target.deviation, np.concatenate([target.mean[:3], np.zeros(3)])


class _Lesson(NamedTuple):
    """What the classes are learned from; the point network is None for a target of one chart."""

    classes: Classes
    examples: Examples | None
    val_y: Array
    point: PointNetwork | None


def _lesson(lessons: Lessons, config: CspConfig) -> _Lesson:
    target = lessons.setting.target
    val_features, val_poses = lessons.val()
    if not target.turns:
        classes = Classes.cut(target.standardised(lessons.poses()), config.classes)
        return _Lesson(classes, None, target.standardised(val_poses), None)
    # The classes of the position learn from all frames, so the errors have to be of all, too.
    residuals: Residuals = "held_out" if lessons.fine_tuned else "cross_fitted"
    held_out = learn_held_out(lessons, "csp-point", residuals, config.hidden, config.feature_noise)
    features, poses = lessons.features()
    poses = poses[:, held_out.rows]

    def standardised(point: Array, poses: Array) -> Array:
        turn = residuals_of(lessons.setting, point, poses)[..., 3:] / target.deviation[3:]
        return np.concatenate([target.standardised(poses)[..., :3], turn], axis=-1)

    y = standardised(held_out.points(features), poses)
    with torch.no_grad():
        val_point = held_out.network(val_features).double().numpy()
    val_y = standardised(val_point, val_poses)
    # No error exceeds half a turn.
    reach = np.concatenate([np.zeros(3), np.pi / target.deviation[3:]])
    classes = Classes.cut(y.reshape(-1, DOF), config.classes, reach)
    examples = Examples(features[:, held_out.rows], y, val_features, val_y)
    return _Lesson(classes, examples, val_y, held_out.network)


def _train(lessons: Lessons, config: CspConfig) -> CspHead:
    setting = lessons.setting
    lesson = _lesson(lessons, config)
    sigmas: tuple[float, ...] = _SIGMAS
    if config.label_sigma is not None:
        sigmas = (config.label_sigma,)
    elif lessons.fine_tuned or config.labels == "one_hot":
        sigmas = _SIGMAS[1:2]

    def learn(sigma: float) -> CspLearner:
        size = setting.feature_size
        return lessons.learn(
            f"csp-sigma{sigma:g}",
            lambda: CspLearner(size, config, copy.deepcopy(lesson.classes), sigma),
            examples=lesson.examples,
        )

    learners = [learn(sigma) for sigma in sigmas]
    features, _ = lessons.val()
    y = lesson.val_y
    with torch.no_grad():
        network = min(learners, key=lambda learner: learner.val_score(features, y)).network
        logits = network(features).double()
    temperature = best_temperatures(logits, lesson.classes.index(torch.from_numpy(y)))
    return CspHead(network, temperature, setting, lesson.point)


def best_temperatures(logits: Tensor, index: Tensor) -> Tensor:
    """Return the temperature per DoF, (6,), that maximises the likelihood of the true classes.

    Logits (n, 6, K) and classes (n, 6), on val (Guo et al. 2017).
    """
    losses = []
    for temperature in _TEMPERATURES.tolist():
        logarithm = torch.log_softmax(logits / temperature, dim=-1)
        losses.append(-logarithm.gather(2, index[..., None])[..., 0].mean(dim=0))
    best = torch.stack(losses).argmin(dim=0)
    return torch.from_numpy(_TEMPERATURES)[best].float()


def _restore(setting: Setting, config: CspConfig, state: Mapping[str, Tensor]) -> CspHead:
    prefix = "network.classes."
    classes = Classes(state[prefix + "edges"], state[prefix + "medians"])
    network = CspNetwork(setting.feature_size, config, classes)
    point = None
    if setting.target.turns:
        size = setting.feature_size, setting.target.size
        point = PointNetwork(*size, config.hidden, config.feature_noise)
    head = CspHead(network, state["temperature"], setting, point)
    head.load_state_dict(state)
    return head


METHOD = Method(CspConfig, _train, _restore, turns=True)
