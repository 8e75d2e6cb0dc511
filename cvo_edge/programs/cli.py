"""The command line ``cvo-edge``: argument parsing and exit codes only."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from cvo_edge.errors import GateError, SourceError, UsageError
from cvo_edge.files import refuse_overwriting, write_text
from cvo_edge.process import guarded, say
from cvo_edge.programs.convert import (
    BaseOption,
    ChildFrameIdOption,
    FrameIdOption,
    MapOption,
    UnknownVarianceOption,
    convert,
)
from cvo_edge.programs.examine import cache, doctor, inspect, schema, verify
from cvo_edge.programs.motion import annotate, audit, conformalize
from cvo_edge.programs.odometry import odometry
from cvo_edge.programs.options import (
    INTERVALS,
    REPORT,
    AppendOption,
    BundleArgument,
    CacheOption,
    CameraOption,
    ExpectMotionOption,
    ForceOption,
    FormatOption,
    GroundTruthOption,
    JsonFileOption,
    JsonOption,
    LabelDelayOption,
    LabelsOption,
    MaxFramesOption,
    ModeOption,
    OutputOption,
    PublicKeyOption,
    RegionOption,
    StampsOption,
    StateOption,
    ThreadsOption,
    TimeoutOption,
    examples,
    existing_file,
)
from cvo_edge.vocabulary import Mode, Scope

if TYPE_CHECKING:
    from cvo_edge.engine.model_cache import ModelCache

app = typer.Typer(
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Pose intervals from camera images: a 6-DoF pose per frame and, for each degree of "
    "freedom, an interval that holds the truth with a stated probability.",
)

# As many times as fit into memory.
MOST_MEASURED = 10**7


@app.command("demo")
def demonstrate(
    bundle: Annotated[
        Path | None,
        typer.Argument(
            help="A bundle for the synthetic room; the packaged one by default.",
            readable=False,
            show_default=False,
        ),
    ] = None,
    picture: Annotated[Path, typer.Option(help="PNG file to write.", readable=False)] = Path(
        "cvo-edge-demo.png"
    ),
) -> None:
    """Run a bundle on the packaged clip, compare it with the ground truth and draw a picture."""
    from cvo_edge.programs.demo import BUNDLE, demo

    demo(bundle or BUNDLE, picture)


@app.command(
    epilog=examples(
        "cvo-edge run my-bundle recordings/flight-07 -o flight-07.jsonl",
        "cvo-edge run my-bundle /dev/video0 --scope joint --format table",
        "cvo-edge run my-bundle images/ --ground-truth images/ -o out.jsonl",
    )
)
def run(
    bundle: BundleArgument,
    source: Annotated[
        str,
        typer.Argument(
            help="Folder of images, glob, video file, camera index or device, or stream address.",
            show_default=False,
        ),
    ],
    output: OutputOption = "-",
    format: FormatOption = None,
    append: AppendOption = False,
    force: ForceOption = False,
    region: RegionOption = False,
    ground_truth: GroundTruthOption = None,
    quiet: Annotated[
        bool,
        typer.Option("--quiet", help="No progress or summary.", rich_help_panel=REPORT),
    ] = False,
    confidence: Annotated[
        float,
        typer.Option(help="A confidence stored in the bundle.", rich_help_panel=INTERVALS),
    ] = 0.9,
    scope: Annotated[
        Scope,
        typer.Option(
            help="Whether it holds for each degree of freedom or for all six at once.",
            rich_help_panel=INTERVALS,
        ),
    ] = "marginal",
    labels: LabelsOption = None,
    label_delay: LabelDelayOption = 0,
    state: StateOption = None,
    fps: Annotated[
        float | None,
        typer.Option(help="Stamp frames at this rate, from zero.", rich_help_panel="Input"),
    ] = None,
    stamps: StampsOption = None,
    camera: CameraOption = None,
    expect_motion: ExpectMotionOption = False,
    max_frames: MaxFramesOption = None,
    timeout: TimeoutOption = 5.0,
    mode: ModeOption = None,
    threads: ThreadsOption = None,
    cache: CacheOption = True,
    public_key: PublicKeyOption = None,
    base: BaseOption = None,
    map: MapOption = None,
    frame_id: FrameIdOption = None,
    child_frame_id: ChildFrameIdOption = None,
    unknown_variance: UnknownVarianceOption = None,
) -> None:
    """Estimate a pose interval for every frame of a source."""
    from cvo_edge.camera import read_camera
    from cvo_edge.ground_truth import named_files, open_ground_truth
    from cvo_edge.input.capture import shown
    from cvo_edge.input.sources import open_source
    from cvo_edge.odometer import Odometer
    from cvo_edge.output.opening import open_sink
    from cvo_edge.output.records import header_of
    from cvo_edge.output.sinks import format_of
    from cvo_edge.programs.conversion import placement_of
    from cvo_edge.programs.labels import Labels
    from cvo_edge.programs.progress import frames_progress
    from cvo_edge.programs.run import RunSummary
    from cvo_edge.programs.run import run as run_frames

    if label_delay and labels is None:
        raise UsageError("--label-delay: expected --labels FILE with it, found no labels")
    written_as = format_of(output, format)
    existing = existing_file(append, force, written_as)
    read = (source, bundle, public_key, camera, state, stamps)
    refuse_overwriting(output, *read, *named_files(ground_truth), *named_files(labels))
    truth = None if ground_truth is None else open_ground_truth(ground_truth, source)
    labelled = None if labels is None else open_ground_truth(labels, source)
    frames = open_source(source, fps, timeout, stamps)
    with Odometer.load(
        bundle,
        threads=threads,
        mode=mode or ("live" if frames.live else "latency"),
        confidence=confidence,
        scope=scope,
        camera=read_camera(camera) if camera else None,
        adapt=labels is not None,
        state=state,
        cache=_model_cache(cache),
        public_key=public_key,
    ) as odometer:
        if region and not odometer.has_region:
            raise UsageError(
                f"--region: expected a bundle of mcqr, scr or fused and the joint scope, found "
                f"{odometer.calibration.method} and {scope}"
            )
        summary = RunSummary(odometer.chart.dof, confidence, scope, truth=truth)
        watched = output != "-" and not quiet
        header = header_of(
            odometer.calibration,
            odometer.chart,
            odometer.confidence,
            scope,
            stamps="fps" if fps else "arrival" if frames.live else None,
        )
        placement = placement_of(header, base, map, frame_id, child_frame_id, unknown_variance)
        with open_sink(
            output, written_as, header, placement, region=region, existing=existing, told=say
        ) as sink:
            try:
                with frames_progress(watched, summary, frames.length, max_frames) as tick:
                    run_frames(
                        odometer,
                        frames,
                        sink.write,
                        summary=summary,
                        labels=Labels(odometer, labelled, label_delay) if labelled else None,
                        max_frames=max_frames,
                        expect_motion=expect_motion,
                        tick=tick,
                    )
            finally:
                if not quiet and summary.frames:
                    say("\n".join(summary.lines()))
    if summary.statuses["invalid"] == summary.frames:
        raise SourceError(
            f"{shown(source)}: expected at least one valid frame, found none in {summary.frames}"
        )
    if truth is not None and not summary.matched:
        raise SourceError(
            f"{ground_truth}: expected true poses of the frames, found {summary.match_text(truth)}"
        )


@app.command(
    epilog=examples(
        "cvo-edge bench my-bundle",
        "cvo-edge bench my-bundle flight.mp4 --mode throughput --json bench.json",
        "cvo-edge bench my-bundle --max-p95-ms 40 --max-rss-mib 200",
    )
)
def bench(
    bundle: BundleArgument,
    source: Annotated[
        str | None, typer.Argument(help="As for run; default: a fixed image, 640 pixels wide.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=MOST_MEASURED, help="Frames to measure.")] = 200,
    warmup: Annotated[
        int, typer.Option(min=0, max=MOST_MEASURED, help="Frames to run before measuring.")
    ] = 20,
    mode: Annotated[
        Mode, typer.Option(help="As for run; live plays files at 30 frames per second.")
    ] = "latency",
    threads: ThreadsOption = None,
    cache: CacheOption = True,
    json_file: JsonFileOption = None,
    max_p95_ms: Annotated[
        float | None,
        typer.Option(help="Exit 8 if the total's p95 is longer.", rich_help_panel="Gates"),
    ] = None,
    max_rss_mib: Annotated[
        float | None,
        typer.Option(help="Exit 8 if peak memory is larger.", rich_help_panel="Gates"),
    ] = None,
) -> None:
    """Measure latency, memory and processor time next to the bare model call."""
    from cvo_edge.programs.bench import benchmark, benchmark_lines

    if json_file is not None:
        refuse_overwriting(json_file, source, bundle)
    report = benchmark(
        bundle,
        source,
        frames=frames,
        warmup=warmup,
        mode=mode,
        threads=threads,
        cache=_model_cache(cache),
    )
    if json_file is not None:
        write_text(json_file, json.dumps(report, indent=1) + "\n")
    if json_file != "-":
        print(*benchmark_lines(report), sep="\n")
    p95, rss = report["latency_ms"]["total"]["p95"], report["memory_mib"]["peak_rss"]
    if max_p95_ms is not None and not p95 <= max_p95_ms:
        raise GateError(f"bench: expected p95 of at most {max_p95_ms:g} ms, found {p95:.3f} ms")
    if max_rss_mib is not None and not rss <= max_rss_mib:
        raise GateError(f"bench: expected peak memory of at most {max_rss_mib:g} MiB, found {rss}")


@app.command(
    epilog=examples(
        "cvo-edge drift my-bundle monday.jsonl tuesday.jsonl wednesday.jsonl",
        "cvo-edge drift my-bundle *.jsonl --max-martingale 20",
    )
)
def drift(
    bundle: BundleArgument,
    records: Annotated[
        list[Path],
        typer.Argument(
            help="JSON lines of run, one file per recording, oldest first.",
            readable=False,
            show_default=False,
        ),
    ],
    as_json: JsonOption = False,
    max_martingale: Annotated[
        float | None,
        typer.Option(help="Exit 8 if the martingale was ever larger.", rich_help_panel="Gates"),
    ] = None,
) -> None:
    """Tell whether recordings are still like those that the bundle was calibrated on."""
    import msgspec

    from cvo_edge.programs.drift import drift_lines, drift_of

    # Written so that NaN is refused.
    if max_martingale is not None and not max_martingale >= 1.0:
        raise UsageError(f"--max-martingale: expected at least 1, found {max_martingale:g}")
    report = drift_of(bundle, records)
    if as_json:
        print(json.dumps(msgspec.to_builtins(report), indent=1))
    else:
        print(*drift_lines(report), sep="\n")
    if max_martingale is not None and report.largest > max_martingale:
        found = f"found {report.largest:.4g}"
        raise GateError(f"drift: expected a martingale of at most {max_martingale:g}, {found}")


for command in (
    convert,
    odometry,
    conformalize,
    annotate,
    audit,
    verify,
    inspect,
    schema,
    doctor,
    cache,
):
    app.command()(command)


def _model_cache(wanted: bool) -> ModelCache | None:
    if not wanted:
        return None
    from cvo_edge.engine.model_cache import ModelCache

    return ModelCache.default()


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"cvo-edge {version('cvo-edge')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Options that need no command."""


def main() -> NoReturn:
    """Run ``cvo-edge``."""
    guarded("cvo-edge", app)
