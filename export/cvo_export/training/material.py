"""Data shared by all lessons of a run: images, features and standardised poses."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvo_export.networks.backbone import Backbone
from cvo_export.networks.heads.base import Examples
from cvo_export.networks.standardised import Target
from cvo_export.networks.stem import Stem
from cvo_export.progress import Progress
from cvo_export.training.features import (
    FeatureExtractor,
    ModelImages,
    cached_copies,
    cached_features,
)
from cvo_export.training.run import TrainConfig

Array = NDArray[np.float64]

FEATURES_FOLDER = "features"


@dataclass
class Material:
    """Data shared by all lessons of a run, and the folders that cache it.

    ``backbone`` is a ``Backbone``, or the ``Stem`` of a method with cells.
    """

    run_dir: Path
    features_folder: Path
    config: TrainConfig
    backbone: Backbone | Stem
    target: Target
    images: ModelImages
    val_images: ModelImages
    progress: Progress

    def __post_init__(self) -> None:
        self.val_y = self.target.standardised(self.val_images.poses)
        self._cached: dict[int, tuple[NDArray[np.float16], Array, Tensor]] = {}

    def cached(self, phase: int) -> tuple[NDArray[np.float16], Array, Tensor]:
        """Features and poses of all copies, features of val, from the backbone of a phase.

        Shapes (copies + 1, n, ...), (copies + 1, n, 7) and (n_val, ...).
        """
        if phase not in self._cached:
            config, folder = self.config, self.features_folder
            if phase > 0:
                # A fine-tuned backbone belongs to this run only.
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
                config.noisy,
            )
            self._cached = {phase: (features, poses, torch.from_numpy(val))}
        return self._cached[phase]

    def examples(self, phase: int) -> Examples:
        """Features and standardised poses."""
        features, poses, val = self.cached(phase)
        return Examples(features, self.target.standardised(poses), val, self.val_y)


def shared_folder(
    cache: Path, config: TrainConfig, weights_sha256: str, images: ModelImages
) -> Path:
    """Return the shared cache's folder for the pretrained network's features of these images.

    Its name is a digest of everything that determines the features.
    """
    decisive = {
        "weights": weights_sha256,
        "backbone": [msgspec.to_builtins(config.backbone), config.cells],
        "image": [config.height, config.width, config.crop],
        "augment": [msgspec.to_builtins(config.augment), config.copies, config.seed],
        "camera": msgspec.to_builtins(images.camera),
        "pixels": images.digest(),
        "poses": images.poses.tolist(),
    }
    if config.noisy:
        decisive["noise"] = config.noisy
    text = json.dumps(decisive, sort_keys=True)
    return cache / hashlib.sha256(text.encode()).hexdigest()[:24]
