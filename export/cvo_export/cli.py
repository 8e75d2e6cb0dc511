"""The command line ``cvo-export``: argument parsing and exit codes only."""

from __future__ import annotations

import json
import sys
from contextlib import nullcontext
from functools import partial
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import typer
from typer.core import TyperCommand

from cvo_edge.errors import UsageError
from cvo_edge.files import write_text
from cvo_edge.process import guarded, quiet_libraries
from cvo_edge.programs.cli import examples
from cvo_edge.vocabulary import Crop, Joint, Precision, Provider, Scope, Sides, SplitKind
from cvo_export.progress import show_progress
from cvo_export.vocabulary import GivenRotation, Normalisation, Rule, StudyEngine, Subset

if TYPE_CHECKING:
    from cvo_export.datasets import PoseDataset

app = typer.Typer(
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Train a pose network with bounds, export it to one ONNX graph, calibrate and evaluate "
    "it. DATASET is FORMAT:PATH, e.g. 7scenes:scenes/redkitchen or synthetic:room; the formats are "
    "7scenes, rgbd-scenes, tum, kitti, euroc and synthetic.",
)

_DATA, _NETWORK, _TRAINING = "Data", "Network", "Training"


DatasetArgument = Annotated[
    str, typer.Argument(help="FORMAT:PATH, e.g. 7scenes:scenes/redkitchen.", show_default=False)
]

BackboneOption = Annotated[str, typer.Option(help="Any timm model.", rich_help_panel=_NETWORK)]
WeightsOption = Annotated[
    str,
    typer.Option(
        help="timm (downloads), a safetensors file, or none (random, untrained).",
        rich_help_panel=_NETWORK,
    ),
]
StagesOption = Annotated[
    str,
    typer.Option(
        help="Strides of the stages used, e.g. 16 or 8,16; final: the last layer.",
        rich_help_panel=_NETWORK,
    ),
]
GridOption = Annotated[
    str,
    typer.Option(
        help="Rows x columns that each stage is averaged to; 1x1: global mean.",
        rich_help_panel=_NETWORK,
    ),
]
CopiesOption = Annotated[
    int | None,
    typer.Option(
        min=0, help="Augmented copies of each training frame; default: 48.", rich_help_panel=_DATA
    ),
]
StepsOption = Annotated[
    int | None,
    typer.Option(
        min=100, help="Training steps of the head; default: 10000.", rich_help_panel=_TRAINING
    ),
]
TrainingSplitOption = Annotated[
    SplitKind | None,
    typer.Option(
        help="Unit of the split; default: sequence if there are at least five, else block.",
        rich_help_panel=_DATA,
    ),
]


def _open(dataset: str) -> PoseDataset:
    """Open a data set; print on stderr what was read, and what was skipped and why."""
    from cvo_export.datasets import open_dataset
    from cvo_export.datasets.describe import summary

    opened = open_dataset(dataset)
    print(summary(opened), file=sys.stderr, flush=True)
    return opened


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
            rich_help_panel=_DATA,
        ),
    ] = None,
    light: Annotated[
        float | None,
        typer.Option(
            min=0, help="Changes of light in the copies, 0 to 1; default: 1.", rich_help_panel=_DATA
        ),
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(
            help="Folder of features shared by several runs; default: in RUN_DIR.",
            rich_help_panel=_DATA,
        ),
    ] = None,
    backbone: BackboneOption = "mobilenetv2_100",
    weights: WeightsOption = "timm",
    stages: StagesOption = "16",
    grid: GridOption = "3x4",
    normalisation: Annotated[
        Normalisation | None,
        typer.Option(
            help="Pixel scaling; default: half, (x - 127.5)/127.5, for a file, else timm's.",
            rich_help_panel=_NETWORK,
        ),
    ] = None,
    size: Annotated[
        str,
        typer.Option(help="Width x height of the model's input.", rich_help_panel=_NETWORK),
    ] = "256x192",
    crop: Annotated[
        Crop,
        typer.Option(help="Part of the image that the model sees.", rich_help_panel=_NETWORK),
    ] = "none",
    seed: Annotated[
        int,
        typer.Option(min=0, help="Of split, training and noise.", rich_help_panel=_TRAINING),
    ] = 0,
    steps: StepsOption = None,
    fine_tune: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Epochs in which the backbone learns as well; default: 0, frozen.",
            rich_help_panel=_TRAINING,
        ),
    ] = None,
    **options: Any,  # noqa: ANN401 - the methods' own
) -> None:
    """Train a method on a data set; repeat the command to resume an interrupted run."""
    from cvo_export.data.splits import default_kind
    from cvo_export.training.configure import configure, head_config
    from cvo_export.training.loop import train

    # Options of another method are refused before any data is opened.
    head_config(method, options)
    opened = _open(dataset)
    config = configure(
        method=method,
        dataset=dataset,
        split=split or default_kind(opened),
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
        head=options,
    )
    with show_progress() as progress:
        run = train(run_dir, config, progress, cache)
    print(*run.lines(), sep="\n", file=sys.stderr)


class _TrainCommand(TyperCommand):
    """Gets its parameters when they are first needed: the methods' options import torch."""

    _built = False

    def get_params(self, ctx: typer.Context) -> list[Any]:  # type: ignore[override]
        """Return the command's parameters, those of the registered methods included."""
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
    """Be listed; ``_TrainCommand`` has the parameters."""


RuleOption = Annotated[
    Rule | None,
    typer.Option(
        help="What one calibration draw is: a frame (pooled) or a sequence (hierarchical); "
        "default: hierarchical for a split by sequence, else pooled."
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
    typer.Option(help="cqr: bounds that are calibrated; default in a new bundle: symmetric."),
]
NameOption = Annotated[str | None, typer.Option(help="Default: the folder's name.")]


@app.command(
    epilog=examples(
        "cvo-export publish runs/redkitchen bundles/redkitchen",
        "cvo-export publish runs/redkitchen bundles/redkitchen-int8 --precision int8",
    )
)
def publish(
    run_dir: Annotated[Path, typer.Argument(help="A finished run.", show_default=False)],
    bundle: Annotated[Path, typer.Argument(help="Bundle folder to write.", show_default=False)],
    precision: Annotated[
        Precision, typer.Option(help="int8: an 8-bit backbone, with thresholds of its own.")
    ] = "fp32",
    provider: Annotated[
        Provider, typer.Option(help="Engine that the bundle is calibrated for and runs on.")
    ] = "onnxruntime",
    rule: RuleOption = None,
    joint: JointOption = "max",
    score: ScoreOption = None,
    sides: SidesOption = None,
    name: NameOption = None,
    dataset: Annotated[
        str | None, typer.Option(help="New location of the data set, if it has moved.")
    ] = None,
) -> None:
    """Export a run to ONNX, calibrate that graph and write its bundle."""
    from cvo_edge.programs.inspect import inspect_lines
    from cvo_export.publish import publish as publish_run
    from cvo_export.training.run import load_run

    calibration = publish_run(
        load_run(run_dir, dataset),
        bundle,
        name or bundle.resolve().name,
        rule=rule,
        joint=joint,
        score=score,
        sides=sides,
        precision=precision,
        provider=provider,
    )
    print(*inspect_lines(calibration), sep="\n")


@app.command(
    epilog=examples(
        "cvo-export calibrate my-network.onnx tum:freiburg1_room bundles/room",
        "cvo-export calibrate bundles/redkitchen 7scenes:scenes/office bundles/office",
    )
)
def calibrate(
    model: Annotated[
        Path, typer.Argument(help="An ONNX file, or a bundle folder.", show_default=False)
    ],
    dataset: DatasetArgument,
    bundle: Annotated[Path, typer.Argument(help="Bundle folder to write.", show_default=False)],
    split: Annotated[
        SplitKind | None,
        typer.Option(
            help="Unit of the split; default: sequence if there are at least three, else block."
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the split; default: 0.")] = None,
    rule: RuleOption = None,
    joint: JointOption = "max",
    score: ScoreOption = None,
    sides: SidesOption = None,
    rotation: Annotated[
        GivenRotation | None,
        typer.Option(help="ONNX file: chart of its bounds; default: tangent_predicted."),
    ] = None,
    crop: Annotated[
        Crop | None, typer.Option(help="ONNX file: part of the image it sees; default: none.")
    ] = None,
    new_data: Annotated[
        bool,
        typer.Option("--new-data", help="Bundle: accept data of the same name as new."),
    ] = False,
    provider: Annotated[
        Provider | None,
        typer.Option(help="Engine to calibrate for; default: the bundle's own, or onnxruntime."),
    ] = None,
    name: NameOption = None,
) -> None:
    """Calibrate an existing network, an ONNX file or a bundle's, on data it has not seen.

    An ONNX file has the input image, uint8 of shape (1, height, width, 3), RGB,
    and the output pose (1, 7); for intervals that adapt, also the outputs lower
    and upper (1, 6).
    """
    from cvo_edge.programs.inspect import inspect_lines
    from cvo_export.calibrate import recalibrate

    calibration = recalibrate(
        model,
        _open(dataset),
        bundle,
        name or bundle.resolve().name,
        kind=split,
        seed=seed,
        rule=rule,
        joint=joint,
        score=score,
        sides=sides,
        rotation=rotation,
        crop=crop,
        new_data=new_data,
        provider=provider,
    )
    print(*inspect_lines(calibration), sep="\n")


@app.command()
def sign(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder.", show_default=False)],
    key: Annotated[Path, typer.Option(help="Ed25519 private key (PEM).", show_default=False)],
    bundle_version: Annotated[
        int | None,
        typer.Option(
            help="Devices refuse versions below one they have run; default: seconds since 1970.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Sign a bundle for devices that accept only signed ones (run --public-key)."""
    from cvo_export.sign import sign as sign_bundle

    signature = sign_bundle(bundle, key, bundle_version)
    print(f"{signature.name}: version {signature.version}, signed with the key {signature.key}")


@app.command(
    epilog=examples(
        "cvo-export evaluate bundles/redkitchen 7scenes:scenes/redkitchen",
        "cvo-export evaluate bundles/redkitchen 7scenes:new-flights --subset all",
        "cvo-export evaluate bundles/room synthetic:room --noise speckle:0.3",
    )
)
def evaluate(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder.", show_default=False)],
    dataset: DatasetArgument,
    subset: Annotated[
        Subset, typer.Option(help="The run's test frames, or all frames of unseen data.")
    ] = "test",
    noise: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[:STRENGTH]",
            help="Degrade the frames, e.g. speckle:0.3.",
        ),
    ] = None,
    json_file: Annotated[
        str | None, typer.Option("--json", help="Write the report as JSON to a file or -.")
    ] = None,
    min_coverage: Annotated[
        float | None,
        typer.Option(min=0, max=1, help="Exit 8 if any DoF covers less at 0.9 marginal."),
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Threads of one inference.")] = None,
) -> None:
    """Measure coverage, width and error of a bundle on held-out frames.

    With --noise, the frames are degraded; results are given for the bundle's own
    thresholds and for thresholds of calibration frames with the same noise. NAME
    is gaussian, salt-and-pepper, speckle, motion-blur, exposure or occlusion.
    """
    from cvo_export.data.noise import parse_noise
    from cvo_export.evaluate import check_coverage, table
    from cvo_export.evaluate import evaluate as evaluate_bundle

    parsed = None if noise is None else parse_noise(noise)
    report = evaluate_bundle(bundle, _open(dataset), subset, threads, parsed)
    if json_file is not None:
        write_text(json_file, json.dumps(report, indent=1) + "\n")
    if json_file != "-":
        print(*table(report), sep="\n")
    if min_coverage is not None:
        check_coverage(report, min_coverage)


@app.command()
def compare(
    dataset: DatasetArgument,
    out: Annotated[Path, typer.Argument(help="New folder, or that of an interrupted comparison.")],
    methods: Annotated[
        str | None, typer.Option(help="Names with commas; default: all methods and baselines.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds, from 0.")] = 3,
    split: TrainingSplitOption = None,
    backbone: BackboneOption = "mobilenetv2_100",
    weights: WeightsOption = "timm",
    stages: StagesOption = "16",
    grid: GridOption = "3x4",
    steps: StepsOption = None,
    copies: CopiesOption = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Concurrent runs; default: one a core.")
    ] = None,
    cache: Annotated[Path | None, typer.Option(help="Folder of features; default: in OUT.")] = None,
) -> None:
    """Train, publish and evaluate methods and baselines over seeds, and time their frames.

    Repeat the command to resume. OUT gets compare.json and the table compare.txt.
    """
    from cvo_export.networks.methods import TRAINABLE
    from cvo_export.study.compare import compare as compare_methods

    _open(dataset)
    options = {
        "dataset": dataset,
        "split": split,
        "size": "256x192",
        "crop": "none",
        "backbone": backbone,
        "weights": weights,
        "stages": stages,
        "grid": grid,
        "normalisation": None,
        "steps": steps,
        "copies": copies,
    }
    with show_progress() as progress:
        lines = compare_methods(
            out,
            options,
            list(TRAINABLE) if methods is None else methods.split(","),
            seeds,
            jobs=jobs,
            cache=cache,
            progress=progress,
            say=partial(print, file=sys.stderr, flush=True),
        )
    print(*lines, sep="\n")


@app.command()
def study(
    config: Annotated[Path, typer.Argument(help="Grids to run, TOML.", show_default=False)],
    out: Annotated[Path, typer.Argument(help="New folder, or that of an interrupted study.")],
    engine: Annotated[
        StudyEngine, typer.Option(help="Processes of this machine, or a Ray cluster.")
    ] = "local",
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Engine local: concurrent runs; default: one a core.")
    ] = None,
    cache: Annotated[Path | None, typer.Option(help="Folder of features; default: in OUT.")] = None,
) -> None:
    """Run grids of methods, backbones, data, noise, options and seeds, and report on them.

    Repeat the command to resume. OUT gets results.json, report.html and pictures.
    """
    from cvo_edge.cores import allowed_cores
    from cvo_export.study.cells import CellFolder
    from cvo_export.study.grid import read_study, run_study
    from cvo_export.study.ray_engine import ray_engine
    from cvo_export.study.report import page_template, write_report
    from cvo_export.study.workers import run_tasks

    if engine == "ray" and jobs is not None:
        raise UsageError("--jobs: expected only with the engine local, found the engine ray")
    # Fail now rather than after hours if the page cannot be written.
    template = page_template()
    grids = read_study(config)
    local = nullcontext(partial(run_tasks, jobs or allowed_cores()))
    with local if engine == "local" else ray_engine() as run, show_progress() as progress:
        folder = CellFolder(out.resolve(), (cache or out / "features").resolve())
        say = partial(print, file=sys.stderr, flush=True)
        results = run_study(grids, folder, run, progress, say)
    print(write_report(results, folder, template))


@app.command()
def plot(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder.", show_default=False)],
    dataset: DatasetArgument,
    out: Annotated[Path, typer.Option(help="Picture to write, e.g. bands.png.")],
    subset: Annotated[
        Subset, typer.Option(help="The run's test frames, or all frames of unseen data.")
    ] = "test",
    sequence: Annotated[str | None, typer.Option(help="Only this sequence.")] = None,
    confidence: Annotated[float, typer.Option(help="A confidence stored in the bundle.")] = 0.9,
    scope: Annotated[
        Scope,
        typer.Option(help="Whether it holds for each degree of freedom or for all six at once."),
    ] = "marginal",
) -> None:
    """Plot truth, point and bands of each degree of freedom, and x against y."""
    from cvo_export.plot import plot as draw

    draw(
        bundle,
        _open(dataset),
        out,
        subset=subset,
        sequence=sequence,
        confidence=confidence,
        scope=scope,
    )
    print(out)


@app.command()
def render(
    dataset: DatasetArgument,
    folder: Annotated[Path, typer.Argument(help="New folder.", show_default=False)],
    sequence: Annotated[str, typer.Option(help="Name of one sequence.")],
    frames: Annotated[
        int | None, typer.Option(min=1, help="Only the first frames, this many.")
    ] = None,
) -> None:
    """Write one sequence as a 7-Scenes folder: JPEG images and .pose.txt."""
    from cvo_export.datasets.seven_scenes import write_sequence

    opened = _open(dataset)
    if sequence not in opened.sequence_names:
        raise UsageError(
            f"sequence: expected one of {opened.sequence_names[0]} to "
            f"{opened.sequence_names[-1]}, found {sequence}"
        )
    count = write_sequence(opened, opened.sequence_names.index(sequence), folder, frames)
    print(f"{folder}: {count} frames of {sequence}")


@app.command()
def dataset(dataset: DatasetArgument) -> None:
    """Describe a data set: frames, skipped frames and why, sequences, camera, extent."""
    from cvo_export.datasets import open_dataset
    from cvo_export.datasets.describe import describe

    print(*describe(open_dataset(dataset)), sep="\n")


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
    """Options that need no command."""


def main() -> NoReturn:
    """Entry point of ``cvo-export``."""
    quiet_libraries()
    guarded("cvo-export", app)
