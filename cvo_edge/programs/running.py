"""The command ``run``: arguments and output only."""

from __future__ import annotations

from typing import Annotated

import typer

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.files import check_output
from cvo_edge.process import say
from cvo_edge.programs.options import (
    REPORT,
    AppendOption,
    BaseOption,
    BitDepthOption,
    BundleArgument,
    CacheOption,
    CameraOption,
    ChildFrameIdOption,
    ExpectMotionOption,
    FollowOption,
    ForceOption,
    FormatOption,
    FrameIdOption,
    GroundTruthOption,
    LabelDelayOption,
    LabelsOption,
    MapOption,
    MavlinkOption,
    MaxFramesOption,
    MetricsOption,
    ModeOption,
    NameOption,
    OutputOption,
    PublicKeyOption,
    RegionOption,
    RunConfidenceOption,
    RunScopeOption,
    SourceArgument,
    StampsOption,
    StateOption,
    ThreadsOption,
    TimeoutOption,
    UnknownVarianceOption,
    existing_file,
)
from cvo_edge.vocabulary import Format


def run(
    bundle: BundleArgument,
    source: SourceArgument,
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
    confidence: RunConfidenceOption = 0.9,
    scope: RunScopeOption = "marginal",
    labels: LabelsOption = None,
    label_delay: LabelDelayOption = 0,
    state: StateOption = None,
    fps: Annotated[
        float | None,
        typer.Option(help="Stamp frames at this rate, from zero.", rich_help_panel="Input"),
    ] = None,
    stamps: StampsOption = None,
    camera: CameraOption = None,
    bit_depth: BitDepthOption = 16,
    expect_motion: ExpectMotionOption = False,
    max_frames: MaxFramesOption = None,
    follow: FollowOption = False,
    timeout: TimeoutOption = None,
    mode: ModeOption = None,
    threads: ThreadsOption = None,
    cache: CacheOption = True,
    public_key: PublicKeyOption = None,
    name: NameOption = None,
    mavlink: MavlinkOption = None,
    metrics: MetricsOption = None,
    view: Annotated[
        bool,
        typer.Option(
            "--view",
            help="Also show frames, path, set and bands in the viewer rerun: one that listens on "
            "port 9876 of this machine, or a new one if there is a display.",
            rich_help_panel=REPORT,
        ),
    ] = False,
    preview: Annotated[
        bool,
        typer.Option(
            "--preview",
            help="Show status, pose and bands of the running odometer on this terminal.",
            rich_help_panel=REPORT,
        ),
    ] = False,
    base: BaseOption = None,
    map: MapOption = None,
    frame_id: FrameIdOption = None,
    child_frame_id: ChildFrameIdOption = None,
    unknown_variance: UnknownVarianceOption = None,
) -> None:
    """Estimate a pose interval for every frame of a source."""
    from cvo_edge.ground_truth import named_files, open_ground_truth
    from cvo_edge.input.capture import shown
    from cvo_edge.output.sinks import format_of
    from cvo_edge.programs.job import Wanted, opened
    from cvo_edge.programs.labels import Labels
    from cvo_edge.programs.placing import Placing
    from cvo_edge.programs.preview import frames_preview
    from cvo_edge.programs.progress import frames_progress
    from cvo_edge.programs.run import run as run_frames

    if label_delay and labels is None:
        raise UsageError("--label-delay: expected --labels FILE with it, found no labels")
    written_as: Format = format_of(output, format)
    wanted = Wanted(
        bundle=bundle,
        source=source,
        output=output,
        format=written_as,
        existing=existing_file(append, force, written_as),
        region=region,
        confidence=confidence,
        scope=scope,
        fps=fps,
        stamps=stamps,
        camera=camera,
        timeout=timeout,
        follow=follow,
        mode=mode,
        threads=threads,
        cache=cache,
        public_key=public_key,
        name=name,
        adapt=labels is not None,
        state=state,
        mavlink=mavlink,
        metrics=metrics,
        view=view,
        bit_depth=bit_depth,
        placing=Placing(base, map, frame_id, child_frame_id, unknown_variance),
    )
    read = (source, bundle, public_key, camera, state, stamps)
    named = (*named_files(ground_truth), *named_files(labels))
    check_output(output, *read, *named, force=force)
    truth = None if ground_truth is None else open_ground_truth(ground_truth, source)
    labelled = None if labels is None else open_ground_truth(labels, source)
    with opened(wanted, truth=truth) as job:
        summary = job.summary
        known = [count for count in (job.frames.length, max_frames) if count is not None]
        total = min(known, default=None)
        watching = frames_progress(output != "-" and not quiet, summary, total)
        if preview:
            watching = frames_preview(summary, total, records_here=output == "-")
        try:
            with watching as tick:
                run_frames(
                    job.odometer,
                    job.frames,
                    job.write,
                    summary=summary,
                    labels=Labels(job.odometer, labelled, label_delay) if labelled else None,
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
