"""``cvo-export train`` with its options, including the methods' options."""

from __future__ import annotations

import sys
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperCommand

from cvo_edge.programs.options import examples
from cvo_edge.vocabulary import Crop
from cvo_export.cli.app import (
    DATA,
    NETWORK,
    TRAINING,
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
    opened,
    resumable,
)
from cvo_export.progress import show_progress
from cvo_export.vocabulary import Normalisation


def _train(
    method: str,
    dataset: DatasetArgument,
    run_dir: Annotated[
        Path,
        typer.Argument(
            help="New folder, or the folder of an interrupted run with the same options.",
            show_default=False,
        ),
    ],
    *,
    split: TrainingSplitOption = None,
    copies: CopiesOption = None,
    rotation_deg: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Camera rotation of the copies, deviation per axis; default: 6.",
            rich_help_panel=DATA,
        ),
    ] = None,
    light: Annotated[
        float | None,
        typer.Option(
            min=0, help="Lighting changes in the copies, 0 to 1; default: 1.", rich_help_panel=DATA
        ),
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=1,
            help="Share of the copies that has one of the study's noises; default: 0.",
            rich_help_panel=DATA,
        ),
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(
            help="Folder of features shared by several runs; default: in RUN_DIR.",
            rich_help_panel=DATA,
        ),
    ] = None,
    backbone: BackboneOption = "mobilenetv2_100",
    weights: WeightsOption = "timm",
    stages: StagesOption = "16",
    grid: GridOption = "3x4",
    normalisation: Annotated[
        Normalisation | None,
        typer.Option(
            help="Pixel scaling; default: half, (x - 127.5)/127.5, for a file, otherwise timm's.",
            rich_help_panel=NETWORK,
        ),
    ] = None,
    size: SizeOption = None,
    crop: Annotated[
        Crop,
        typer.Option(help="Part of the image that the model sees.", rich_help_panel=NETWORK),
    ] = "none",
    folds: Annotated[
        int | None,
        typer.Option(
            min=2,
            help="Crossed calibration: every recording trains and calibrates, in this many folds.",
            rich_help_panel=TRAINING,
        ),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(min=0, help="Seed of split, training and noise.", rich_help_panel=TRAINING),
    ] = 0,
    steps: StepsOption = None,
    fine_tune: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Epochs that also train the backbone; default: 0, frozen.",
            rich_help_panel=TRAINING,
        ),
    ] = None,
    **options: Any,  # noqa: ANN401 - the methods' own
) -> None:
    """Train a method on a data set; repeat the command to resume an interrupted run."""
    from cvo_export.data.splits import default_kind
    from cvo_export.training.configure import configure, head_config
    from cvo_export.training.loop import train

    # Check the method's options before opening any data.
    head_config(method, options)
    found = opened(dataset)
    config = configure(
        method=method,
        dataset=dataset,
        split=split or default_kind(found),
        seed=seed,
        size=size,
        crop=crop,
        backbone=backbone,
        weights=weights,
        stages=stages,
        grid=grid,
        normalisation=normalisation,
        copies=copies,
        rotation_deg=rotation_deg,
        light=light,
        fine_tune=fine_tune,
        steps=steps,
        folds=folds,
        noise=noise,
        head=options,
    )
    with resumable(), show_progress() as progress:
        run = train(run_dir, config, progress, cache)
    print(*run.lines(), sep="\n", file=sys.stderr)


class _TrainCommand(TyperCommand):
    """Builds its parameters on demand: the methods' options import torch."""

    _built = False

    def get_params(self, ctx: typer.Context) -> list[Any]:  # type: ignore[override]
        """Return the command's parameters, including those of the registered methods."""
        if not self._built:
            self._built = True
            complete = _with_method_options()
            self.params, self.callback = complete.params, complete.callback
        return super().get_params(ctx)


def _with_method_options() -> TyperCommand:
    from cvo_export.networks.methods import TRAINABLE
    from cvo_export.training.options import method_parameters

    about = typer.Argument(
        metavar="method", help="Conformal method or baseline.", show_default=False
    )
    chosen: Any = Annotated[Literal[tuple(TRAINABLE)], about]
    method, *others = signature(_train, eval_str=True).parameters.values()
    explicit = [other for other in others if other.kind is not Parameter.VAR_KEYWORD]

    def command(**given: Any) -> None:  # noqa: ANN401
        _train(**given)

    parameters = [method.replace(annotation=chosen), *explicit, *method_parameters(TRAINABLE)]
    command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    alone = typer.Typer(add_completion=False)
    alone.command()(command)
    return typer.main.get_command(alone)  # type: ignore[return-value]


@app.command(
    cls=_TrainCommand,
    epilog=examples(
        "cvo-export train cjp 7scenes:scenes/redkitchen runs/redkitchen",
        "cvo-export train cqr synthetic:room runs/room --weights none --trees 50",
        "cvo-export train csp tum:freiburg1_room runs/room --classes 64 --seed 1",
    ),
    help=_train.__doc__,
)
def train() -> None:
    """Register the command; ``_TrainCommand`` defines its parameters."""
