"""Cells of a comparison or a study: a run each, trained, calibrated and evaluated once.

A finished cell is a file and never run again; an interrupted one goes on from its own checkpoints.
Cells run beside each other, torch with one thread in each.
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
from msgspec import Struct
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
from cvo_export.study.workers import Engine
from cvo_export.training.loop import prepare_features, train
from cvo_export.training.run import TrainConfig

CONFIDENCE = 0.9

Say = Callable[[str], None]


class Width(Struct, frozen=True, forbid_unknown_fields=True):
    """Means over three degrees of freedom each: metres, and degrees."""

    m: float
    deg: float


class Figures(Struct, frozen=True, forbid_unknown_fields=True):
    """Sets of 90 % on the test frames; coverage per DoF, their mean, and of all six at once.

    Widths and score take an unbounded side to end where the workspace does; ``unbounded`` is the
    share of frames that have one, None for bounds that always are finite.
    """

    coverage: list[float]
    mean_coverage: float
    joint_coverage: float
    mean_width: Width
    median_width: Width
    normalised_interval_score: float
    unbounded: float | None


class NoiseFigures(Struct, frozen=True, forbid_unknown_fields=True):
    """Marginal sets on test frames with noise: by thresholds of clean frames, and of noisy ones.

    Of the frames that passed the checks; ``invalid`` did not.
    """

    invalid: int
    point_error: dict[str, float]
    clean: Figures
    recalibrated: Figures


class Seconds(Struct, frozen=True, forbid_unknown_fields=True):
    """What training took, without features of the network as it was in the beginning."""

    processor: float
    wall: float


class Cell(Struct, frozen=True, forbid_unknown_fields=True):
    """Figures of one run.

    Attributes
    ----------
    options
        Digest of the run's configuration.
    bundle
        Digest of its bundle.
    marginal, joint, own
        Calibrated sets of both scopes; the network's own bounds before, where it gives some.
    joint_volume
        Of the joint sets, in standardised units.
    training
        None for a run that was interrupted: then nobody has measured it.
    head_parameters, graph_parameters
        Trained behind the features, and in all; what a forest holds is no parameter.
    model_bytes
        Of the ONNX file, with everything.
    adaptiveness
        How far widths follow errors, of the marginal sets; see ``cvo_export.evaluate``.
    pieces
        Share of the marginal sets that are in pieces; None where a method has none.
    noise
        Figures on test frames with noise, by its name and strength; None where no frame passed the
        checks.
    """

    method: str
    seed: int
    options: str
    bundle: str
    score: str
    frames: dict[str, int]
    marginal: Figures
    joint: Figures
    own: Figures | None
    joint_volume: dict[str, float]
    point_error: dict[str, float]
    training: Seconds | None
    head_parameters: int
    graph_parameters: int
    model_bytes: int
    adaptiveness: dict[str, float | None]
    pieces: float | None
    noise: dict[str, NoiseFigures | None] = {}


@dataclass(frozen=True)
class CellFolder:
    """Where cells, their runs and their bundles are kept by name, and the features they share."""

    out: Path
    features: Path

    def cell(self, name: str) -> Path:
        """File of a cell's figures."""
        return self.out / "cells" / f"{name}.json"

    def run(self, name: str) -> Path:
        """Folder of a run."""
        return self.out / "runs" / name

    def bundle(self, name: str) -> Path:
        """Folder of a bundle."""
        return self.out / "bundles" / name

    def read(self, name: str) -> Cell:
        """Figures of a finished cell; raises UsageError where the file holds none."""
        return read_json(self.cell(name), Cell, "the figures of a cell")

    def check(self, config_of: Callable[[Cell, str], TrainConfig | None]) -> None:
        """Raise UsageError where a cell was made with other options than ``config_of`` it says.

        ``config_of`` gets a cell and its name; None stands for a cell that nobody asked for.
        """
        others = []
        for path in sorted(self.cell("*").parent.glob("*.json")):
            found = self.read(path.stem)
            config = config_of(found, path.stem)
            if config is None or found.options != digest(config):
                others.append(path.stem)
        if others:
            raise UsageError(
                f"{self.out}: expected cells of the same options, found others: {', '.join(others)}"
            )

    def check_data(self, configs: Mapping[str, TrainConfig]) -> None:
        """Raise UsageError where a finished cell is of another data set or other weights.

        Names of cells depend on no place: what is found there now may be something else.
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
                    f"{self.cell(name)}: expected a cell of {config.dataset}: {error}"
                ) from None
            given = Path(config.weights)
            if made.provenance.weights_sha256 is not None and given.is_file():
                if config.weights not in digests:
                    digests[config.weights] = _file_sha256(given)
                found = digests[config.weights]
                if found != made.provenance.weights_sha256:
                    raise UsageError(
                        f"{self.cell(name)}: expected a cell of weights {found[:16]}..., found one "
                        f"of {made.provenance.weights_sha256[:16]}..."
                    )

    def fill(
        self,
        configs: Mapping[str, TrainConfig],
        noises: Mapping[str, Sequence[str]],
        engine: Engine,
        progress: Progress,
        say: Say,
    ) -> dict[str, Cell]:
        """Run what is missing; return all cells.

        ``noises`` by name of the cell: it is evaluated on frames with each, too.

        Raises the first failure's kind after all have been tried, SinkError where the folder cannot
        be written.
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
                    f"{self.out}: expected {len(missing)} more cells, found "
                    f"{len(missing) - len(failures)}; failed: {', '.join(failures)}"
                )
            return {name: self.read(name) for name in configs}

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Keep a second program out: both would write the same runs."""
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
                    f"{self.out}: expected a folder that nobody is filling, found one in use"
                ) from None
            yield

    def _complete(self, name: str, noises: Sequence[str]) -> bool:
        return self.cell(name).is_file() and set(noises) <= set(self.read(name).noise)


def run_cell(
    folder: CellFolder, name: str, config: TrainConfig, noises: Sequence[str] = ()
) -> None:
    """Train, publish and evaluate one cell, and write its file, whole or not at all.

    One that is there is evaluated with the noises that it has not seen.
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
        # The same frames without noise have been read: these did not pass the checks, not one.
        return None
    again = report["recalibrated"]["levels"]
    return NoiseFigures(
        invalid=_left_out(report),
        point_error=report["point_error"],
        clean=_figures(find_level(report["levels"], CONFIDENCE, "marginal")),
        recalibrated=_figures(find_level(again, CONFIDENCE, "marginal")),
    )


def _left_out(report: Mapping[str, Any]) -> int:
    """Frames that did not pass the checks, whichever."""
    frames = report["frames"]
    return int(frames["invalid"] + frames["degraded"])


def _finished(folder: CellFolder, name: str, config: TrainConfig) -> Cell:
    run_dir, bundle = folder.run(name), folder.bundle(name)
    interrupted = any(run_dir.glob("checkpoint-*"))
    clock = _Clock()
    run = train(run_dir, config, clock, folder.features)
    seconds = clock.seconds()
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
        marginal=_figures(marginal),
        joint=_figures(joint),
        own=None if report["own"] is None else _figures(report["own"]),
        joint_volume=joint["joint_volume"],
        point_error=report["point_error"],
        training=None if interrupted else seconds,
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
    """What decides the features of a run: all but its method."""
    return msgspec.json.encode({**msgspec.to_builtins(config), "head": None, "steps": 0})


class _Clock:
    """Seconds since the first features were there, as training reports them.

    Those of a backbone that has learnt, of fine-tuning, are made within training and counted.
    """

    def __init__(self) -> None:
        self._begin = (process_time(), perf_counter())
        self._begun = False

    def __call__(self, stage: Stage, done: int, total: int, _: str = "") -> None:
        """As ``Progress``."""
        if not self._begun and stage == "features" and done == total:
            self._begin = (process_time(), perf_counter())
            self._begun = True

    def seconds(self) -> Seconds:
        processor, wall = self._begin
        return Seconds(round(process_time() - processor, 3), round(perf_counter() - wall, 3))


def _figures(level: Mapping[str, Any]) -> Figures:
    def width(key: str) -> Width:
        values = np.array(level[key])
        return Width(float(values[:3].mean()), float(np.rad2deg(values[3:].mean())))

    return Figures(
        coverage=level["coverage"],
        mean_coverage=float(np.mean(level["coverage"])),
        joint_coverage=level["joint_coverage"],
        mean_width=width("mean_width"),
        median_width=width("median_width"),
        normalised_interval_score=level["normalised_interval_score"],
        unbounded=level.get("unbounded_share"),
    )


def _parameters(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())
