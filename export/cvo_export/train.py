"""One training loop: data set, split, features, steps, early stopping, checkpoints.

The run folder holds everything that publishing needs: ``config.json``, ``split.json``, cached
features, ``checkpoint.pt`` (to go on after an interruption) and, in the end, ``network.pt``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from cvo_edge import geometry
from cvo_edge.conformal import conformal_quantile, interval_score
from cvo_edge.errors import UsageError
from cvo_edge.pose import Chart
from cvo_edge.preprocess import Crop
from cvo_export.augment import AugmentConfig
from cvo_export.backbone import Backbone, BackboneConfig, load_weights
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.features import FeatureExtractor, ModelImages, Progress, cached_copies
from cvo_export.heads.cjp import CjpConfig, CjpDecoded, CjpLoss, CjpNetwork
from cvo_export.splits import Kind, Split, make_split, same_split

Array = NDArray[np.float64]

CONFIG_FILE = "config.json"
SPLIT_FILE = "split.json"
CHECKPOINT_FILE = "checkpoint.pt"
NETWORK_FILE = "network.pt"
FEATURES_FOLDER = "features"

# Beyond this spread about the mean rotation the tangent at it comes near its cut at pi.
MAX_SPREAD_RAD = 2.0
# Share of the steps after which no new best on val ends the training.
_PATIENCE = 0.4


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a run; written to ``config.json``.

    ``split`` None takes ``sequence`` where the data set has enough of them, else ``block``;
    ``copies`` is the number of augmented copies of each training frame whose features are cached;
    ``steps``, ``batch_size``, ``learning_rate`` and ``weight_decay`` are AdamW's; the rate rises
    over 50 steps and falls as a cosine. ``fine_tune`` more steps train the whole network on
    fresh augmented images at ``backbone_learning_rate``.
    """

    method: Literal["cjp"]
    dataset: str
    split: Kind
    seed: int = 0
    height: int = 192
    width: int = 256
    crop: Crop = "none"
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    weights: str = "timm"
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    copies: int = 12
    head: CjpConfig = field(default_factory=CjpConfig)
    steps: int = 4000
    warm_up_steps: int = 200
    batch_size: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 1e-3
    averaging: float = 0.995


@dataclass(frozen=True)
class Target:
    """Standardised degrees of freedom: tx ty tz and Log(R_reference^T R), over train and fit."""

    reference_q_xyzw: Array
    mean: Array
    std: Array

    @property
    def chart(self) -> Chart:
        """The chart whose coordinates are standardised."""
        return Chart("tangent_reference", self.reference_q_xyzw)

    def coordinates(self, poses: Array) -> Array:
        """Poses (..., 7) -> coordinates (..., 6), m and rad."""
        return self.chart.coordinates(poses, poses)

    def standardised(self, poses: Array) -> Array:
        """Poses (..., 7) -> numbers (..., 6) of mean 0 and deviation 1 over train and fit."""
        return (self.coordinates(poses) - self.mean) / self.std


def fit_target(poses: Array) -> Target:
    """Mean rotation, mean and deviation of training poses (n, 7); raises UsageError if too wide."""
    reference = geometry.mean_rotation(poses[:, 3:])
    coordinates = Chart("tangent_reference", reference).coordinates(poses, poses)
    spread = float(np.linalg.norm(coordinates[:, 3:], axis=1).max())
    if spread > MAX_SPREAD_RAD:
        raise UsageError(
            f"poses: expected rotations within {MAX_SPREAD_RAD:g} rad of their mean, found one at "
            f"{spread:.2f} rad; the tangent at one reference cannot hold a full turn"
        )
    deviation = coordinates.std(axis=0)
    if not (deviation > 1e-6).all():
        raise UsageError(
            f"poses: expected motion in every degree of freedom, found standard deviations "
            f"{deviation.tolist()}"
        )
    return Target(reference, coordinates.mean(axis=0), deviation)


class PoseGraph(nn.Module):
    """What is exported: images (n, height, width, 3) -> pose (n, 7), lower and upper (n, 6)."""

    def __init__(self, backbone: Backbone, network: CjpNetwork, target: Target) -> None:
        super().__init__()
        self.backbone = backbone
        self.decoded = CjpDecoded(network)
        self.register_buffer("mean", torch.tensor(target.mean, dtype=torch.float32))
        self.register_buffer("std", torch.tensor(target.std, dtype=torch.float32))
        reference = torch.tensor(target.reference_q_xyzw, dtype=torch.float32)
        self.register_buffer("reference", reference)
        self.mean: Tensor
        self.std: Tensor
        self.reference: Tensor

    def forward(self, image: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return pose, lower and upper in metres and radians."""
        point, lower, upper = (
            values * self.std + self.mean for values in self.decoded(self.backbone(image), noise)
        )
        q_xyzw = _multiply(self.reference, _exp(point[:, 3:]))
        return torch.cat([point[:, :3], q_xyzw], dim=1), lower, upper


def _exp(rotvec: Tensor) -> Tensor:
    """Rotation vectors (n, 3) -> quaternions (n, 4); 1e-12 keeps the quotient at zero finite."""
    angle = (rotvec.square().sum(dim=1, keepdim=True) + 1e-12).sqrt()
    return torch.cat([rotvec * (torch.sin(0.5 * angle) / angle), torch.cos(0.5 * angle)], dim=1)


def _multiply(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton product of one quaternion (4,) with many (n, 4), as a constant matrix."""
    x, y, z, w = p
    left = torch.stack(
        [
            torch.stack([w, -z, y, x]),
            torch.stack([z, w, -x, y]),
            torch.stack([-y, x, w, z]),
            torch.stack([-x, -y, -z, w]),
        ]
    )
    return q @ left.T


@dataclass(frozen=True)
class Run:
    """A finished run: what it was asked for and what it learned."""

    config: TrainConfig
    dataset: PoseDataset
    split: Split
    target: Target
    graph: PoseGraph
    weights_sha256: str | None
    history: list[dict[str, float]]

    def lines(self) -> list[str]:
        """Return what was trained as lines of text for a person."""
        counts = ", ".join(f"{role} {indices.size}" for role, indices in self.split.roles.items())
        skipped = ", ".join(f"{count} {reason}" for reason, count in self.dataset.skipped.items())
        best = min(self.history, key=lambda entry: entry["val_score"])
        parameters = sum(parameter.numel() for parameter in self.graph.parameters())
        return [
            f"data set    {self.dataset.name}: {len(self.dataset)} frames, {skipped or 'none'} "
            "skipped",
            f"split       {self.split.kind}: {counts}",
            f"network     {self.config.backbone.name}, {parameters / 1e6:.2f} M parameters",
            f"best        val score {best['val_score']:.3f} at step {best['step']:.0f}",
        ]


def train(run_dir: Path, config: TrainConfig, progress: Progress) -> Run:
    """Train, or go on where an interrupted run of the same configuration stopped.

    Raises UsageError where ``run_dir`` holds another configuration.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    _claim(run_dir, config)
    dataset = open_dataset(config.dataset)
    split = make_split(dataset, config.split, config.seed)
    split.write(run_dir / SPLIT_FILE, dataset)
    torch.manual_seed(config.seed)
    backbone, weights_sha256 = _backbone(config)
    training = np.concatenate([split.roles["train"], split.roles["fit"]])
    target = fit_target(dataset.poses[training])
    extractor = FeatureExtractor(backbone, config.height, config.width)
    features, poses = cached_copies(
        run_dir / FEATURES_FOLDER,
        ModelImages(dataset, training, config.height, config.width, config.crop),
        extractor,
        config.augment,
        config.copies,
        config.seed,
        progress,
    )
    val_images = ModelImages(dataset, split.roles["val"], config.height, config.width, config.crop)
    val_features = np.stack([extractor(image) for image in val_images.images])
    network = CjpNetwork(backbone.size, config.head)
    network.feature_mean.copy_(torch.from_numpy(features.mean((0, 1), dtype=np.float64)))
    # A feature that is nearly always zero would be blown up where it is not.
    deviation = features.std((0, 1), dtype=np.float64)
    network.feature_std.copy_(torch.from_numpy(deviation + 0.1 * deviation.mean()))
    history = _fit_head(
        run_dir / CHECKPOINT_FILE,
        config,
        network,
        (torch.from_numpy(features), torch.tensor(target.standardised(poses), dtype=torch.float32)),
        (torch.from_numpy(val_features), target.standardised(val_images.poses)),
        progress,
    )
    graph = PoseGraph(backbone, network, target).eval()
    torch.save(
        {
            "graph": graph.state_dict(),
            "target": [
                torch.from_numpy(v) for v in (target.reference_q_xyzw, target.mean, target.std)
            ],
            "weights_sha256": weights_sha256,
            "history": history,
        },
        run_dir / NETWORK_FILE,
    )
    return Run(config, dataset, split, target, graph, weights_sha256, history)


def load_run(run_dir: Path, dataset: str | None = None) -> Run:
    """Read a finished run; ``dataset`` says where its data set is now, if it has moved.

    Raises UsageError where the folder holds no finished run, SourceError where the data set is not
    the one that was split.
    """
    path = run_dir / NETWORK_FILE
    if not path.is_file():
        raise UsageError(f"{run_dir}: expected a finished run, found no {NETWORK_FILE}")
    config = msgspec.json.decode((run_dir / CONFIG_FILE).read_bytes(), type=TrainConfig)
    recorded = msgspec.json.decode((run_dir / SPLIT_FILE).read_bytes())
    opened = open_dataset(dataset or config.dataset)
    split = same_split(opened, config.split, config.seed, recorded["sha256"])
    stored = torch.load(path, weights_only=True)
    target = Target(*(values.numpy() for values in stored["target"]))
    backbone = Backbone(config.backbone, config.height, config.width)
    graph = PoseGraph(backbone, CjpNetwork(backbone.size, config.head), target).eval()
    graph.load_state_dict(stored["graph"])
    return Run(config, opened, split, target, graph, stored["weights_sha256"], stored["history"])


def _backbone(config: TrainConfig) -> tuple[Backbone, str | None]:
    backbone = Backbone(config.backbone, config.height, config.width)
    return backbone, load_weights(backbone, config.weights)


def _claim(run_dir: Path, config: TrainConfig) -> None:
    """Write the configuration, or refuse a folder that belongs to another one."""
    path = run_dir / CONFIG_FILE
    content = msgspec.json.format(msgspec.json.encode(config), indent=1)
    if not path.exists():
        path.write_bytes(content)
    elif path.read_bytes() != content:
        raise UsageError(
            f"{run_dir}: expected a new folder or a run of the same options, found another run"
        )


def _fit_head(
    checkpoint: Path,
    config: TrainConfig,
    network: CjpNetwork,
    training: tuple[Tensor, Tensor],
    val: tuple[Tensor, Array],
    progress: Progress,
) -> list[dict[str, float]]:
    """Train on cached copies; leaves the weights that were best on val in ``network``."""
    features, y = training
    copies, frames = features.shape[:2]
    loss = CjpLoss(config.head)
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
    )
    averaging = get_ema_multi_avg_fn(config.averaging)  # type: ignore[no-untyped-call]
    averaged = AveragedModel(network, multi_avg_fn=averaging)
    generator = torch.Generator().manual_seed(config.seed)
    every = max(1, config.steps // 40)
    history: list[dict[str, float]] = []
    best = math.inf
    start = 0
    network.train()
    loss.train()
    for step in range(start, config.steps):
        rate = config.learning_rate * _schedule(step, config.steps)
        for group in optimiser.param_groups:
            group["lr"] = rate
        copy = torch.randint(copies, (config.batch_size,), generator=generator)
        frame = torch.randint(frames, (config.batch_size,), generator=generator)
        mu_noise = torch.randn(config.batch_size, config.head.latent_size)
        prediction = network(features[copy, frame].float(), mu_noise)
        value = loss(prediction, y[copy, frame], warm_up=step < config.warm_up_steps)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        averaged.update_parameters(network)
        if (step + 1) % every == 0:
            score = _val_score(averaged.module, val)
            history.append({"step": step + 1, "loss": value.item(), "val_score": score})
            progress(f"training, val score {score:.3f}", step + 1, config.steps)
            if score < best:
                best = score
                kept = {k: v.clone() for k, v in averaged.module.state_dict().items()}
    network.load_state_dict(kept)
    return history


def _schedule(step: int, steps: int) -> float:
    return min(1.0, (step + 1) / 50) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * step / steps)))


def _val_score(network: CjpNetwork, val: tuple[Tensor, Array]) -> float:
    """Mean interval score at 90 % of the bounds, conformalised on val itself."""
    features, y = val
    network.eval()
    with torch.no_grad():
        _, lower, upper = (v.numpy().astype(np.float64) for v in CjpDecoded(network)(features))
    scores = np.maximum(lower - y, y - upper)
    q = np.array([conformal_quantile(scores[:, d], 0.9) for d in range(6)])
    lower, upper = lower - q, upper + q
    distance = np.maximum(np.maximum(lower - y, y - upper), 0.0)
    return float(interval_score(upper - lower, distance, 0.1).mean())
