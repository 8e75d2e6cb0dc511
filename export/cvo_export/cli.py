"""The command line ``cvo-export``: argument parsing and exit codes only."""

from __future__ import annotations

import json
import sys
from contextlib import nullcontext
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from cvo_edge.errors import UsageError
from cvo_edge.files import write_text
from cvo_edge.process import guarded, quiet_libraries
from cvo_edge.programs.cli import ScopeName
from cvo_export.progress import show_progress

if TYPE_CHECKING:
    from cvo_export.datasets import PoseDataset

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Train a pose network with bounds, export it to one ONNX graph, calibrate it, evaluate "
    "it. DATASET is FORMAT:PATH, e.g. 7scenes:scenes/redkitchen or synthetic:room; formats are "
    "7scenes, rgbd-scenes, tum, kitti, euroc and synthetic.",
)


class MethodName(StrEnum):
    """Methods that can be trained, and baselines."""

    CJP = "cjp"
    CQR = "cqr"
    CSP = "csp"
    MCQR = "mcqr"
    MC_DROPOUT = "mc-dropout"
    ENSEMBLE = "ensemble"
    GAUSSIAN = "gaussian"
    MDN = "mdn"
    PINBALL = "pinball"
    SPLIT = "split"


class EngineName(StrEnum):
    """Where the cells of a study are run."""

    LOCAL = "local"
    RAY = "ray"


class SplitName(StrEnum):
    """How frames get their roles."""

    RANDOM = "random"
    BLOCK = "block"
    SEQUENCE = "sequence"


class CropName(StrEnum):
    """What the model sees of an image."""

    NONE = "none"
    CENTRE = "centre"


class NormalisationName(StrEnum):
    """Mean and deviation that pixels are normalised with."""

    HALF = "half"
    TIMM = "timm"


class LatentName(StrEnum):
    """What inference draws from the latent Gaussian."""

    MEAN = "mean"
    CODEBOOK = "codebook"
    SAMPLE = "sample"


class BoundsName(StrEnum):
    """How the network gives its bounds."""

    SOFTPLUS = "softplus"
    FREE = "free"


class PointLossName(StrEnum):
    """Loss of the point."""

    ABSOLUTE = "absolute"
    SQUARED = "squared"


class GateName(StrEnum):
    """Which coverage gates the calibration loss."""

    CORRECTED = "corrected"
    LITERAL = "literal"


class IntervalFormName(StrEnum):
    """Which reading of the interval score trains the bounds."""

    PROPER = "proper"
    MEAN = "mean"
    SUM = "sum"


class LabelsName(StrEnum):
    """What the classifier is trained to answer."""

    ORDINAL = "ordinal"
    ONE_HOT = "one_hot"


class ForestName(StrEnum):
    """One forest for all degrees of freedom, or one each."""

    SHARED = "shared"
    PER_DOF = "per_dof"


class ResidualsName(StrEnum):
    """Which frames the forest's residuals come from."""

    AUTO = "auto"
    CROSS_FITTED = "cross_fitted"
    HELD_OUT = "held_out"


class AugmentationName(StrEnum):
    """What MC-dropout passes add to the training data of a region."""

    NONE = "none"
    PREDICTIONS = "predictions"
    LABELS = "labels"


class ScaleName(StrEnum):
    """What decides the unit of a region's codebook."""

    LOCAL = "local"
    CONSTANT = "constant"


class ProviderName(StrEnum):
    """The engine that a bundle is calibrated on, and runs on."""

    ONNXRUNTIME = "onnxruntime"
    OPENVINO = "openvino"


class PrecisionName(StrEnum):
    """Of the backbone's numbers."""

    FP32 = "fp32"
    INT8 = "int8"


class JointName(StrEnum):
    """How six scores become the joint scope."""

    MAX = "max"
    BONFERRONI = "bonferroni"


class SidesName(StrEnum):
    """Which bounds are calibrated, and how."""

    SYMMETRIC = "symmetric"
    ASYMMETRIC = "asymmetric"
    LOWER = "lower"
    UPPER = "upper"


class RotationName(StrEnum):
    """What the rotation numbers of a given network are."""

    TANGENT_PREDICTED = "tangent_predicted"
    EULER_ZYX = "euler_zyx"


class RuleName(StrEnum):
    """What the calibration counts as one draw: a frame, or a sequence."""

    POOLED = "pooled"
    HIERARCHICAL = "hierarchical"


class SubsetName(StrEnum):
    """The frames recorded as test, or all of data that the run has not seen."""

    TEST = "test"
    ALL = "all"


DatasetArgument = Annotated[
    str, typer.Argument(help="FORMAT:PATH, e.g. 7scenes:scenes/redkitchen.", show_default=False)
]

BackboneOption = Annotated[str, typer.Option(help="Any timm model.")]
WeightsOption = Annotated[
    str, typer.Option(help="timm (downloads), a safetensors file, or none (random, untrained).")
]
StagesOption = Annotated[
    str, typer.Option(help="Strides of the stages used, e.g. 16 or 8,16; final: the last layer.")
]
GridOption = Annotated[
    str, typer.Option(help="Rows x columns each stage is averaged to; 1x1: global mean.")
]
CopiesOption = Annotated[
    int | None, typer.Option(min=0, help="Augmented copies of each training frame.")
]
StepsOption = Annotated[int | None, typer.Option(min=100, help="Steps of training the head.")]


def _open(dataset: str) -> PoseDataset:
    """Open a data set and say on stderr what was read, and what was left out and why."""
    from cvo_export.datasets import open_dataset
    from cvo_export.datasets.describe import summary

    opened = open_dataset(dataset)
    print(summary(opened), file=sys.stderr, flush=True)
    return opened


@app.command()
def train(
    method: Annotated[
        MethodName,
        typer.Argument(
            help="Conformal method (cjp, cqr, csp, mcqr); the others are baselines.",
            show_default=False,
        ),
    ],
    dataset: DatasetArgument,
    run_dir: Annotated[
        Path,
        typer.Argument(help="New folder; or one to go on with, same options.", show_default=False),
    ],
    backbone: BackboneOption = "mobilenetv2_100",
    weights: WeightsOption = "timm",
    stages: StagesOption = "16",
    grid: GridOption = "3x4",
    normalisation: Annotated[
        NormalisationName | None,
        typer.Option(help="Pixel scaling; half (x - 127.5)/127.5 for a file, timm for timm's."),
    ] = None,
    size: Annotated[str, typer.Option(help="Width x height of the model's input.")] = "256x192",
    crop: Annotated[CropName, typer.Option(help="What the model sees.")] = CropName.NONE,
    split: Annotated[
        SplitName | None,
        typer.Option(help="sequence where there are five or more, else block."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Decides split, training and noise.")] = 0,
    copies: CopiesOption = None,
    rotation_deg: Annotated[
        float | None, typer.Option(min=0, help="Camera turns of the copies, deviation per axis.")
    ] = None,
    light: Annotated[
        float | None, typer.Option(min=0, help="Changes of light of the copies, 0 to 1.")
    ] = None,
    fine_tune: Annotated[
        int | None, typer.Option(min=0, help="Epochs of training the backbone, too; 0: frozen.")
    ] = None,
    steps: StepsOption = None,
    cache: Annotated[
        Path | None,
        typer.Option(help="Folder of features that several runs share; else in the run's."),
    ] = None,
    latent_size: Annotated[
        int | None, typer.Option(min=1, help="cjp: dimension of the latent, 16; the paper's is 3.")
    ] = None,
    latent: Annotated[
        LatentName | None, typer.Option(help="cjp: mean by default; the paper's is sample.")
    ] = None,
    bounds: Annotated[
        BoundsName | None, typer.Option(help="cjp: softplus by default; free: sorted outputs.")
    ] = None,
    sharpness: Annotated[
        float | None, typer.Option(min=0, max=1, help="cjp: lambda of the calibration loss, 0.5.")
    ] = None,
    point_loss: Annotated[
        PointLossName | None,
        typer.Option(help="cjp: absolute by default; squared: the paper's."),
    ] = None,
    gate: Annotated[
        GateName | None, typer.Option(help="cjp: corrected by default; literal: Eq. 5a.")
    ] = None,
    interval_form: Annotated[
        IntervalFormName | None, typer.Option(help="cjp: proper by default; mean: the paper's.")
    ] = None,
    kl_weight: Annotated[
        float | None, typer.Option(min=0, help="beta of the divergence; cjp: 0.001, mcqr: 0.01.")
    ] = None,
    members: Annotated[
        int | None, typer.Option(min=1, max=64, help="cjp: networks whose answers are averaged, 1.")
    ] = None,
    quantiles: Annotated[
        tuple[float, float] | None,
        typer.Option(help="cqr: levels of the bounds before conformalising, 0.05 0.95."),
    ] = None,
    trees: Annotated[int | None, typer.Option(min=1, help="cqr: trees of the forest, 100.")] = None,
    leaf_size: Annotated[
        int | None, typer.Option(min=1, help="cqr: least rows in a leaf, 10.")
    ] = None,
    split_features: Annotated[
        float | None, typer.Option(help="cqr: share of inputs tried at a split, 0.33.")
    ] = None,
    components: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="cqr, mcqr: principal components of the features, 58, 16; mdn: Gaussians, 3.",
        ),
    ] = None,
    forest: Annotated[
        ForestName | None, typer.Option(help="cqr: shared by default; per_dof: the paper's.")
    ] = None,
    residuals: Annotated[
        ResidualsName | None,
        typer.Option(help="cqr, mcqr: cross_fitted below 1500 frames by default, else held_out."),
    ] = None,
    forest_copies: Annotated[
        int | None, typer.Option(min=0, help="cqr: augmented copies among the forest's rows.")
    ] = None,
    classes: Annotated[
        int | None,
        typer.Option(min=2, max=256, help="csp: K, classes of each degree of freedom, 128."),
    ] = None,
    labels: Annotated[
        LabelsName | None, typer.Option(help="csp: ordinal by default; one_hot: the paper's.")
    ] = None,
    label_sigma: Annotated[
        float | None,
        typer.Option(min=0.01, help="csp: deviation of the labels in classes; val chooses."),
    ] = None,
    augmentation: Annotated[
        AugmentationName | None,
        typer.Option(
            help="mcqr: MC-dropout passes as training data; none by default; predictions: the "
            "paper's."
        ),
    ] = None,
    passes: Annotated[
        int | None, typer.Option(min=1, help="mcqr: stochastic passes of each frame, 20.")
    ] = None,
    scale: Annotated[
        ScaleName | None, typer.Option(help="mcqr: local by default; constant: the paper's.")
    ] = None,
    kappa: Annotated[
        float | None, typer.Option(min=0.01, help="mcqr: inflation of the region; val chooses.")
    ] = None,
    dropout: Annotated[
        float | None,
        typer.Option(
            min=0, max=0.99, help="mc-dropout: rate, 0.01; mcqr: 0.05 with passes; cjp, csp: 0."
        ),
    ] = None,
) -> None:
    """Train a method on a data set; interrupted, the same command goes on.

    Options that begin with the name of a method belong to that method.
    """
    from cvo_export.data.splits import default_kind
    from cvo_export.training.configure import configure
    from cvo_export.training.loop import train as train_run

    opened = _open(dataset)
    config = configure(
        method=method.value,
        dataset=dataset,
        split=split.value if split else default_kind(opened),
        seed=seed,
        size=size,
        crop=crop.value,
        backbone=backbone,
        weights=weights,
        stages=stages,
        grid=grid,
        normalisation=normalisation.value if normalisation else None,
        copies=copies,
        rotation_deg=rotation_deg,
        light=light,
        fine_tune=fine_tune,
        steps=steps,
        head={
            "latent_size": latent_size,
            "latent": latent,
            "bounds": bounds,
            "sharpness": sharpness,
            "point_loss": point_loss,
            "gate": gate,
            "interval_form": interval_form,
            "kl_weight": kl_weight,
            "members": members,
            "quantiles": quantiles,
            "trees": trees,
            "leaf_size": leaf_size,
            "split_features": split_features,
            "components": components,
            "forest": forest,
            "residuals": residuals,
            "forest_copies": forest_copies,
            "classes": classes,
            "labels": labels,
            "label_sigma": label_sigma,
            "dropout": dropout,
            "augmentation": augmentation.value if augmentation else None,
            "passes": passes,
            "scale": scale.value if scale else None,
            "kappa": kappa,
        },
    )
    with show_progress() as progress:
        run = train_run(run_dir, config, progress, cache)
    print(*run.lines(), sep="\n", file=sys.stderr)


RuleOption = Annotated[
    RuleName | None,
    typer.Option(help="hierarchical for a split by sequence, else pooled."),
]
JointOption = Annotated[JointName, typer.Option(help="How the joint scope is made.")]
ScoreOption = Annotated[
    str | None,
    typer.Option(help="csp: aps, lac, raps; all others: normalised, additive; val decides."),
]
SidesOption = Annotated[
    SidesName | None,
    typer.Option(help="cqr: which bounds are calibrated; symmetric in a new bundle."),
]
NameOption = Annotated[str | None, typer.Option(help="The folder's name by default.")]


@app.command()
def publish(
    run_dir: Annotated[Path, typer.Argument(help="A finished run.", show_default=False)],
    bundle: Annotated[Path, typer.Argument(help="Bundle folder to write.", show_default=False)],
    precision: Annotated[
        PrecisionName, typer.Option(help="int8: an 8-bit backbone, calibrated as such.")
    ] = PrecisionName.FP32,
    provider: Annotated[
        ProviderName, typer.Option(help="The engine that is calibrated, and that it runs on.")
    ] = ProviderName.ONNXRUNTIME,
    rule: RuleOption = None,
    joint: JointOption = JointName.MAX,
    score: ScoreOption = None,
    sides: SidesOption = None,
    name: NameOption = None,
    dataset: Annotated[
        str | None, typer.Option(help="Where the data set is now, if it has moved.")
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
        rule=rule.value if rule else None,
        joint=joint.value,
        score=score,
        sides=sides.value if sides else None,
        precision=precision.value,
        provider=provider.value,
    )
    print(*inspect_lines(calibration), sep="\n")


@app.command()
def calibrate(
    model: Annotated[
        Path, typer.Argument(help="An ONNX file, or a bundle folder.", show_default=False)
    ],
    dataset: DatasetArgument,
    bundle: Annotated[Path, typer.Argument(help="Bundle folder to write.", show_default=False)],
    split: Annotated[
        SplitName | None,
        typer.Option(help="sequence where there are three or more, else block."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Decides the split; 0.")] = None,
    rule: RuleOption = None,
    joint: JointOption = JointName.MAX,
    score: ScoreOption = None,
    sides: SidesOption = None,
    rotation: Annotated[
        RotationName | None,
        typer.Option(help="ONNX file: chart of its bounds; tangent_predicted by default."),
    ] = None,
    crop: Annotated[
        CropName | None, typer.Option(help="ONNX file: what it sees; none by default.")
    ] = None,
    new_data: Annotated[
        bool,
        typer.Option("--new-data", help="Bundle: the data are new, though of the same name."),
    ] = False,
    provider: Annotated[
        ProviderName | None,
        typer.Option(help="The engine that it is to run on; the bundle's own, else onnxruntime."),
    ] = None,
    name: NameOption = None,
) -> None:
    """Calibrate a network that is there, on data that it has not seen: your own, or a bundle's.

    An ONNX file has the input image, uint8 [1, height, width, 3], RGB, and the outputs pose [1, 7]
    and, for intervals that adapt, lower and upper [1, 6].
    """
    from cvo_edge.programs.inspect import inspect_lines
    from cvo_export.calibrate import calibrate as calibrate_network

    calibration = calibrate_network(
        model,
        _open(dataset),
        bundle,
        name or bundle.resolve().name,
        kind=split.value if split else None,
        seed=seed,
        rule=rule.value if rule else None,
        joint=joint.value,
        score=score,
        sides=sides.value if sides else None,
        rotation=rotation.value if rotation else None,
        crop=crop.value if crop else None,
        new_data=new_data,
        provider=provider.value if provider else None,
    )
    print(*inspect_lines(calibration), sep="\n")


@app.command()
def sign(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder.", show_default=False)],
    key: Annotated[Path, typer.Option(help="Ed25519 private key (PEM).", show_default=False)],
    bundle_version: Annotated[
        int | None,
        typer.Option(
            help="Devices that have run it refuse lower ones; by default the seconds since 1970.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Sign a bundle, for devices that are told whose to take (run --public-key)."""
    from cvo_export.sign import sign as sign_bundle

    signature = sign_bundle(bundle, key, bundle_version)
    print(f"{signature.name}: version {signature.version}, signed with the key {signature.key}")


@app.command()
def evaluate(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder.", show_default=False)],
    dataset: DatasetArgument,
    subset: Annotated[
        SubsetName, typer.Option(help="The run's test frames, or all of unseen data.")
    ] = SubsetName.TEST,
    noise: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[:STRENGTH]",
            help="Degrade the frames, e.g. speckle:0.3; thresholds as they are, and recalibrated.",
        ),
    ] = None,
    json_file: Annotated[
        str | None, typer.Option("--json", help="Write the report as JSON to a file or -.")
    ] = None,
    min_coverage: Annotated[
        float | None,
        typer.Option(min=0, max=1, help="Exit 8 where a DoF covers less at 0.9 marginal."),
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Threads of one inference.")] = None,
) -> None:
    """Coverage, width and error of a bundle on held-out frames.

    With --noise of degraded test frames: at the bundle's own thresholds, and at those of the run's
    calibration frames degraded alike. NAME is gaussian, salt-and-pepper, speckle, motion-blur,
    exposure or occlusion.
    """
    from cvo_export.data.noise import parse_noise
    from cvo_export.evaluate import check_coverage, table
    from cvo_export.evaluate import evaluate as evaluate_bundle

    parsed = None if noise is None else parse_noise(noise)
    report = evaluate_bundle(bundle, _open(dataset), subset.value, threads, parsed)
    if json_file is not None:
        write_text(json_file, json.dumps(report, indent=1) + "\n")
    if json_file != "-":
        print(*table(report), sep="\n")
    if min_coverage is not None:
        check_coverage(report, min_coverage)


@app.command()
def compare(
    dataset: DatasetArgument,
    out: Annotated[Path, typer.Argument(help="Folder of the comparison; or one to go on with.")],
    methods: Annotated[
        str | None, typer.Option(help="Names with commas; all methods and baselines by default.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="How many, from 0 on.")] = 3,
    split: Annotated[
        SplitName | None,
        typer.Option(help="sequence where there are five or more, else block."),
    ] = None,
    backbone: BackboneOption = "mobilenetv2_100",
    weights: WeightsOption = "timm",
    stages: StagesOption = "16",
    grid: GridOption = "3x4",
    steps: StepsOption = None,
    copies: CopiesOption = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Runs at a time; all allowed cores by default.")
    ] = None,
    cache: Annotated[
        Path | None, typer.Option(help="Folder of features; by default in OUT.")
    ] = None,
) -> None:
    """Train, publish and evaluate methods and baselines over seeds, and time their frames.

    Interrupted, the same command goes on. OUT gets compare.json and the table compare.txt.
    """
    from cvo_export.networks.methods import TRAINABLE
    from cvo_export.study.compare import compare as compare_methods

    _open(dataset)
    options = {
        "dataset": dataset,
        "split": split.value if split else None,
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
    out: Annotated[Path, typer.Argument(help="Folder of the study; or one to go on with.")],
    engine: Annotated[
        EngineName, typer.Option(help="Processes of this machine, or a Ray cluster.")
    ] = EngineName.LOCAL,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="local: runs at a time; all allowed cores by default.")
    ] = None,
    cache: Annotated[
        Path | None, typer.Option(help="Folder of features; by default in OUT.")
    ] = None,
) -> None:
    """Run grids of methods, backbones, data, noise, options and seeds, and report on them.

    Interrupted, the same command goes on. OUT gets results.json, report.html and pictures.
    """
    from cvo_edge.cores import allowed_cores
    from cvo_export.study.cells import CellFolder
    from cvo_export.study.grid import read_study, run_study
    from cvo_export.study.ray_engine import ray_engine
    from cvo_export.study.report import page_template, write_report
    from cvo_export.study.workers import run_tasks

    if engine is EngineName.RAY and jobs is not None:
        raise UsageError("jobs: expected with the engine local alone, found it with ray")
    # Hours later would be late to learn that a page cannot be written.
    template = page_template()
    grids = read_study(config)
    local = nullcontext(partial(run_tasks, jobs or allowed_cores()))
    with local if engine is EngineName.LOCAL else ray_engine() as run, show_progress() as progress:
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
        SubsetName, typer.Option(help="The run's test frames, or all of unseen data.")
    ] = SubsetName.TEST,
    sequence: Annotated[str | None, typer.Option(help="Only this sequence.")] = None,
    confidence: Annotated[float, typer.Option(help="One of those stored in the bundle.")] = 0.9,
    scope: Annotated[
        ScopeName, typer.Option(help="Each degree of freedom, or all six at once.")
    ] = ScopeName.MARGINAL,
) -> None:
    """Draw truth, point and bands of each degree of freedom, and x against y."""
    from cvo_export.plot import plot as draw

    draw(
        bundle,
        _open(dataset),
        out,
        subset=subset.value,
        sequence=sequence,
        confidence=confidence,
        scope=scope.value,
    )
    print(out)


@app.command()
def render(
    dataset: DatasetArgument,
    folder: Annotated[Path, typer.Argument(help="New folder.", show_default=False)],
    sequence: Annotated[str, typer.Option(help="Name of one sequence.")],
    frames: Annotated[int | None, typer.Option(min=1, help="Only the first so many.")] = None,
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
    """Say what a reader finds: frames, skipped ones and why, sequences, camera, extent."""
    from cvo_export.datasets import open_dataset
    from cvo_export.datasets.describe import describe

    print(*describe(open_dataset(dataset)), sep="\n")


def main() -> NoReturn:
    """Entry point of ``cvo-export``."""
    quiet_libraries()
    guarded("cvo-export", app)
