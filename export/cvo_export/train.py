"""One training loop: features, steps, early stopping on val, checkpoints.

Batches are a function of (seed, phase, step) and noise comes from a generator whose state is in
the checkpoint: an interrupted run that goes on ends with the same numbers as one that never was.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from cvo_edge.conformal import conformal_quantile, interval_score
from cvo_export.backbone import Backbone, load_weights
from cvo_export.features import FeatureExtractor, ModelImages, Progress, cached_copies
from cvo_export.heads.cjp import CjpDecoded, CjpLoss, CjpNetwork
from cvo_export.run import Run, TrainConfig, claim_run, open_run
from cvo_export.target import PoseGraph, Target, fit_target

Array = NDArray[np.float64]
Batch = Callable[[np.random.Generator], tuple[Tensor, Tensor]]

CHECKPOINT_FILE = "checkpoint.pt"
FEATURES_FOLDER = "features"

# Evaluations on val in a phase, and how many without a new best end it. The learning rate falls as
# a cosine, so most of the gain comes late: patience is long.
_EVALUATIONS = 40
_PATIENCE = 20

# An image costs the backbone a hundred times what its features cost the head.
_IMAGE_BATCH = 16


def train(run_dir: Path, config: TrainConfig, progress: Progress) -> Run:
    """Train, or go on where an interrupted run of the same configuration stopped.

    Raises UsageError where ``run_dir`` holds another configuration.
    """
    dataset, split = open_run(run_dir, config)
    torch.manual_seed(config.seed)
    backbone = Backbone(config.backbone, config.height, config.width)
    weights_sha256 = load_weights(backbone, config.weights)
    indices = np.concatenate([split.roles["train"], split.roles["fit"]])
    target = fit_target(dataset.poses[indices])
    claim_run(run_dir, config, dataset, split)
    size = (config.height, config.width, config.crop)
    trainer = _Trainer(
        run_dir,
        config,
        backbone,
        CjpNetwork(backbone.size, config.head),
        target,
        ModelImages(dataset, indices, *size),
        ModelImages(dataset, split.roles["val"], *size),
        progress,
    )
    history = trainer.fit()
    graph = PoseGraph(backbone, trainer.network, target).eval()
    run = Run(config, dataset, split, target, graph, weights_sha256, history)
    run.save(run_dir)
    return run


@dataclass
class _Trainer:
    """The phases of a run: the head on cached features; with fine-tuning all, then it again."""

    run_dir: Path
    config: TrainConfig
    backbone: Backbone
    network: CjpNetwork
    target: Target
    images: ModelImages
    val_images: ModelImages
    progress: Progress

    def fit(self) -> list[dict[str, float]]:
        """Run all phases, from the checkpoint if there is one; returns the history."""
        self.both = nn.ModuleDict({"backbone": self.backbone, "network": self.network})
        self.loss = CjpLoss(self.config.head)
        self.history: list[dict[str, float]] = []
        self.val_y = self.target.standardised(self.val_images.poses)
        checkpoint = self._read_checkpoint()
        first = checkpoint["phase"] if checkpoint else 0
        for phase in range(first, 3 if self.config.fine_tune else 1):
            state = checkpoint if checkpoint and phase == first else None
            if phase == 1:
                self._fit_all(phase, state)
            else:
                self._fit_head(phase, state)
        return self.history

    def _fit_head(self, phase: int, state: dict[str, Any] | None) -> None:
        """Train the head on features of augmented copies, computed by the present backbone."""
        extractor = FeatureExtractor(self.backbone, self.config.height, self.config.width)
        features, poses = cached_copies(
            self.run_dir / f"{FEATURES_FOLDER}-{phase}",
            self.images,
            extractor,
            self.config.augment,
            self.config.copies,
            self.config.seed,
            self.progress,
        )
        val = torch.from_numpy(np.stack([extractor(image) for image in self.val_images.images]))
        if phase == 0:
            self._standardise(features)
        x = torch.from_numpy(features)
        y = torch.tensor(self.target.standardised(poses), dtype=torch.float32)

        def batch(generator: np.random.Generator) -> tuple[Tensor, Tensor]:
            copy = generator.integers(x.shape[0], size=self.config.batch_size)
            frame = generator.integers(x.shape[1], size=self.config.batch_size)
            return x[copy, frame].float(), y[copy, frame]

        groups = [{"params": list(self.network.parameters()), "peak": self.config.learning_rate}]
        self._loop(phase, "head", groups, self.config.steps, batch, lambda _: val, state)

    def _fit_all(self, phase: int, state: dict[str, Any] | None) -> None:
        """Train backbone and head together on fresh augmented images."""
        # Batch statistics of 16 images are too noisy: the running ones stay.
        self.backbone.eval()

        def batch(generator: np.random.Generator) -> tuple[Tensor, Tensor]:
            rows = generator.integers(len(self.images), size=_IMAGE_BATCH)
            augment = self.config.augment
            drawn = [
                self.images.augmented(row, augment.graded(generator.random()), generator)
                for row in rows.tolist()
            ]
            y = self.target.standardised(np.stack([pose for _, pose in drawn]))
            stacked = torch.from_numpy(np.stack([image for image, _ in drawn]))
            return self.backbone(stacked), torch.tensor(y, dtype=torch.float32)

        def val_features(averaged: nn.Module) -> Tensor:
            with torch.no_grad():
                backbone = averaged.get_submodule("backbone")
                images = torch.from_numpy(self.val_images.images)
                starts = range(0, len(images), _IMAGE_BATCH)
                return torch.cat([backbone(images[i : i + _IMAGE_BATCH]) for i in starts])

        groups = [
            # The head is trained already: a full rate would undo it.
            {"params": list(self.network.parameters()), "peak": 0.3 * self.config.learning_rate},
            {
                "params": list(self.backbone.parameters()),
                "peak": self.config.backbone_learning_rate,
            },
        ]
        steps = self.config.fine_tune * math.ceil(len(self.images) / _IMAGE_BATCH)
        self._loop(phase, "fine-tuning", groups, steps, batch, val_features, state)

    def _loop(
        self,
        phase: int,
        name: str,
        groups: list[dict[str, Any]],
        steps: int,
        batch: Batch,
        val_features: Callable[[nn.Module], Tensor],
        state: dict[str, Any] | None,
    ) -> None:
        """Run one phase; ``both`` ends with the averaged weights that were best on val."""
        config = self.config
        optimiser = torch.optim.AdamW(groups, weight_decay=config.weight_decay)
        averaging = get_ema_multi_avg_fn(config.averaging)  # type: ignore[no-untyped-call]
        averaged = AveragedModel(self.both, multi_avg_fn=averaging)
        best: dict[str, Any] = {"score": math.inf, "weights": self.both.state_dict(), "count": 0}
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
            self.network.train()
            self.loss.train()
            features, y = batch(np.random.default_rng((config.seed, phase, step)))
            noise = torch.randn(len(y), config.head.latent_size)
            prediction = self.network(features, noise)
            warm_up = phase == 0 and step < config.warm_up_steps
            value = self.loss(prediction, y, warm_up=warm_up)
            optimiser.zero_grad()
            value.backward()
            optimiser.step()
            averaged.update_parameters(self.both)
            if (step + 1) % every == 0 or step + 1 == steps:
                module = averaged.module
                head = module.get_submodule("network")
                score = val_score(cast("CjpNetwork", head), val_features(module), self.val_y)
                if score < best["score"]:
                    weights = {key: value.clone() for key, value in module.state_dict().items()}
                    best = {"score": score, "weights": weights, "count": 0}
                else:
                    best["count"] += 1
                entry = {"phase": phase, "step": step + 1, "loss": value.item()}
                self.history.append({**entry, "val_score": score})
                self._write_checkpoint(phase, step + 1, optimiser, averaged, best)
                self.progress(f"{name}, val score {score:.3f}", step + 1, steps)
        self.both.load_state_dict(best["weights"])
        self.network.eval()

    def _standardise(self, features: NDArray[np.float16]) -> None:
        deviation = features.std((0, 1), dtype=np.float64)
        self.network.feature_mean.copy_(torch.from_numpy(features.mean((0, 1), dtype=np.float64)))
        # A feature that is nearly always zero would be blown up where it is not.
        self.network.feature_std.copy_(torch.from_numpy(deviation + 0.1 * deviation.mean()))

    def _write_checkpoint(
        self,
        phase: int,
        step: int,
        optimiser: torch.optim.Optimizer,
        averaged: AveragedModel,
        best: dict[str, Any],
    ) -> None:
        path = self.run_dir / CHECKPOINT_FILE
        partial = path.with_suffix(".partial")
        torch.save(
            {
                "phase": phase,
                "step": step,
                "weights": self.both.state_dict(),
                "loss": self.loss.state_dict(),
                "optimiser": optimiser.state_dict(),
                "averaged": averaged.state_dict(),
                "best": best,
                "history": self.history,
                "torch_rng": torch.get_rng_state(),
            },
            partial,
        )
        partial.replace(path)

    def _read_checkpoint(self) -> dict[str, Any] | None:
        path = self.run_dir / CHECKPOINT_FILE
        if not path.is_file():
            return None
        state: dict[str, Any] = torch.load(path, weights_only=True)
        self.both.load_state_dict(state["weights"])
        self.loss.load_state_dict(state["loss"])
        self.history = state["history"]
        return state


def _schedule(step: int, steps: int) -> float:
    return min(1.0, (step + 1) / 50) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * step / steps)))


def val_score(network: CjpNetwork, features: Tensor, y: Array) -> float:
    """Mean interval score at 90 % on val (n, 6), standardised, bounds conformalised on val itself.

    Close to what the finished bundle will be judged by: there the score (additive here) is chosen
    afterwards, and thresholds come from other frames than the ones judged.
    """
    network.eval()
    with torch.no_grad():
        found = CjpDecoded(network)(features)
    _, lower, upper = (values.numpy().astype(np.float64) for values in found)
    scores = np.maximum(lower - y, y - upper)
    q_hat = np.array([conformal_quantile(scores[:, dof], 0.9) for dof in range(6)])
    lower, upper = lower - q_hat, upper + q_hat
    distance = np.maximum(np.maximum(lower - y, y - upper), 0.0)
    return float(interval_score(upper - lower, distance, 0.1).mean())
