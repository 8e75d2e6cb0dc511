"""The command ``run``: arguments and output only."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.files import check_output
from cvo_edge.process import say
from cvo_edge.programs.convert import (
    BaseOption,
    ChildFrameIdOption,
    FrameIdOption,
    MapOption,
    UnknownVarianceOption,
)
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
    LabelDelayOption,
    LabelsOption,
    MaxFramesOption,
    ModeOption,
    NameOption,
    OutputOption,
    PublicKeyOption,
    RegionOption,
    StampsOption,
    StateOption,
    ThreadsOption,
    TimeoutOption,
    existing_file,
)
from cvo_edge.vocabulary import Scope

if TYPE_CHECKING:
    from cvo_edge.engine.model_cache import ModelCache
    from cvo_edge.estimate import PoseInterval
    from cvo_edge.output.opening import Writing

MavlinkOption = Annotated[
    str | None,
    typer.Option(
        "--mavlink",
        metavar="<address>",
        help="Also send poses to an autopilot: udpout:HOST:PORT, tcp:HOST:PORT or "
        "/dev/ttyUSB0:BAUD; with --map and --base.",
        show_default=False,
        rich_help_panel=REPORT,
    ),
]
MetricsOption = Annotated[
    int | None,
    typer.Option(
        "--metrics",
        min=1,
        max=65535,
        metavar="<port>",
        help="Also serve figures for Prometheus on this port of the loopback interface.",
        show_default=False,
        rich_help_panel=REPORT,
    ),
]


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
    name: NameOption = None,
    mavlink: MavlinkOption = None,
    metrics: MetricsOption = None,
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
    from cvo_edge.output.mavlink import MavlinkSink
    from cvo_edge.output.metrics import MetricsSink
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
    named = (*named_files(ground_truth), *named_files(labels))
    read = (source, bundle, public_key, camera, state, stamps)
    check_output(output, *read, *named, force=force)
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
        cache=model_cache(cache),
        public_key=public_key,
        name=name,
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
        placed = placement_of(header, base, map, frame_id, child_frame_id, unknown_variance)
        if mavlink is not None and (base is None or map is None):
            raise UsageError(
                "--mavlink: expected --map, the bundle's world in north, east, down, and --base, "
                "the vehicle's forward, right, down in the camera"
            )
        with ExitStack() as stack:
            records = open_sink(
                output,
                written_as,
                header,
                placed if written_as == "mcap" or mavlink is None else None,
                region=region,
                existing=existing,
                told=say,
            )
            sinks: list[Writing] = [stack.enter_context(records)]
            if mavlink is not None and placed is not None:
                sinks.append(stack.enter_context(MavlinkSink(mavlink, placed)))
            if metrics is not None:
                sinks.append(stack.enter_context(MetricsSink(metrics)))
            try:
                with frames_progress(watched, summary, frames.length, max_frames) as tick:
                    run_frames(
                        odometer,
                        frames,
                        partial(_write_all, sinks),
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


def _write_all(sinks: Sequence[Writing], estimate: PoseInterval) -> None:
    for sink in sinks:
        sink.write(estimate)


def model_cache(wanted: bool) -> ModelCache | None:
    """Return the user's cache of models, imported only where it is wanted."""
    if not wanted:
        return None
    from cvo_edge.engine.model_cache import ModelCache

    return ModelCache.default()
