"""Methods and baselines beside each other: trained, calibrated, evaluated and timed; one table.

A cell is a method with a seed. A finished one is a file and never run again; an interrupted one
goes on from its own checkpoints. Cells run beside each other, torch with one thread in each; what
a frame costs is measured afterwards, alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from cvo_edge.engine.cores import allowed_cores
from cvo_export.bundles.draft import versions
from cvo_export.data.splits import default_kind
from cvo_export.datasets import open_dataset
from cvo_export.files import write_json, write_whole
from cvo_export.networks.baselines import BASELINES
from cvo_export.networks.methods import TRAINABLE
from cvo_export.progress import Progress
from cvo_export.study.cells import CONFIDENCE, Cell, CellFolder, Figures, Say
from cvo_export.study.frame_times import Timing, timed
from cvo_export.study.workers import run_tasks
from cvo_export.training.configure import configure
from cvo_export.training.run import TrainConfig

FEATURES_FOLDER = "features"
TIMING_FILE, REPORT_FILE, TABLE_FILE = "timing.json", "compare.json", "compare.txt"


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
    folder = CellFolder(out, cache or out / FEATURES_FOLDER)
    folder.check(
        lambda cell, _: config_of(cell.method, cell.seed) if cell.method in TRAINABLE else None
    )
    engine = partial(run_tasks, jobs or allowed_cores())
    cells = list(folder.fill(configs, {}, engine, progress, say).values())
    first = {cell.method: cell for cell in cells if cell.seed == 0}
    timing = timed(
        out / TIMING_FILE,
        {name: (cell.bundle, folder.bundle(_cell_name(name, 0))) for name, cell in first.items()},
        dataset,
    )
    lines = table(dataset.name, common["split"], cells, timing)
    report = {
        "dataset": dataset.name,
        "heads": {name: configs[_cell_name(name, 0)].head for name in names},
        "options": {
            key: value
            for key, value in msgspec.to_builtins(next(iter(configs.values()))).items()
            if key not in ("dataset", "weights", "head", "seed")
        },
        "confidence": CONFIDENCE,
        "versions": versions(("cvo-edge", "cvo-export", "torch", "timm", "onnx", "scikit-learn")),
        "timing": timing,
        "cells": cells,
    }
    write_json(out / REPORT_FILE, report)
    write_whole(out / TABLE_FILE, "\n".join(lines) + "\n")
    return lines


def _cell_name(method: str, seed: int) -> str:
    return f"{method}-{seed}"


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
        f"{dataset}, {split} split, seeds {seeds}: medians over seeds, sets of {CONFIDENCE:g}, "
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
