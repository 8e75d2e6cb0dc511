"""The training loop: features, steps, early stopping on val, checkpoints.

A run is a series of lessons, usually a single one. A crossed run trains a head on all recordings
and, for each fold of them, one without it; all use rows of the same features. Batches are a
function of (seed, lesson, phase, step), and noise comes from a generator whose state is in the
checkpoint: a resumed run ends with the same numbers as an uninterrupted one.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvo_edge.camera import Camera
from cvo_edge.errors import UsageError
from cvo_edge.given import given_path
from cvo_export.data.place import Place
from cvo_export.data.sparse_map import SparseMap, read_sparse_map, sparse_map, write_sparse_map
from cvo_export.data.splits import (
    Split,
    crossed_folds,
    crossed_frames,
    deal_folds,
    make_split,
    network_rows,
    training_frames,
)
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.datasets.motion import MAX_SPREAD_RAD
from cvo_export.networks.heads import Setting
from cvo_export.networks.heads.base import Examples, L, Schedule
from cvo_export.networks.methods import TRAINABLE
from cvo_export.networks.standardised import Target, fit_target
from cvo_export.networks.stem import Upper
from cvo_export.progress import Progress
from cvo_export.training.features import (
    FeatureExtractor,
    ModelImages,
    cached_copies,
    cached_features,
)
from cvo_export.training.lesson import Lesson, lesson_seed
from cvo_export.training.material import FEATURES_FOLDER, Material, shared_folder
from cvo_export.training.run import (
    History,
    PoseGraph,
    Run,
    TrainConfig,
    claim_run,
    loaded_backbone,
    open_run,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
G = TypeVar("G", bound=np.generic)

MAP_FILE = "map.npz"

# With fewer scores, the threshold at 0.9 is not finite.
_LEAST_VAL = 9


def train(
    run_dir: str | os.PathLike[str],
    config: TrainConfig,
    progress: Progress,
    cache: str | os.PathLike[str] | None = None,
) -> Run:
    """Train, or resume an interrupted run of the same configuration.

    Features of the pretrained network are stored in the run's folder, or in a folder of ``cache``
    that all runs with the same frames, network and augmentation share.

    Raises UsageError if ``run_dir`` holds another configuration, if val has too few frames to
    select a network, or if the run cannot be crossed.
    """
    run_dir = given_path(run_dir, "run folder")
    cache = None if cache is None else given_path(cache, "cache")
    dataset, split = open_run(run_dir, config)
    _check_val(config, split)
    _check_crossed(config, dataset, split)
    torch.manual_seed(config.seed)
    backbone, upper, weights_sha256 = loaded_backbone(config, config.weights)
    indices, n_train = _training_frames(config, dataset, split)
    poses = dataset.local_poses
    target = fit_target(poses[indices], poses)
    _check_turns(config, target)
    if len(target.still_dof) == 6:
        raise UsageError(
            f"{dataset.name}: expected a camera that moves, found hardly a change of the pose in "
            f"{indices.size} training frames"
        )
    claim_run(run_dir, config, dataset, split)
    size = (config.height, config.width, config.crop)
    images = ModelImages(dataset, indices, *size)
    # Random weights differ between runs: do not share their features.
    features_folder = run_dir / f"{FEATURES_FOLDER}-0"
    if cache is not None and weights_sha256 is not None:
        features_folder = shared_folder(cache, config, weights_sha256, images)
    trainer = _Trainer(
        Material(
            run_dir,
            features_folder,
            config,
            backbone,
            target,
            images,
            ModelImages(dataset, split.roles["val"], *size),
            progress,
        ),
        dataset,
        split,
        upper,
        indices,
        n_train,
    )
    method = TRAINABLE[config.method]
    graph = PoseGraph(backbone, method.train(trainer, config.head)).eval()
    folds = [
        method.train(trainer.without(fold, number), config.head).eval()
        for number, fold in enumerate(_folds(config, dataset, split))
    ]
    run = Run(config, dataset, split, target, graph, weights_sha256, trainer.history, tuple(folds))
    run.save(run_dir)
    return run


def _check_turns(config: TrainConfig, target: Target) -> None:
    """Raise UsageError if the rotations need a method that learns any rotation."""
    if target.turns and not TRAINABLE[config.method].turns:
        known = ", ".join(name for name, method in TRAINABLE.items() if method.turns)
        raise UsageError(
            f"poses: expected rotations within {MAX_SPREAD_RAD:g} rad of their mean for the method "
            f"{config.method}, found wider ones; these methods learn any rotation: {known}"
        )


def check_roles(config: TrainConfig, dataset: PoseDataset) -> None:
    """Raise UsageError if the data set cannot be split, or val is too small."""
    _check_val(config, make_split(dataset, config.split, config.seed))


def _check_val(config: TrainConfig, split: Split) -> None:
    if split.roles["val"].size < _LEAST_VAL:
        raise UsageError(
            f"{config.dataset}: expected at least {_LEAST_VAL} frames of the role val for "
            f"intervals at 0.9, found {split.roles['val'].size}"
        )


def _check_crossed(config: TrainConfig, dataset: PoseDataset, split: Split) -> None:
    """Raise UsageError if the options of a run or its data set do not allow its folds."""
    if not config.crossed:
        return
    if config.cells:
        known = ", ".join(name for name, method in TRAINABLE.items() if not method.cells)
        raise UsageError(
            f"folds: expected a method that trains a head on features ({known}), found "
            f"{config.method}"
        )
    if config.split != "sequence":
        raise UsageError(f"folds: expected --split sequence, found {config.split}")
    if config.fine_tune:
        raise UsageError(
            "folds: expected a frozen backbone, because a fine-tuned one has seen every recording, "
            f"found --fine-tune {config.fine_tune}"
        )
    if config.share != 1.0:
        raise UsageError(f"folds: expected all training frames, found a share of {config.share:g}")
    recordings = np.unique(dataset.sequence[crossed_frames(dataset, split)]).size
    if config.crossed > recordings:
        raise UsageError(
            f"folds: expected at most one for each of the {recordings} recordings for training and "
            f"calibration, found {config.crossed}"
        )


def _training_frames(
    config: TrainConfig, dataset: PoseDataset, split: Split
) -> tuple[Indices, int]:
    """Return the frame numbers of the training images, and how many of them, the first, are train.

    The others are fit.
    """
    if config.crossed:
        indices = crossed_frames(dataset, split)
        return indices, network_rows(dataset, indices)
    parts = training_frames(dataset, split, config.share)
    return np.concatenate(parts), parts[0].size


def _folds(config: TrainConfig, dataset: PoseDataset, split: Split) -> list[Indices]:
    return crossed_folds(dataset, split, config.crossed) if config.crossed else []


def prepare_features(config: TrainConfig, cache: Path, progress: Progress) -> None:
    """Compute the features that runs of this configuration share.

    Does nothing for random weights, whose features are not shared.
    """
    dataset = open_dataset(config.dataset)
    split = make_split(dataset, config.split, config.seed)
    indices, _ = _training_frames(config, dataset, split)
    backbone, _, weights_sha256 = loaded_backbone(config, config.weights)
    if weights_sha256 is None:
        return
    size = (config.height, config.width, config.crop)
    images = ModelImages(dataset, indices, *size)
    folder = shared_folder(cache, config, weights_sha256, images)
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
        config.noisy,
    )


class _Trainer:
    """The lessons of a run; see ``cvo_export.networks.heads.base.Lessons``.

    A run that fine-tunes its backbone can have only one lesson on features: a second lesson would
    use features of a different backbone.

    Parameters
    ----------
    indices
        Frame numbers of the material's images.
    n_train
        How many of the images the lessons use, the first, have the role train.
    rows
        Images that the lessons use, if not all.
    prefix
        Start of the lessons' names.
    """

    def __init__(
        self,
        material: Material,
        dataset: PoseDataset,
        split: Split,
        upper: Upper | None,
        indices: Indices,
        n_train: int,
        rows: Indices | None = None,
        prefix: str = "",
    ) -> None:
        self.setting = Setting(material.backbone.size, material.target, material.config.seed, upper)
        self._dataset, self._split, self._indices = dataset, split, indices
        self._rows, self._prefix = rows, prefix
        self.n_run = len(material.images)
        self.n_images = self.n_run if rows is None else rows.size
        self.n_train = n_train
        self.fine_tuned = material.config.fine_tune > 0
        self.history: list[History] = []
        self._material = material

    def without(self, frames: Indices, number: int) -> _Trainer:
        """Return the lessons of the same run without these frames, the fold of this number.

        They share the history. Val selects no network among theirs.
        """
        rows = np.flatnonzero(~np.isin(self._indices, frames))
        part = _Trainer(
            self._material,
            self._dataset,
            self._split,
            self.setting.upper,
            self._indices,
            network_rows(self._dataset, self._indices[rows]),
            rows,
            f"without{number}-",
        )
        part.history = self.history
        return part

    def folds(self, count: int) -> list[Indices]:
        """Split the rows of the training images into folds, by the unit of the data split."""
        return deal_folds(self._dataset, self._split, self._of_rows(self._indices), count)

    def learn(
        self,
        name: str,
        build: Callable[[], L],
        rows: Indices | None = None,
        examples: Examples | None = None,
        candidate: bool = True,
        schedule: Schedule | None = None,
    ) -> L:
        """Train the network made by ``build``; random numbers depend on ``name``."""
        if self.fine_tuned and self.history and examples is None:
            raise UsageError(
                f"fine-tune: the method trains another network ({name}) on the features; use 0"
            )
        name = self._prefix + name
        torch.manual_seed(lesson_seed(self.setting.seed, name))
        learner = build()
        if rows is None:
            rows = np.arange(self.n_images if examples is None else examples.x.shape[1])
        if examples is None and self._rows is not None:
            rows = self._rows[rows]
        if schedule is None:
            config = self._material.config
            schedule = Schedule(None, config.batch_size, config.learning_rate)
        candidate = candidate and self._rows is None
        lesson = Lesson(self._material, name, learner, rows, examples, candidate, schedule)
        self.history += lesson.fit()
        return learner

    def _of_rows(self, values: NDArray[G], axis: int = 0) -> NDArray[G]:
        """Return the values of this trainer's images among those of all images of the run."""
        return values if self._rows is None else values.take(self._rows, axis)

    def poses(self) -> Array:
        """Poses of the training images."""
        return self._of_rows(self._material.images.poses)

    def place(self) -> Place:
        """Return the place that the training images show; its map is cached in the run's folder."""
        config, camera = self._material.config, self._dataset.camera()
        if camera is None or self._material.images.camera is None or self.setting.upper is None:
            raise UsageError(
                f"{config.dataset}: expected the camera's intrinsics for {config.method}, found "
                "none in the data set"
            )
        return Place(
            self._sparse_map(camera),
            self._material.images.camera,
            self.setting.upper.grid,
            config.augment.zooms(config.copies),
        )

    def _sparse_map(self, camera: Camera) -> SparseMap:
        path = self._material.run_dir / MAP_FILE
        found = read_sparse_map(path)
        if found is None:
            found = sparse_map(
                lambda row: self._dataset.read_image(int(self._indices[row])),
                self._material.images.poses,
                camera,
                self.setting.seed,
                lambda done, total: self._material.progress("map", done, total),
            )
            write_sparse_map(found, path)
        return found

    def features(self) -> tuple[NDArray[np.float16], Array]:
        """Features and poses of all copies of the training images, from the trained backbone."""
        features, poses, _ = self._material.cached(self._last_phase)
        return self._of_rows(features, axis=1), self._of_rows(poses, axis=1)

    def val(self) -> tuple[Tensor, Array]:
        """Features and poses of val, from the trained backbone."""
        return self._material.cached(self._last_phase)[2], self._material.val_images.poses

    @property
    def _last_phase(self) -> int:
        return 2 if self.fine_tuned else 0
