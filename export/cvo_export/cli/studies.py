"""``cvo-export compare`` and ``study``: commands that run many trainings."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from cvo_edge.errors import UsageError
from cvo_edge.programs.options import examples
from cvo_export.cli.app import (
    BackboneOption,
    CopiesOption,
    DatasetArgument,
    GridOption,
    SizeOption,
    StagesOption,
    StepsOption,
    TrainingSplitOption,
    WeightsOption,
    app,
    resumable,
)
from cvo_export.progress import show_progress
from cvo_export.vocabulary import StudyEngine


@app.command(
    epilog=examples(
        "cvo-export compare 7scenes:scenes/kitchen comparison --methods cjp,scr --seeds 5"
    )
)
def compare(
    dataset: DatasetArgument,
    out: Annotated[
        Path, typer.Argument(help="New folder, or the folder of an interrupted comparison.")
    ],
    methods: Annotated[
        str | None,
        typer.Option(help="Names separated by commas; default: all methods and baselines."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds, from 0.")] = 3,
    split: TrainingSplitOption = None,
    backbone: BackboneOption = "mobilenetv2_100",
    weights: WeightsOption = "timm",
    stages: StagesOption = "16",
    grid: GridOption = "3x4",
    size: SizeOption = None,
    steps: StepsOption = None,
    copies: CopiesOption = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Parallel runs; default: one per allowed core.")
    ] = None,
    cache: Annotated[Path | None, typer.Option(help="Folder of features; default: in OUT.")] = None,
) -> None:
    """Train, publish and evaluate methods and baselines over seeds, and time their frames.

    A study of one grid. Repeat the command to resume. OUT gets results.json and the table
    compare.txt.
    """
    from cvo_edge.engine.cores import allowed_cores
    from cvo_export.networks.methods import TRAINABLE
    from cvo_export.study.cells import CellFolder
    from cvo_export.study.compare import compare as compare_methods
    from cvo_export.study.grid import Grid
    from cvo_export.study.workers import run_tasks

    preset = Grid(
        name="compare",
        data=[dataset],
        methods=list(TRAINABLE) if methods is None else methods.split(","),
        split=split,
        backbones=[backbone],
        weights=weights,
        seeds=seeds,
        stages=stages,
        grid=grid,
        size=size,
        copies=copies,
        steps=steps,
    )
    with resumable(), show_progress() as progress:
        lines = compare_methods(
            preset,
            CellFolder.in_folder(out, cache),
            partial(run_tasks, jobs or allowed_cores()),
            progress,
            partial(print, file=sys.stderr, flush=True),
        )
    print(*lines, sep="\n")


@app.command(
    epilog=examples(
        "cvo-export study grids.toml my-study",
        "cvo-export study grids.toml my-study --engine ray",
    )
)
def study(
    config: Annotated[Path, typer.Argument(help="Grids to run, TOML.", show_default=False)],
    out: Annotated[Path, typer.Argument(help="New folder, or the folder of a study to resume.")],
    engine: Annotated[
        StudyEngine, typer.Option(help="Processes of this machine, or a Ray cluster.")
    ] = "local",
    jobs: Annotated[
        int | None,
        typer.Option(min=1, help="Engine local: parallel runs; default: one per allowed core."),
    ] = None,
    cache: Annotated[Path | None, typer.Option(help="Folder of features; default: in OUT.")] = None,
) -> None:
    """Run grids of methods, backbones, data, noise, options and seeds, and report on them.

    Repeat the command to resume. OUT gets results.json, report.html and pictures.
    """
    from cvo_edge.engine.cores import allowed_cores
    from cvo_export.study.cells import CellFolder
    from cvo_export.study.grid import read_study, run_study
    from cvo_export.study.ray_engine import ray_engine
    from cvo_export.study.report import page_template, write_report
    from cvo_export.study.workers import run_tasks

    if engine == "ray" and jobs is not None:
        raise UsageError("--jobs belongs to --engine local; Ray runs one cell on each of its cores")
    # Fail now rather than after hours of training if the page cannot be written.
    template = page_template()
    grids = read_study(config)
    local = nullcontext(partial(run_tasks, jobs or allowed_cores()))
    engine_run = local if engine == "local" else ray_engine()
    with resumable(), engine_run as run, show_progress() as progress:
        folder = CellFolder.in_folder(out, cache)
        say = partial(print, file=sys.stderr, flush=True)
        results = run_study(grids, folder, run, progress, say)
    print(write_report(results, folder, template))
