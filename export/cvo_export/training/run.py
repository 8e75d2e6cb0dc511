"""A training run: its options, its folder and its result."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
import torch
from msgspec import UNSET, Meta, UnsetType
from torch import Tensor, nn

from cvo_edge.errors import SinkError, UsageError
from cvo_edge.files import whole_file, write_whole
from cvo_edge.given import given_path
from cvo_edge.vocabulary import Crop, SplitKind
from cvo_export.bundles.draft import still_text
from cvo_export.data.augment import AugmentConfig
from cvo_export.data.splits import (
    Indices,
    Split,
    crossed_folds,
    crossed_frames,
    make_split,
    read_split_spec,
    same_split,
    training_frames,
)
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.datasets.sizes import one_size
from cvo_export.networks.backbone import NO_WEIGHTS, Backbone, BackboneConfig, load_weights
from cvo_export.networks.heads import ExportedHead, Setting
from cvo_export.networks.methods import TRAINABLE, options_of
from cvo_export.networks.standardised import Target
from cvo_export.networks.stem import Stem, Upper, split_backbone

CONFIG_FILE = "config.json"
SPLIT_FILE = "split.json"
NETWORK_FILE = "network.pt"


@dataclass(frozen=True)
class TrainConfig:
    """All options that determine a run; stored in ``config.json``.

    Attributes
    ----------
    dataset, split, seed
        Training data; the seed determines split, training and noise.
    height, width, crop
        The model's input size and the part of the image it shows.
    backbone, weights
        The image network and the source of its weights (``timm``, ``none`` or a file).
    augment, copies
        How the copies of each training frame are augmented, and how many there are.
    head
        The method's options struct: the network after the backbone and its loss.
    steps, batch_size, learning_rate, weight_decay
        AdamW on cached features; the rate rises over 50 steps and then follows a cosine.
    warm_up_steps
        Steps before the loss includes the calibration term.
    averaging
        Decay of the moving average of the weights, which is evaluated and saved.
    fine_tune, backbone_learning_rate
        Epochs that train the backbone as well, on fresh augmented images; afterwards the copies'
        features are recomputed and the head is trained again.
    share
        Fraction of the training frames used, to study how much data a method needs.
    folds
        Folds of a crossed run, where the recordings of train, fit and cal all train and calibrate.
        Unset by default, which leaves ``config.json`` and the names of a study's cells as they
        were.
    noise
        Share of the augmented copies that is degraded by one of the study's noises, each at 0.3 to
        1 of its default strength; unset by default, too.
    """

    dataset: str
    split: SplitKind
    head: Any
    seed: int = 0
    height: int = 192
    width: int = 256
    crop: Crop = "none"
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    weights: str = "timm"
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    copies: int = 48
    steps: int = 10_000
    warm_up_steps: int = 200
    batch_size: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 1e-3
    averaging: float = 0.995
    fine_tune: int = 0
    backbone_learning_rate: float = 3e-4
    share: Annotated[float, Meta(gt=0, le=1)] = 1.0
    folds: Annotated[int, Meta(ge=2)] | UnsetType = UNSET
    noise: Annotated[float, Meta(gt=0, le=1)] | UnsetType = UNSET

    @property
    def crossed(self) -> int:
        """Number of folds of a crossed run; 0 for others."""
        return 0 if self.folds is UNSET else self.folds

    @property
    def noisy(self) -> float:
        """Share of the augmented copies that have noise; 0 for most runs."""
        return 0.0 if self.noise is UNSET else self.noise

    @property
    def method(self) -> str:
        """Name of the method or baseline: the tag of its options."""
        return str(self.head.__struct_config__.tag)

    @property
    def cells(self) -> bool:
        """Whether the method reads the map of a stem and trains the stages after it."""
        return TRAINABLE[self.method].cells


def decode_config(content: bytes) -> TrainConfig:
    """Decode the content of ``config.json``; raises msgspec.MsgspecError if it is invalid.

    The method's options are decoded separately: a method may have been registered after this module
    was imported.
    """
    config = msgspec.json.decode(content, type=TrainConfig)
    return replace(config, head=options_of(config.head))


class History(NamedTuple):
    """One evaluation on val.

    ``candidate`` tells whether val may select the network; it is False for networks of folds and
    models of residuals.
    """

    lesson: str
    phase: int
    step: int
    loss: float
    val_score: float
    candidate: bool


class PoseGraph(nn.Module):
    """The exported graph: images (n, height, width, 3), uint8 RGB -> the method's outputs."""

    def __init__(self, backbone: Backbone | Stem, head: ExportedHead) -> None:
        super().__init__()
        self.backbone = backbone
        self.head = head

    def forward(self, image: Tensor, *extra: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs that ``head.output_names`` names."""
        outputs: tuple[Tensor, ...] = self.head(self.backbone(image), *extra)
        return outputs


@dataclass(frozen=True)
class Run:
    """A finished run: its configuration, its trained network and its history.

    ``folds`` are the heads of a crossed run that were trained without the recordings of each fold,
    in the order of ``fold_frames``; empty for other runs.
    """

    config: TrainConfig
    dataset: PoseDataset
    split: Split
    target: Target
    graph: PoseGraph
    weights_sha256: str | None
    history: list[History]
    folds: tuple[ExportedHead, ...] = ()

    @property
    def training_frames(self) -> Indices:
        """Frame numbers that the run had for training, even if it used a share of them."""
        if self.config.crossed:
            return crossed_frames(self.dataset, self.split)
        return np.concatenate(training_frames(self.dataset, self.split, 1.0))

    @property
    def fold_frames(self) -> list[Indices]:
        """Frame numbers of each fold of a crossed run."""
        count = self.config.crossed
        return crossed_folds(self.dataset, self.split, count) if count else []

    def save(self, run_dir: Path) -> None:
        """Write the result of training atomically; raises SinkError."""
        content = {
            "backbone": self.graph.backbone.state_dict(),
            "head": self.graph.head.state_dict(),
            "target": [torch.from_numpy(values) for values in self.target.arrays()],
            "weights_sha256": self.weights_sha256,
            "history": [tuple(entry) for entry in self.history],
            "folds": [head.state_dict() for head in self.folds],
        }
        with whole_file(run_dir / NETWORK_FILE) as stream:
            torch.save(content, stream)

    @property
    def best(self) -> History:
        """The evaluation of the saved weights: the best candidate of the last phase."""
        last_phase = max(entry.phase for entry in self.history)
        return min(
            (entry for entry in self.history if entry.phase == last_phase and entry.candidate),
            key=lambda entry: entry.val_score,
        )

    def lines(self) -> list[str]:
        """Return a summary of the run as lines of text."""
        sizes = {role: indices.size for role, indices in self.split.roles.items()}
        if self.config.crossed:
            together = sum(sizes.pop(role) for role in ("train", "fit", "cal"))
            sizes = {f"train and cal in {self.config.crossed} folds": together, **sizes}
        counts = ", ".join(f"{role} {size}" for role, size in sizes.items())
        best = self.best
        parameters = sum(parameter.numel() for parameter in self.graph.parameters())
        lines = [f"split       {self.split.kind}: {counts}"]
        if self.split.blocks is not None and self.split.blocks.cost is not None:
            lines.append(f"            {self.split.blocks.cost}")
        if self.target.turns:
            lines.append("rotation    any: bounds are offsets from each prediction")
        if self.target.still_dof:
            lines.append(f"still       {still_text(self.target.still_dof)}")
        return [
            *lines,
            f"network     {self.config.backbone.name}, {parameters / 1e6:.2f} M parameters",
            f"best        val score {best.val_score:.3f} at step {best.step} ({best.lesson})",
        ]


def loaded_backbone(
    config: TrainConfig, weights: str
) -> tuple[Backbone | Stem, Upper | None, str | None]:
    """Return the run's backbone and the sha256 of its weights.

    A method with cells gets a stem and, as the second value, the stages after it. Raises
    UsageError.
    """
    size = config.height, config.width
    if config.cells:
        return split_backbone(config.backbone, *size, weights)
    backbone = Backbone(config.backbone, *size)
    return backbone, None, load_weights(backbone, weights)


def open_run(run_dir: Path, config: TrainConfig) -> tuple[PoseDataset, Split]:
    """Open the data set of a configuration and split it; writes nothing.

    Raises UsageError if the folder belongs to another configuration, SourceError if the images have
    several sizes.
    """
    path = run_dir / CONFIG_FILE
    if run_dir.exists() and not run_dir.is_dir():
        raise SinkError(f"{run_dir}: expected a folder, found a file")
    if path.is_file() and path.read_bytes() != _encoded(config):
        raise UsageError(
            f"{run_dir}: expected a new folder or a run of the same options, found another run; "
            "choose another folder"
        )
    dataset = open_dataset(config.dataset)
    one_size(dataset)
    return dataset, make_split(dataset, config.split, config.seed)


def claim_run(run_dir: Path, config: TrainConfig, dataset: PoseDataset, split: Split) -> None:
    """Write configuration and split, once all checks have passed.

    Raises SinkError if the folder cannot be written.
    """
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SinkError(f"{run_dir}: cannot be written: {error.strerror}") from None
    split.write(run_dir / SPLIT_FILE, dataset)
    write_whole(run_dir / CONFIG_FILE, _encoded(config))


def _encoded(config: TrainConfig) -> bytes:
    return msgspec.json.format(msgspec.json.encode(config), indent=1)


def load_run(run_dir: str | os.PathLike[str], dataset: str | None = None) -> Run:
    """Read a finished run; ``dataset`` is the new location of its data set, if it has moved.

    Raises UsageError if the folder holds no finished run, SourceError if the data set is not the
    one that was split.
    """
    run_dir = given_path(run_dir, "run folder")
    path = run_dir / NETWORK_FILE
    if not path.is_file():
        raise UsageError(f"{run_dir}: expected a finished run, found no {NETWORK_FILE}")
    try:
        config = decode_config((run_dir / CONFIG_FILE).read_bytes())
        recorded = read_split_spec(run_dir / SPLIT_FILE)
    # Whatever a damaged file makes of these readers.
    except Exception as error:  # noqa: BLE001
        line = " ".join(str(error).split())[:120]
        raise UsageError(f"{run_dir}: cannot read the files of the run: {line}") from None
    opened = open_dataset(dataset or config.dataset)
    split = same_split(opened, recorded)
    backbone, upper, _ = loaded_backbone(config, NO_WEIGHTS)
    restore = TRAINABLE[config.method].restore
    try:
        stored = torch.load(path, weights_only=True)
        target = Target.of_arrays([values.numpy() for values in stored["target"]])
        setting = Setting(backbone.size, target, config.seed, upper)
        backbone.load_state_dict(stored["backbone"])
        head = restore(setting, config.head, stored["head"])
        # A run of an earlier release has no key for folds.
        folds = tuple(
            restore(setting, config.head, state).eval() for state in stored.get("folds", ())
        )
        history = [History(*entry) for entry in stored["history"]]
        weights_sha256, _ = stored["weights_sha256"], history[-1]
    except MemoryError:
        raise
    # torch passes on any error of its unpickler and its zip reader; a file may hold anything.
    except Exception:  # noqa: BLE001
        raise UsageError(
            f"{path}: expected a network of this release, as train writes it, found another file; "
            "copy the run again, or train it again"
        ) from None
    graph = PoseGraph(backbone, head).eval()
    return Run(config, opened, split, target, graph, weights_sha256, history, folds)
