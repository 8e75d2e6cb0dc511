"""Methods and baselines beside each other: trained, calibrated, evaluated and timed; one table.

A cell is a method with a seed. A finished one is a file and never run again; an interrupted one
goes on from its own checkpoints. Cells run beside each other, torch with one thread in each; what
a frame costs is measured afterwards, alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import product
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from torch import nn

from cvo_edge.errors import CvoError, SinkError, UsageError
from cvo_edge.odometer import Odometer
from cvo_edge.profile import environment, quantiles
from cvo_edge.session import allowed_cores
from cvo_export.baselines import BASELINES
from cvo_export.bundle import versions
from cvo_export.configure import configure
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.evaluate import evaluate, find_level, subset_indices
from cvo_export.methods import TRAINABLE
from cvo_export.progress import Progress
from cvo_export.publish import publish
from cvo_export.run import TrainConfig
from cvo_export.splits import default_kind
from cvo_export.train import prepare_features, train
from cvo_export.workers import run_tasks

CELLS_FOLDER, RUNS_FOLDER, BUNDLES_FOLDER, FEATURES_FOLDER = "cells", "runs", "bundles", "features"
TIMING_FILE, REPORT_FILE, TABLE_FILE = "timing.json", "compare.json", "compare.txt"

_CONFIDENCE = 0.9
_WARM_UP_ROUNDS, _ROUNDS = 15, 200
# Frames of the timing pass, kept in memory and taken in turn.
_TIMED_FRAMES = 20

Say = Callable[[str], None]


class Width(Struct, frozen=True, forbid_unknown_fields=True):
    """Means over three degrees of freedom each: metres, and degrees."""

    m: float
    deg: float


class Figures(Struct, frozen=True, forbid_unknown_fields=True):
    """Sets of 90 % on the test frames; coverage per DoF, their mean, and of all six at once."""

    coverage: list[float]
    mean_coverage: float
    joint_coverage: float
    mean_width: Width
    median_width: Width
    normalised_interval_score: float


class Seconds(Struct, frozen=True, forbid_unknown_fields=True):
    """What training took, without the features."""

    processor: float
    wall: float


class Cell(Struct, frozen=True, forbid_unknown_fields=True):
    """Figures of one method with one seed.

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
        What is trained behind the features, and all of the network.
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


class Timing(Struct, frozen=True, forbid_unknown_fields=True):
    """Milliseconds from array to interval; digests of the bundles, and where they were timed."""

    bundles: dict[str, str]
    threads: int
    environment: dict[str, Any]
    ms: dict[str, dict[str, float]]


def compare(
    out: Path,
    options: Mapping[str, Any],
    methods: Sequence[str],
    seeds: int,
    *,
    jobs: int | None,
    cache: Path | None,
    progress: Progress,
    say: Say,
) -> list[str]:
    """Fill in the cells that are missing, time the bundles of seed 0; returns the table's lines.

    Parameters
    ----------
    out
        Folder of cells, runs, bundles, the report and the table.
    options
        Arguments of ``configure`` but for method, seed and the method's own options.
    methods, seeds
        Names, and how many seeds from 0 on.
    jobs
        Cells that run at a time; all allowed cores by default.
    cache
        Folder of features; by default in ``out``.
    progress, say
        Of the features; a line for every cell that ends.

    Raises
    ------
    UsageError
        An unknown method, or cells of other options in the folder.
    SinkError
        The folder cannot be written.
    CvoError
        Of the kind of the first cell that failed; the others have been run.
    """
    dataset = open_dataset(options["dataset"])
    common = {**options, "split": options["split"] or default_kind(dataset)}

    def config_of(method: str, seed: int) -> TrainConfig:
        return configure(method=method, seed=seed, head={}, **common)

    names = list(dict.fromkeys(methods))
    configs = {
        _cell_name(method, seed): config_of(method, seed)
        for method, seed in product(names, range(seeds))
    }
    _check_cells(out, config_of)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SinkError(f"{out}: cannot be written: {error.strerror}") from None
    missing = {name: c for name, c in configs.items() if not _cell_path(out, name).is_file()}
    features = cache or out / FEATURES_FOLDER
    for seed in sorted({config.seed for config in missing.values()}):
        first = next(config for config in missing.values() if config.seed == seed)
        prepare_features(first, features, progress)
    _fill(out, features, missing, jobs or allowed_cores(), say)
    cells = [_read_cell(_cell_path(out, name)) for name in configs]
    timing = _timing(out, {cell.method: cell for cell in cells if cell.seed == 0}, dataset)
    lines = table(dataset.name, common["split"], cells, timing)
    report = {
        "dataset": dataset.name,
        "heads": {name: configs[_cell_name(name, 0)].head for name in names},
        "options": {
            key: value
            for key, value in msgspec.to_builtins(next(iter(configs.values()))).items()
            if key not in ("dataset", "weights", "head", "seed")
        },
        "confidence": _CONFIDENCE,
        "versions": versions(("cvo-edge", "cvo-export", "torch", "timm", "onnx", "scikit-learn")),
        "timing": timing,
        "cells": cells,
    }
    _write(out / REPORT_FILE, _json(report))
    _write(out / TABLE_FILE, "\n".join(lines) + "\n")
    return lines


# -- cells --------------------------------------------------------------------------------------


def run_cell(out: Path, features: Path, config: TrainConfig) -> None:
    """Train, publish and evaluate one cell, and write its file, whole or not at all."""
    name = _cell_name(config.method, config.seed)
    run_dir, bundle = out / RUNS_FOLDER / name, out / BUNDLES_FOLDER / name
    interrupted = any(run_dir.glob("checkpoint-*"))
    clock = _Clock()
    run = train(run_dir, config, clock, features)
    seconds = clock.seconds()
    calibration = publish(run, bundle, name, rule="pooled")
    report = evaluate(bundle, run.dataset, "test", threads=1)
    joint = find_level(report["levels"], _CONFIDENCE, "joint")
    cell = Cell(
        method=config.method,
        seed=config.seed,
        options=_digest(config),
        bundle=calibration.digest,
        score=report["score"],
        frames={key: report["frames"][key] for key in ("total", "invalid")},
        marginal=_figures(find_level(report["levels"], _CONFIDENCE, "marginal")),
        joint=_figures(joint),
        own=None if report["own"] is None else _figures(report["own"]),
        joint_volume=joint["joint_volume"],
        point_error=report["point_error"],
        training=None if interrupted else seconds,
        head_parameters=_parameters(run.graph.head),
        graph_parameters=_parameters(run.graph),
        model_bytes=(bundle / calibration.model.file).stat().st_size,
    )
    _write(_cell_path(out, name), _json(cell))


class _Clock:
    """Seconds since the features were there, as training reports them."""

    def __init__(self) -> None:
        self._begin = (process_time(), perf_counter())

    def __call__(self, what: str, done: int, total: int) -> None:
        """As ``Progress``."""
        if what == "features" and done == total:
            self._begin = (process_time(), perf_counter())

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
    )


def _parameters(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def _digest(config: TrainConfig) -> str:
    return hashlib.sha256(msgspec.json.encode(config)).hexdigest()


def _cell_name(method: str, seed: int) -> str:
    return f"{method}-{seed}"


def _cell_path(out: Path, name: str) -> Path:
    return out / CELLS_FOLDER / f"{name}.json"


def _read_cell(path: Path) -> Cell:
    try:
        return msgspec.json.decode(path.read_bytes(), type=Cell)
    except msgspec.DecodeError as error:
        raise UsageError(f"{path}: expected the figures of a cell, found {error}") from None


def _check_cells(out: Path, config_of: Callable[[str, int], TrainConfig]) -> None:
    """Raise UsageError where a cell in the folder was made with other options."""
    others = []
    for path in sorted((out / CELLS_FOLDER).glob("*.json")):
        cell = _read_cell(path)
        known = cell.method in TRAINABLE
        if not known or cell.options != _digest(config_of(cell.method, cell.seed)):
            others.append(path.stem)
    if others:
        raise UsageError(
            f"{out}: expected cells of the same options, found others: {', '.join(others)}"
        )


def _json(content: object) -> str:
    return msgspec.json.format(msgspec.json.encode(content), indent=1).decode() + "\n"


def _write(path: Path, text: str) -> None:
    """Write a file whole or not at all; raises SinkError."""
    unfinished = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished.write_text(text, "utf-8")
        unfinished.replace(path)
    except OSError as error:
        raise SinkError(f"{path}: cannot be written: {error.strerror}") from None


def _fill(
    out: Path, features: Path, missing: Mapping[str, TrainConfig], jobs: int, say: Say
) -> None:
    """Run the missing cells; raises the first failure's kind after all have been tried."""
    failures: dict[str, CvoError] = {}
    count = 0

    def ended(name: str, failure: CvoError | None) -> None:
        nonlocal count
        count += 1
        if failure is None:
            marginal = _read_cell(_cell_path(out, name)).marginal
            result = (
                f"score {marginal.normalised_interval_score:.3f}, "
                f"coverage {marginal.mean_coverage:.3f}"
            )
        else:
            failures[name] = failure
            result = f"failed: {failure}"
        say(f"{name}: {result} ({count} of {len(missing)})")

    tasks = {name: partial(run_cell, out, features, config) for name, config in missing.items()}
    run_tasks(tasks, jobs, ended)
    if failures:
        first = next(iter(failures.values()))
        raise type(first)(
            f"{out}: expected {len(missing)} more cells, found {len(missing) - len(failures)}; "
            f"failed: {', '.join(failures)}"
        )


# -- what a frame costs -------------------------------------------------------------------------


def _timing(out: Path, cells: Mapping[str, Cell], dataset: PoseDataset) -> Timing:
    """Return milliseconds a frame of each method's bundle; measured where there are none yet."""
    path = out / TIMING_FILE
    bundles = {method: cell.bundle for method, cell in cells.items()}
    if path.is_file():
        try:
            stored = msgspec.json.decode(path.read_bytes(), type=Timing)
        except msgspec.DecodeError as error:
            raise UsageError(f"{path}: expected timings, found {error}") from None
        if bundles.items() <= stored.bundles.items():
            return stored
    folders = {method: out / BUNDLES_FOLDER / _cell_name(method, 0) for method in cells}
    threads = allowed_cores()
    timing = Timing(bundles, threads, environment(threads), _frame_ms(folders, dataset))
    _write(path, _json(timing))
    return timing


def _frame_ms(bundles: Mapping[str, Path], dataset: PoseDataset) -> dict[str, dict[str, float]]:
    """Bundles take turns, a frame each, so that a change of the machine's speed meets all."""
    with ExitStack() as stack:
        odometers = {
            method: stack.enter_context(Odometer.load(folder)) for method, folder in bundles.items()
        }
        names = list(odometers)
        indices = subset_indices(odometers[names[0]].calibration, dataset, "test")
        images = [dataset.read_image(index) for index in indices[:_TIMED_FRAMES].tolist()]
        spent: dict[str, list[float]] = {name: [] for name in names}
        for number in range(_WARM_UP_ROUNDS + _ROUNDS):
            image = images[number % len(images)]
            # Each is first, and behind each other one, equally often.
            shift = number % len(names)
            for name in names[shift:] + names[:shift]:
                begin = perf_counter()
                odometers[name].step(image)
                end = perf_counter()
                if number >= _WARM_UP_ROUNDS:
                    spent[name].append(1e3 * (end - begin))
    return {name: quantiles(values) for name, values in spent.items()}


# -- table --------------------------------------------------------------------------------------

_HEADER = (
    "method",
    "coverage",
    "all six",
    "width",
    "score",
    "joint scope",
    "volume^1/6",
    "point error",
    "train s",
    "M param.",
    "frame ms",
)
# Columns behind the name that a network's own bounds have, too.
_SHARED = 4


def table(dataset: str, split: str, cells: Sequence[Cell], timing: Timing) -> list[str]:
    """Return the comparison as lines of text for a person."""
    seeds = ", ".join(str(seed) for seed in sorted({cell.seed for cell in cells}))
    rows: list[tuple[str, ...]] = [_HEADER]
    for method in dict.fromkeys(cell.method for cell in cells):
        of_method = [cell for cell in cells if cell.method == method]
        own = [cell.own for cell in of_method if cell.own is not None]
        marginal = [cell.marginal for cell in of_method]
        if method not in BASELINES:
            rows.append((method, *_figures_shown(marginal), *_bundle_shown(of_method, timing)))
            continue
        if own:
            blank = ("-",) * (len(_HEADER) - 1 - _SHARED)
            rows.append((f"{method}, own", *_figures_shown(own), *blank))
        rows.append(
            (f"{method}, conformal", *_figures_shown(marginal), *_bundle_shown(of_method, timing))
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADER))]
    return [
        f"{dataset}, {split} split, seeds {seeds}: medians over seeds, sets of {_CONFIDENCE:g}, "
        "test frames",
        "",
        *("  ".join(v.ljust(w) for v, w in zip(row, widths, strict=True)).rstrip() for row in rows),
        "",
        "own: bounds of the network as they come; conformal: the same calibrated, pooled rule",
        "coverage: of each degree of freedom, mean over six; all six: of those sets at once",
        "score: interval score over each degree of freedom's deviation, each seed in brackets",
        "joint scope: coverage of all six by sets made for it, and their volume in deviations, "
        "geometric mean",
        "train: processor seconds without features; M param.: millions behind the backbone, no "
        "forest",
        f"frame: array to interval, median and 95 %, {timing.threads} threads",
    ]


def _figures_shown(figures: Sequence[Figures]) -> tuple[str, ...]:
    """Coverage to score of all seeds: what the network's own bounds have, too."""
    scores = [entry.normalised_interval_score for entry in figures]
    width_m = _median([entry.median_width.m for entry in figures])
    width_deg = _median([entry.median_width.deg for entry in figures])
    return (
        f"{_median([entry.mean_coverage for entry in figures]):.3f}",
        f"{_median([entry.joint_coverage for entry in figures]):.3f}",
        f"{100 * width_m:.2f} cm {width_deg:.2f} deg",
        f"{_median(scores):.3f} ({', '.join(f'{score:.3f}' for score in scores)})",
    )


def _bundle_shown(cells: Sequence[Cell], timing: Timing) -> tuple[str, ...]:
    """Joint scope to milliseconds: what the bundle has as a whole."""
    volume = _median([cell.joint_volume["geometric_mean"] for cell in cells])
    error_m = _median([cell.point_error["median_m"] for cell in cells])
    error_deg = _median([cell.point_error["median_deg"] for cell in cells])
    seconds = [cell.training.processor for cell in cells if cell.training is not None]
    ms = timing.ms[cells[0].method]
    return (
        f"{_median([cell.joint.joint_coverage for cell in cells]):.3f}",
        f"{volume ** (1 / 6):.3f}",
        f"{100 * error_m:.2f} cm {error_deg:.2f} deg",
        f"{_median(seconds):.0f}" if seconds else "-",
        f"{cells[0].head_parameters / 1e6:.2f}",
        f"{ms['p50']:.2f} ({ms['p95']:.2f})",
    )


def _median(values: Sequence[float]) -> float:
    return float(np.median(values))
