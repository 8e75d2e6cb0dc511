"""The program ``cvo-export``, and the options that several commands share."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from cvo_edge.process import Terminated, say
from cvo_edge.vocabulary import Joint, Rule, Sides, SplitKind

if TYPE_CHECKING:
    from cvo_export.datasets import PoseDataset


@contextmanager
def resumable() -> Iterator[None]:
    """Say that work which is interrupted here is not lost."""
    try:
        yield
    except (KeyboardInterrupt, Terminated):
        say("interrupted: the same command goes on from what is done")
        raise


app = typer.Typer(
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Train a pose network with bounds, export it to one ONNX graph, calibrate and evaluate "
    "it. DATASET is FORMAT:PATH, e.g. 7scenes:scenes/redkitchen or synthetic:room; the formats are "
    "7scenes, 12scenes, ace, scannet, rgbd-scenes, tum, tum-vi, kitti, euroc, colmap, nerfstudio, "
    "rosbag and synthetic.",
)

DATA, NETWORK, TRAINING = "Data", "Network", "Training"

DatasetArgument = Annotated[
    str, typer.Argument(help="FORMAT:PATH, e.g. 7scenes:scenes/redkitchen.", show_default=False)
]

BackboneOption = Annotated[str, typer.Option(help="Any timm model.", rich_help_panel=NETWORK)]
WeightsOption = Annotated[
    str,
    typer.Option(
        help="timm (downloads), a safetensors file, or none (random, untrained).",
        rich_help_panel=NETWORK,
    ),
]
StagesOption = Annotated[
    str,
    typer.Option(
        help="Strides of the stages used, e.g. 16 or 8,16; final: the last layer.",
        rich_help_panel=NETWORK,
    ),
]
GridOption = Annotated[
    str,
    typer.Option(
        help="Rows x columns that each stage is averaged to; 1x1: global mean.",
        rich_help_panel=NETWORK,
    ),
]
SizeOption = Annotated[
    str | None,
    typer.Option(
        help="Width x height of the model's input; default: 192x144, for scr and fused 256x192.",
        rich_help_panel=NETWORK,
    ),
]
CopiesOption = Annotated[
    int | None,
    typer.Option(
        min=0, help="Augmented copies of each training frame; default: 48.", rich_help_panel=DATA
    ),
]
StepsOption = Annotated[
    int | None,
    typer.Option(
        min=100, help="Training steps of the head; default: 10000.", rich_help_panel=TRAINING
    ),
]
TrainingSplitOption = Annotated[
    SplitKind | None,
    typer.Option(
        help="Unit of the split; default: sequence if there are at least five, otherwise block.",
        rich_help_panel=DATA,
    ),
]

RuleOption = Annotated[
    Rule | None,
    typer.Option(
        help="What counts as one draw: a frame (pooled) or a recording (capped, hierarchical); "
        "default: capped for a split by sequence, otherwise pooled."
    ),
]
CapOption = Annotated[
    float | None,
    typer.Option(
        help="capped: share of missed frames that a recording counts at most; default: 0.5."
    ),
]
JointOption = Annotated[
    Joint, typer.Option(help="Score that calibrates all six degrees of freedom together.")
]
ScoreOption = Annotated[
    str | None,
    typer.Option(
        help="csp: aps, lac or raps; other methods: normalised or additive; default: chosen on val."
    ),
]
SidesOption = Annotated[
    Sides | None,
    typer.Option(help="cqr: how the bounds are calibrated; default in a new bundle: symmetric."),
]
NameOption = Annotated[str | None, typer.Option(help="Default: the folder's name.")]


def opened(dataset: str) -> PoseDataset:
    """Open a data set; print on stderr what was read, and what was skipped and why."""
    from cvo_export.datasets import open_dataset
    from cvo_export.datasets.describe import summary

    found = open_dataset(dataset)
    print(summary(found), file=sys.stderr, flush=True)
    return found


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"cvo-export {version('cvo-export')} (cvo-edge {version('cvo-edge')})")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the versions."),
    ] = False,
) -> None:
    """Define the options of the program itself."""
