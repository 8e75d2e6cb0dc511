"""One training loop: features, steps, early stopping on val, checkpoints.

A run is a series of lessons, most often one. Batches are a function of (seed, lesson, phase, step)
and noise comes from a generator whose state is in the checkpoint: an interrupted run that goes on
ends with the same numbers as one that never was.
"""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, cast

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from cvo_edge.errors import UsageError
from cvo_edge.files import whole_file
from cvo_export.data.splits import Split, deal_folds, make_split, training_frames
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.networks.backbone import Backbone, load_weights
from cvo_export.networks.heads import Setting
from cvo_export.networks.heads.base import Examples, L, Learner
from cvo_export.networks.methods import TRAINABLE
from cvo_export.networks.standardised import Target, fit_target
from cvo_export.progress import Progress, Stage
from cvo_export.training.features import (
    FeatureExtractor,
    ModelImages,
    cached_copies,
    cached_features,
)
from cvo_export.training.run import History, PoseGraph, Run, TrainConfig, claim_run, open_run

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Batch = Callable[[np.random.Generator], tuple[Tensor, Tensor]]

FEATURES_FOLDER = "features"

# Evaluations on val in a phase, and how many without a new best end it. The learning rate falls as
# a cosine, so most of the gain comes late: patience is long.
_EVALUATIONS = 40
_PATIENCE = 20

# Fewer scores support no finite threshold at 0.9.
_LEAST_VAL = 9

# An image costs the backbone a hundred times what its features cost the head.
_IMAGE_BATCH = 16


def train(run_dir: Path, config: TrainConfig, progress: Progress, cache: Path | None = None) -> Run:
    """Train, or go on where an interrupted run of the same configuration stopped.

    Features of the pretrained network are kept in the run's folder, or in a folder of ``cache``
    that all runs with the same frames, network and augmentation share.

    Raises UsageError where ``run_dir`` holds another configuration, or where val has too few frames
    to decide anything.
    """
    dataset, split = open_run(run_dir, config)
    _check_val(config, split)
    torch.manual_seed(config.seed)
    backbone = Backbone(config.backbone, config.height, config.width)
    weights_sha256 = load_weights(backbone, config.weights)
    parts = training_frames(dataset, split, config.share)
    indices = np.concatenate(parts)
    target = fit_target(dataset.poses[indices])
    claim_run(run_dir, config, dataset, split)
    size = (config.height, config.width, config.crop)
    images = ModelImages(dataset, indices, *size)
    # Random weights are the run's own.
    features_folder = run_dir / f"{FEATURES_FOLDER}-0"
    if cache is not None and weights_sha256 is not None:
        features_folder = _shared_folder(cache, config, weights_sha256, images)
    trainer = _Trainer(
        _Material(
            run_dir,
            features_folder,
            config,
            backbone,
            target,
            images,
            ModelImages(dataset, split.roles["val"], *size),
            progress,
        ),
        n_train=parts[0].size,
        folds=partial(deal_folds, dataset, split, indices),
    )
    head = TRAINABLE[config.method].train(trainer, config.head)
    graph = PoseGraph(backbone, head).eval()
    run = Run(config, dataset, split, target, graph, weights_sha256, trainer.history)
    run.save(run_dir)
    return run


def check_roles(config: TrainConfig, dataset: PoseDataset) -> None:
    """Raise UsageError where a run's data set cannot be split, or val is too small to decide."""
    _check_val(config, make_split(dataset, config.split, config.seed))


def _check_val(config: TrainConfig, split: Split) -> None:
    if split.roles["val"].size < _LEAST_VAL:
        raise UsageError(
            f"{config.dataset}: expected at least {_LEAST_VAL} frames of the role val, which "
            f"decides by intervals of 0.9, found {split.roles['val'].size}"
        )


def prepare_features(config: TrainConfig, cache: Path, progress: Progress) -> None:
    """Compute the features that runs of this configuration share, so that each finds them.

    Features of random weights are a run's own: then nothing is done.
    """
    dataset = open_dataset(config.dataset)
    split = make_split(dataset, config.split, config.seed)
    indices = np.concatenate(training_frames(dataset, split, config.share))
    backbone = Backbone(config.backbone, config.height, config.width)
    weights_sha256 = load_weights(backbone, config.weights)
    if weights_sha256 is None:
        return
    size = (config.height, config.width, config.crop)
    images = ModelImages(dataset, indices, *size)
    folder = _shared_folder(cache, config, weights_sha256, images)
    extractor = FeatureExtractor(backbone, config.height, config.width)
    cached_features(folder, ModelImages(dataset, split.roles["val"], *size), extractor)
    cached_copies(
        folder,
        images,
        extractor,
        config.augment,
        config.copies,
        config.seed,
        progress,
    )


@dataclass
class _Material:
    """What all lessons of a run learn from, and where they are kept."""

    run_dir: Path
    features_folder: Path
    config: TrainConfig
    backbone: Backbone
    target: Target
    images: ModelImages
    val_images: ModelImages
    progress: Progress

    def __post_init__(self) -> None:
        self.val_y = self.target.standardised(self.val_images.poses)
        self._cached: dict[int, tuple[NDArray[np.float16], Array, Tensor]] = {}

    def cached(self, phase: int) -> tuple[NDArray[np.float16], Array, Tensor]:
        """Features and poses of all copies, features of val, by the backbone as it is in a phase.

        Shapes (copies + 1, n, size), (copies + 1, n, 7) and (n_val, size).
        """
        if phase not in self._cached:
            config, folder = self.config, self.features_folder
            if phase > 0:
                # A backbone that has learnt is this run's alone.
                folder = self.run_dir / f"{FEATURES_FOLDER}-{phase}"
            extractor = FeatureExtractor(self.backbone, config.height, config.width)
            val = cached_features(folder, self.val_images, extractor)
            features, poses = cached_copies(
                folder,
                self.images,
                extractor,
                config.augment,
                config.copies,
                config.seed,
                self.progress,
            )
            self._cached = {phase: (features, poses, torch.from_numpy(val))}
        return self._cached[phase]

    def examples(self, phase: int) -> Examples:
        """Features and standardised poses."""
        features, poses, val = self.cached(phase)
        return Examples(features, self.target.standardised(poses), val, self.val_y)


class _Trainer:
    """The lessons of a run; see ``cvo_export.networks.heads.base.Lessons``.

    A run that fine-tunes its backbone has one lesson on features: another would learn from others.
    """

    def __init__(
        self, material: _Material, n_train: int, folds: Callable[[int], list[Indices]]
    ) -> None:
        self.setting = Setting(material.backbone.size, material.target, material.config.seed)
        self.n_images = len(material.images)
        self.n_train = n_train
        self.fine_tuned = material.config.fine_tune > 0
        self.folds = folds
        self.history: list[History] = []
        self._material = material

    def learn(
        self,
        name: str,
        build: Callable[[], L],
        rows: Indices | None = None,
        examples: Examples | None = None,
        candidate: bool = True,
    ) -> L:
        """Train what ``build`` makes, with random numbers of its own name."""
        if self.fine_tuned and self.history and examples is None:
            raise UsageError(f"fine-tune: expected a method of one lesson, found another, {name}")
        torch.manual_seed(_lesson_seed(self.setting.seed, name))
        learner = build()
        if rows is None:
            rows = np.arange(self.n_images if examples is None else examples.x.shape[1])
        lesson = _Lesson(self._material, name, learner, rows, examples, candidate)
        self.history += lesson.fit()
        return learner

    def poses(self) -> Array:
        """Poses of the training images."""
        return self._material.images.poses

    def features(self) -> tuple[NDArray[np.float16], Array]:
        """Features and poses of all copies of the training images, by the backbone as learnt."""
        features, poses, _ = self._material.cached(self._last_phase)
        return features, poses

    def val(self) -> tuple[Tensor, Array]:
        """Features and poses of val, by the backbone as learnt."""
        return self._material.cached(self._last_phase)[2], self._material.val_images.poses

    @property
    def _last_phase(self) -> int:
        return 2 if self.fine_tuned else 0


class _Lesson:
    """The phases of a lesson: the head on cached features; with fine-tuning all, then it again."""

    def __init__(
        self,
        material: _Material,
        name: str,
        learner: Learner,
        rows: Indices,
        examples: Examples | None,
        candidate: bool,
    ) -> None:
        self.material = material
        self.config = material.config
        self.name = name
        self.learner = learner
        self.rows = rows
        self._examples = examples
        self._candidate = candidate
        self.both = nn.ModuleDict({"backbone": material.backbone, "learner": learner})
        self.history: list[History] = []
        self._seed = _lesson_seed(self.config.seed, name)
        self._path = material.run_dir / f"checkpoint-{name}.pt"

    def fit(self) -> list[History]:
        """Run all phases, from the checkpoint if there is one; returns the history."""
        checkpoint = self._read_checkpoint()
        first = checkpoint["phase"] if checkpoint else 0
        phases = 3 if self.config.fine_tune and self._examples is None else 1
        for phase in range(first, phases):
            state = checkpoint if checkpoint and phase == first else None
            if phase == 1:
                self._fit_all(phase, state)
            else:
                self._fit_head(phase, state)
        return self.history

    def _fit_head(self, phase: int, state: dict[str, Any] | None) -> None:
        """Train the head on features of augmented copies, computed by the present backbone."""
        if state is not None and state["ended"]:
            self._keep(phase, state["best"])
            return
        examples = self._examples or self.material.examples(phase)
        if phase == 0:
            self.learner.standardise.fit(examples.x[:, self.rows])
        x = torch.from_numpy(examples.x)
        y = torch.tensor(examples.y, dtype=torch.float32)

        def batch(generator: np.random.Generator) -> tuple[Tensor, Tensor]:
            copy = generator.integers(x.shape[0], size=self.config.batch_size)
            frame = self.rows[generator.integers(self.rows.size, size=self.config.batch_size)]
            return x[copy, frame].float(), y[copy, frame]

        groups = [{"params": list(self.learner.parameters()), "peak": self.config.learning_rate}]
        with _one_thread():
            val = examples.val_x, examples.val_y
            self._loop(phase, "training", groups, self.config.steps, batch, lambda _: val, state)

    def _fit_all(self, phase: int, state: dict[str, Any] | None) -> None:
        """Train backbone and head together on fresh augmented images."""
        images, val_images = self.material.images, self.material.val_images
        # Batch statistics of 16 images are too noisy: the running ones stay.
        self.material.backbone.eval()

        def batch(generator: np.random.Generator) -> tuple[Tensor, Tensor]:
            rows = self.rows[generator.integers(self.rows.size, size=_IMAGE_BATCH)]
            augment = self.config.augment
            drawn = [
                images.augmented(row, augment.graded(generator.random()), generator)
                for row in rows.tolist()
            ]
            y = self.material.target.standardised(np.stack([pose for _, pose in drawn]))
            stacked = torch.from_numpy(np.stack([image for image, _ in drawn]))
            return self.material.backbone(stacked), torch.tensor(y, dtype=torch.float32)

        def val(averaged: nn.Module) -> tuple[Tensor, Array]:
            with torch.no_grad():
                backbone = averaged.get_submodule("backbone")
                images = torch.from_numpy(val_images.images)
                starts = range(0, len(images), _IMAGE_BATCH)
                features = [backbone(images[i : i + _IMAGE_BATCH]) for i in starts]
            return torch.cat(features), self.material.val_y

        groups = [
            # The head is trained already: a full rate would undo it.
            {"params": list(self.learner.parameters()), "peak": 0.3 * self.config.learning_rate},
            {
                "params": list(self.material.backbone.parameters()),
                "peak": self.config.backbone_learning_rate,
            },
        ]
        steps = self.config.fine_tune * math.ceil(self.rows.size / _IMAGE_BATCH)
        self._loop(phase, "fine-tuning", groups, steps, batch, val, state)

    def _loop(
        self,
        phase: int,
        stage: Stage,
        groups: list[dict[str, Any]],
        steps: int,
        batch: Batch,
        val: Callable[[nn.Module], tuple[Tensor, Array]],
        state: dict[str, Any] | None,
    ) -> None:
        """Run one phase; what learns ends with the averaged weights that were best on val."""
        config = self.config
        optimiser = torch.optim.AdamW(groups, weight_decay=config.weight_decay)
        averaging = get_ema_multi_avg_fn(config.averaging)  # type: ignore[no-untyped-call]
        learning = self._learning(phase)
        averaged = AveragedModel(learning, multi_avg_fn=averaging)
        best: dict[str, Any] = {"score": math.inf, "weights": _cloned(learning), "count": 0}
        start = 0
        if state is not None:
            optimiser.load_state_dict(state["optimiser"])
            averaged.load_state_dict(state["averaged"])
            best, start = state["best"], state["step"]
            torch.set_rng_state(state["torch_rng"])
        every = max(1, steps // _EVALUATIONS)
        for step in range(start, steps):
            if best["count"] >= _PATIENCE:
                break
            for group in optimiser.param_groups:
                group["lr"] = group["peak"] * _schedule(step, steps)
            self.learner.train()
            features, y = batch(np.random.default_rng((self._seed, phase, step)))
            warm_up = phase == 0 and step < config.warm_up_steps
            value = self.learner.loss(features, y, warm_up)
            optimiser.zero_grad()
            value.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            averaged.update_parameters(learning)
            if (step + 1) % every == 0 or step + 1 == steps:
                module = averaged.module
                learner = cast("Learner", module.get_submodule("learner")).eval()
                with torch.no_grad():
                    score = learner.val_score(*val(module))
                if score < best["score"]:
                    best = {"score": score, "weights": _cloned(module), "count": 0}
                else:
                    best["count"] += 1
                self.history.append(
                    History(self.name, phase, step + 1, value.item(), float(score), self._candidate)
                )
                ended = step + 1 == steps or best["count"] >= _PATIENCE
                self._write_checkpoint(phase, step + 1, ended, optimiser, averaged, best)
                self.material.progress(
                    stage, step + 1, steps, f"{self.name}, val score {score:.3f}"
                )
        self._keep(phase, best)

    def _learning(self, phase: int) -> nn.ModuleDict:
        """What learns in a phase: averaging a frozen backbone would take as long as the head."""
        return self.both if phase == 1 else nn.ModuleDict({"learner": self.learner})

    def _keep(self, phase: int, best: dict[str, Any]) -> None:
        self._learning(phase).load_state_dict(best["weights"])
        self.learner.eval()

    def _write_checkpoint(
        self,
        phase: int,
        step: int,
        ended: bool,
        optimiser: torch.optim.Optimizer,
        averaged: AveragedModel,
        best: dict[str, Any],
    ) -> None:
        state = {
            "phase": phase,
            "step": step,
            "ended": ended,
            "weights": self.both.state_dict(),
            "optimiser": optimiser.state_dict(),
            "averaged": averaged.state_dict(),
            "best": best,
            "history": [tuple(entry) for entry in self.history],
            "torch_rng": torch.get_rng_state(),
        }
        with whole_file(self._path) as stream:
            torch.save(state, stream)

    def _read_checkpoint(self) -> dict[str, Any] | None:
        if not self._path.is_file():
            return None
        try:
            state: dict[str, Any] = torch.load(self._path, weights_only=True)
            self.both.load_state_dict(state["weights"])
            self._learning(state["phase"]).load_state_dict(state["best"]["weights"])
            self.both.load_state_dict(state["weights"])
            self.history = [History(*entry) for entry in state["history"]]
        # What torch raises for another network's file, and History for another release's entries.
        except (RuntimeError, KeyError, TypeError, UnpicklingError, EOFError):
            raise UsageError(
                f"{self._path}: expected a checkpoint of this version, found another file; remove "
                "it to train anew"
            ) from None
        return state


def _shared_folder(
    cache: Path, config: TrainConfig, weights_sha256: str, images: ModelImages
) -> Path:
    """Where the pretrained network's features of these images are kept in a shared cache.

    The name is a digest of everything that decides them.
    """
    decisive = {
        "weights": weights_sha256,
        "backbone": msgspec.to_builtins(config.backbone),
        "image": [config.height, config.width, config.crop],
        "augment": [msgspec.to_builtins(config.augment), config.copies, config.seed],
        "intrinsics": None if images.K is None else images.K.tolist(),
        "pixels": images.digest(),
        "poses": images.poses.tolist(),
    }
    text = json.dumps(decisive, sort_keys=True)
    return cache / hashlib.sha256(text.encode()).hexdigest()[:24]


def _cloned(module: nn.Module) -> dict[str, Tensor]:
    return {key: value.clone() for key, value in module.state_dict().items()}


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep torch to one thread: a batch of 64 rows is too little for two to share."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _lesson_seed(seed: int, name: str) -> int:
    """One seed a lesson, so that none depends on how much randomness those before it used."""
    return int(np.random.SeedSequence((seed, zlib.crc32(name.encode()))).generate_state(1)[0])


def _schedule(step: int, steps: int) -> float:
    return min(1.0, (step + 1) / 50) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * step / steps)))
