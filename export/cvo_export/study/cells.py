"""The cells of a study: runs that are trained, calibrated and evaluated once.

A finished cell is a file and does not run again; an interrupted one resumes from its checkpoints.
Cells run in parallel, each with one torch thread.
"""

from __future__ import annotations

import fcntl
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import msgspec
import numpy as np
from torch import nn

from cvo_edge.bundle.reading import read_calibration
from cvo_edge.errors import CvoError, SinkError, SourceError, UsageError
from cvo_export.data.noise import parse_noise
from cvo_export.data.splits import same_split
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.evaluate import evaluate, find_level
from cvo_export.files import read_json, write_json
from cvo_export.progress import Progress, Stage
from cvo_export.publish import publish
from cvo_export.study.cell import CONFIDENCE, Cell, Figures, NoiseFigures, Seconds
from cvo_export.study.workers import Engine
from cvo_export.training.loop import prepare_features, train
from cvo_export.training.run import TrainConfig

Say = Callable[[str], None]

_SECONDS_FILE = "training-seconds.json"


@dataclass(frozen=True)
class CellFolder:
    """Cells, runs and bundles by name, and the features that runs share."""

    out: Path
    features: Path

    @classmethod
    def in_folder(cls, out: Path, features: Path | None) -> CellFolder:
        """Return absolute paths; by default, ``out`` holds the features as well."""
        return cls(out.resolve(), (features or out / "features").resolve())

    def cell(self, name: str) -> Path:
        """Return the file of a cell's figures."""
        return self.out / "cells" / f"{name}.json"

    def run(self, name: str) -> Path:
        """Return the folder of a run."""
        return self.out / "runs" / name

    def bundle(self, name: str) -> Path:
        """Return the folder of a bundle."""
        return self.out / "bundles" / name

    def read(self, name: str) -> Cell:
        """Return the figures of a finished cell; raises UsageError if its file is invalid."""
        return read_json(self.cell(name), Cell, "the figures of a cell")

    def names(self) -> list[str]:
        """Return the names of all finished cells."""
        return sorted(path.stem for path in self.cell("*").parent.glob("*.json"))

    def check_data(self, configs: Mapping[str, TrainConfig]) -> None:
        """Raise UsageError if a finished cell used other data or weights.

        A cell's name does not show this: the files at the same path may have changed.
        """
        opened: dict[str, PoseDataset] = {}
        digests: dict[str, str] = {}
        for name, config in configs.items():
            if not self.cell(name).is_file():
                continue
            made = read_calibration(self.bundle(name))
            if config.dataset not in opened:
                opened[config.dataset] = open_dataset(config.dataset)
            try:
                same_split(opened[config.dataset], made.calibration.split)
            except (SourceError, UsageError) as error:
                raise UsageError(
                    f"{self.cell(name)}: expected a cell of {config.dataset}: {error}; name a new "
                    "folder"
                ) from None
            given = Path(config.weights)
            if made.provenance.weights_sha256 is not None and given.is_file():
                if config.weights not in digests:
                    digests[config.weights] = _file_sha256(given)
                found = digests[config.weights]
                if found != made.provenance.weights_sha256:
                    raise UsageError(
                        f"{self.cell(name)}: expected a cell of weights {found[:16]}..., found one "
                        f"of {made.provenance.weights_sha256[:16]}...; name a new folder"
                    )

    def fill(
        self,
        configs: Mapping[str, TrainConfig],
        noises: Mapping[str, Sequence[str]],
        engine: Engine,
        progress: Progress,
        say: Say,
    ) -> dict[str, Cell]:
        """Run the missing cells and return all cells.

        ``noises`` maps the name of a cell to the noises it is also evaluated with.

        Tries all cells, then raises an error of the first failure's type. Raises SinkError if the
        folder cannot be written.
        """
        with self._locked():
            missing = {
                name: config
                for name, config in configs.items()
                if not self._complete(name, noises.get(name, ()))
            }
            untrained = [c for name, c in missing.items() if not self.cell(name).is_file()]
            sets = {_features_of(config): config for config in untrained}
            for number, config in enumerate(sets.values(), 1):
                where = f"set {number} of {len(sets)}"

                def told(
                    stage: Stage, done: int, total: int, _: str = "", where: str = where
                ) -> None:
                    progress(stage, done, total, where)

                prepare_features(config, self.features, told)
            failures: dict[str, CvoError] = {}
            count = 0

            def ended(name: str, failure: CvoError | None) -> None:
                nonlocal count
                count += 1
                if failure is None:
                    marginal = self.read(name).marginal
                    result = (
                        f"score {marginal.normalised_interval_score:.3f}, "
                        f"coverage {marginal.mean_coverage:.3f}"
                    )
                else:
                    failures[name] = failure
                    result = f"failed: {failure}"
                say(f"{name}: {result} ({count} of {len(missing)})")

            tasks = {
                name: partial(run_cell, self, name, config, tuple(noises.get(name, ())))
                for name, config in missing.items()
            }
            engine(tasks, ended)
            if failures:
                first = next(iter(failures.values()))
                raise type(first)(
                    f"{self.out}: {len(failures)} of {len(missing)} cells failed "
                    f"({', '.join(failures)}); run the same command to retry them"
                )
            return {name: self.read(name) for name in configs}

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Lock the folder: a second program would write to the same runs."""
        try:
            self.out.mkdir(parents=True, exist_ok=True)
            lock = (self.out / ".lock").open("w")
        except OSError as error:
            raise SinkError(f"{self.out}: cannot be written: {error.strerror}") from None
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UsageError(
                    f"{self.out}: another program is running cells in this folder; wait for it, or "
                    "name a new folder"
                ) from None
            yield

    def _complete(self, name: str, noises: Sequence[str]) -> bool:
        return self.cell(name).is_file() and set(noises) <= set(self.read(name).noise)


def run_cell(
    folder: CellFolder, name: str, config: TrainConfig, noises: Sequence[str] = ()
) -> None:
    """Train, publish and evaluate one cell, and write its file atomically.

    A finished cell is evaluated with the noises it lacks.
    """
    if not folder.cell(name).is_file():
        write_json(folder.cell(name), _finished(folder, name, config))
    for text in noises:
        cell = folder.read(name)
        if text not in cell.noise:
            found = _with_noise(folder.bundle(name), config, text)
            write_json(
                folder.cell(name),
                msgspec.structs.replace(cell, noise={**cell.noise, text: found}),
            )


def _with_noise(bundle: Path, config: TrainConfig, text: str) -> NoiseFigures | None:
    dataset = open_dataset(config.dataset)
    try:
        report = evaluate(bundle, dataset, "test", threads=1, noise=parse_noise(text))
    except SourceError:
        # The clean frames were readable, so no noisy frame passed the checks.
        return None
    again = report["recalibrated"]["levels"]
    return NoiseFigures(
        invalid=_left_out(report),
        point_error=report["point_error"],
        clean=Figures.of(find_level(report["levels"], CONFIDENCE, "marginal")),
        recalibrated=Figures.of(find_level(again, CONFIDENCE, "marginal")),
    )


def _left_out(report: Mapping[str, Any]) -> int:
    """Number of frames that did not pass the checks."""
    frames = report["frames"]
    return int(frames["invalid"] + frames["degraded"])


def _finished(folder: CellFolder, name: str, config: TrainConfig) -> Cell:
    run_dir, bundle = folder.run(name), folder.bundle(name)
    interrupted = any(run_dir.glob("checkpoint-*"))
    clock = _Clock()
    run = train(run_dir, config, clock, folder.features)
    # Kept with the run, so that a bundle that is published again keeps them.
    kept = run_dir / _SECONDS_FILE
    if not interrupted:
        write_json(kept, clock.seconds())
    seconds = read_json(kept, Seconds, "training times") if kept.is_file() else None
    calibration = publish(run, bundle, name, rule="pooled")
    report = evaluate(bundle, run.dataset, "test", threads=1)
    marginal = find_level(report["levels"], CONFIDENCE, "marginal")
    joint = find_level(report["levels"], CONFIDENCE, "joint")
    pieces = marginal.get("disjoint_share")
    return Cell(
        method=config.method,
        seed=config.seed,
        options=digest(config),
        bundle=calibration.digest,
        score=report["score"],
        frames={"total": report["frames"]["total"], "invalid": _left_out(report)},
        marginal=Figures.of(marginal),
        joint=Figures.of(joint),
        own=None if report["own"] is None else Figures.of(report["own"]),
        joint_volume=joint["joint_volume"],
        point_error=report["point_error"],
        training=seconds,
        head_parameters=_parameters(run.graph.head),
        graph_parameters=_parameters(run.graph),
        model_bytes=(bundle / calibration.model.file).stat().st_size,
        adaptiveness=marginal["adaptiveness"],
        pieces=None if pieces is None else float(np.mean(pieces)),
    )


def _file_sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def digest(config: TrainConfig) -> str:
    """sha256 of a run's configuration."""
    return hashlib.sha256(msgspec.json.encode(config)).hexdigest()


def _features_of(config: TrainConfig) -> bytes:
    """Return the options that determine a run's features: all but its method and its steps."""
    others = {**msgspec.to_builtins(config), "head": config.cells, "steps": 0}
    return msgspec.json.encode(others)


class _Clock:
    """Seconds since the first features were complete, according to the training progress.

    Features of a fine-tuned backbone count as training.
    """

    def __init__(self) -> None:
        self._begin = (process_time(), perf_counter())
        self._begun = False

    def __call__(self, stage: Stage, done: int, total: int, _: str = "") -> None:
        """See ``Progress``."""
        if not self._begun and stage == "features" and done == total:
            self._begin = (process_time(), perf_counter())
            self._begun = True

    def seconds(self) -> Seconds:
        processor, wall = self._begin
        return Seconds(round(process_time() - processor, 3), round(perf_counter() - wall, 3))


def _parameters(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())
