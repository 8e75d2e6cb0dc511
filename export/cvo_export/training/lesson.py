"""One lesson of a run: its phases, steps, early stopping on val, and checkpoints."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from cvo_edge.errors import UsageError
from cvo_edge.files import whole_file
from cvo_export.networks.heads.base import Examples, Learner, Schedule
from cvo_export.progress import Stage
from cvo_export.training.material import Material
from cvo_export.training.run import History

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Batch = Callable[[np.random.Generator], tuple[Tensor, Tensor]]

# Evaluations on val per phase, and evaluations without a new best that end it. The learning rate
# follows a cosine, so most of the gain comes late: the patience is high.
_EVALUATIONS = 40
_PATIENCE = 20
# An image costs the backbone a hundred times as much as its features cost the head.
_IMAGE_BATCH = 16


class Lesson:
    """The phases of a lesson: the head; with fine-tuning also backbone and head, then the head."""

    def __init__(
        self,
        material: Material,
        name: str,
        learner: Learner,
        rows: Indices,
        examples: Examples | None,
        candidate: bool,
        schedule: Schedule,
    ) -> None:
        self.material = material
        self.config = material.config
        self.name = name
        self.learner = learner
        self.rows = rows
        self._examples = examples
        self._candidate = candidate
        self._schedule = schedule
        self.both = nn.ModuleDict({"backbone": material.backbone, "learner": learner})
        self.history: list[History] = []
        self._seed = lesson_seed(self.config.seed, name)
        self._path = material.run_dir / f"checkpoint-{name}.pt"

    def fit(self) -> list[History]:
        """Run all phases, resuming from a checkpoint if one exists; returns the history."""
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
        """Train the head on features of augmented copies, computed by the current backbone."""
        if state is not None and state["ended"]:
            self._keep(phase, state["best"])
            return
        examples = self._examples or self.material.examples(phase)
        if phase == 0:
            whole = self.rows.size == examples.x.shape[1]
            # Chosen rows are a copy, which would double the memory.
            self.learner.fit_inputs(examples.x if whole else examples.x[:, self.rows])
        x = torch.from_numpy(examples.x)
        y = torch.tensor(examples.y, dtype=torch.float32)

        def batch(generator: np.random.Generator) -> tuple[Tensor, Tensor]:
            count = self._schedule.batch_size
            copy = generator.integers(x.shape[0], size=count)
            frame = self.rows[generator.integers(self.rows.size, size=count)]
            return x[copy, frame].float(), y[copy, frame]

        groups = self.learner.groups(self._schedule.learning_rate)
        steps = self._schedule.steps or self.config.steps
        with _threads(self._schedule.threads):
            val = examples.val_x, examples.val_y
            self._loop(phase, "training", groups, steps, batch, lambda _: val, state)

    def _fit_all(self, phase: int, state: dict[str, Any] | None) -> None:
        """Train backbone and head together on fresh augmented images."""
        images, val_images = self.material.images, self.material.val_images
        # Batch statistics of 16 images are too noisy: keep the running ones.
        self.material.backbone.eval()

        def batch(generator: np.random.Generator) -> tuple[Tensor, Tensor]:
            rows = self.rows[generator.integers(self.rows.size, size=_IMAGE_BATCH)]
            augment, noise = self.config.augment, self.config.noisy
            drawn = [
                images.augmented(row, augment.graded(generator.random()), generator, noise=noise)
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
            # Reduce the rate: a full one would undo the training of the head.
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
        """Run one phase; it ends by loading the averaged weights that were best on val."""
        config = self.config
        optimiser = torch.optim.AdamW(groups, weight_decay=config.weight_decay)
        averaging = get_ema_multi_avg_fn(config.averaging)  # type: ignore[no-untyped-call]
        learning = self._learning(phase)
        averaged = AveragedModel(learning, multi_avg_fn=averaging)
        best: dict[str, Any] = {"score": math.inf, "weights": _cloned(learning), "count": 0}
        start = 0
        if state is not None:
            with _of_this_version(self._path):
                optimiser.load_state_dict(state["optimiser"])
                averaged.load_state_dict(state["averaged"])
                best, start = state["best"], int(state["step"])
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
        """Modules a phase trains; averaging a frozen backbone would cost as much as the head."""
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
        with _of_this_version(self._path):
            state: dict[str, Any] = torch.load(self._path, weights_only=True)
            self.both.load_state_dict(state["weights"])
            self._learning(int(state["phase"])).load_state_dict(state["best"]["weights"])
            self.both.load_state_dict(state["weights"])
            self.history = [History(*entry) for entry in state["history"]]
            if not {"step", "ended"} <= state.keys() or state["phase"] not in range(3):
                raise KeyError("step")
        return state


def _cloned(module: nn.Module) -> dict[str, Tensor]:
    return {key: value.clone() for key, value in module.state_dict().items()}


@contextmanager
def _of_this_version(path: Path) -> Iterator[None]:
    """Raise UsageError for whatever fails, but for memory: a file may hold anything."""
    try:
        yield
    except MemoryError:
        raise
    except Exception:  # noqa: BLE001
        raise UsageError(
            f"{path}: expected a checkpoint of this version, found another file; remove it to "
            "restart training"
        ) from None


@contextmanager
def _threads(count: int | None) -> Iterator[None]:
    """Limit torch to this many threads, if given."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def lesson_seed(seed: int, name: str) -> int:
    """Return a seed per lesson, so that no lesson depends on the random numbers of earlier ones."""
    return int(np.random.SeedSequence((seed, zlib.crc32(name.encode()))).generate_state(1)[0])


def _schedule(step: int, steps: int) -> float:
    return min(1.0, (step + 1) / 50) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * step / steps)))
