"""The command ``odometry``: arguments and output only."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import typer

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.files import check_output
from cvo_edge.process import say
from cvo_edge.programs.motion import ConfidenceOption, RuleOption, ScopeOption
from cvo_edge.programs.options import (
    INTERVALS,
    REPORT,
    FollowOption,
    ForceOption,
    MaxFramesOption,
    OutputOption,
    StampsOption,
    TimeoutOption,
    existing_file,
)
from cvo_edge.vocabulary import MotionRule, Scope

if TYPE_CHECKING:
    from cvo_edge.camera import Camera
    from cvo_edge.frontend.odometry import Lengths
    from cvo_edge.frontend.steps import Step
    from cvo_edge.motion.tracker import MotionTracker

# Poses of --scale count within this time.
_NEAR_NS = 20_000_000

StepFormat = Literal["jsonl", "tum"]


def odometry(
    source: Annotated[
        str,
        typer.Argument(
            help="Folder of images, glob, video file, - or a pipe, camera index or device, or "
            "stream address.",
            show_default=False,
        ),
    ],
    camera: Annotated[
        Path,
        typer.Option(
            "--camera",
            help="The camera: WIDTHxHEIGHT,FX,FY,CX,CY, or a JSON file with these fields and the "
            "distortion, or a sensor.yaml as EuRoC has it.",
            readable=False,
            show_default=False,
            rich_help_panel="Input",
        ),
    ],
    output: OutputOption = "-",
    format: Annotated[
        StepFormat | None,
        typer.Option(
            help="jsonl: a record for each step; tum: the steps added up. Default: by the file's "
            "suffix, else jsonl.",
            show_default=False,
            rich_help_panel=REPORT,
        ),
    ] = None,
    force: ForceOption = False,
    scale: Annotated[
        Path | None,
        typer.Option(
            help="Trajectory that the lengths of steps come from, such as wheel odometry: tum, "
            "euroc, openvins, or kitti with --fps.",
            readable=False,
            show_default=False,
            rich_help_panel="Input",
        ),
    ] = None,
    motion: Annotated[
        Path | None,
        typer.Option(
            help="motion.json of conformalize: adds intervals on rotation and direction.",
            readable=False,
            show_default=False,
            rich_help_panel=INTERVALS,
        ),
    ] = None,
    confidence: ConfidenceOption = 0.9,
    rule: RuleOption = "mean",
    scope: ScopeOption = "marginal",
    quiet: Annotated[
        bool, typer.Option("--quiet", help="No summary.", rich_help_panel=REPORT)
    ] = False,
    fps: Annotated[
        float | None,
        typer.Option(help="Stamp frames at this rate, from zero.", rich_help_panel="Input"),
    ] = None,
    stamps: StampsOption = None,
    max_frames: MaxFramesOption = None,
    follow: FollowOption = False,
    timeout: TimeoutOption = None,
) -> None:
    """Estimate rotation and direction of a camera's motion, frame by frame, without a network."""
    import cv2

    from cvo_edge.camera import checked_camera, read_camera
    from cvo_edge.frontend.odometry import FrontEnd
    from cvo_edge.input.capture import shown
    from cvo_edge.input.sources import open_source
    from cvo_edge.output.lines import LineFile

    # For so little work, threads cost more processor time than they save.
    cv2.setNumThreads(1)
    written_as = _format_of(output, format)
    check_output(output, source, camera, scale, stamps, motion, force=force)
    calibrated = checked_camera(read_camera(camera))
    tracker = _tracker(motion, written_as, scale, confidence, rule, scope)
    lengths = None if scale is None else _lengths(scale, fps)
    frames = open_source(source, fps, timeout, stamps, follow=follow)
    front = FrontEnd(calibrated, lengths)
    stamped = written_as == "tum" or scale is not None or tracker is not None
    first = _heading(calibrated, scale, written_as, tracker)
    seen: Counter[str] = Counter()
    existing = existing_file(False, force, written_as)
    with LineFile(output, existing, say) as lines, closing(front.stream(frames)) as steps:
        try:
            for step in islice(steps, max_frames):
                _check(step, source, calibrated, stamped=stamped)
                lines.write(first + _line(step, written_as, tracker))
                first = b""
                seen.update([step.status, *step.reasons])
        finally:
            if not quiet and seen:
                say(_summary(seen))
    if not seen["ok"]:
        raise SourceError(
            f"{shown(source)}: expected two images of one place or more, found no step with a "
            f"motion in {_frames(seen)} frames"
        )


def _format_of(output: str, format: StepFormat | None) -> StepFormat:
    from cvo_edge.output.sinks import format_of

    if format is None and Path(output).suffix.lower() == ".txt":
        return "tum"
    return format_of(output, format, get_args(StepFormat))


def _lengths(path: Path, fps: float | None) -> Lengths:
    """Return a trajectory as the distance between its poses at two stamps."""
    import numpy as np

    from cvo_edge.motion.files import read_poses
    from cvo_edge.trajectories.interpolation import Track

    poses = read_poses(path).stamped(None, fps)
    if poses.unscaled:
        raise UsageError(f"--scale: expected a trajectory in metres, found {path} without a scale")
    track = Track(poses.stamps_ns, poses.poses)
    usual_ns = float(np.median(np.diff(poses.stamps_ns))) if len(poses.stamps_ns) > 1 else 0.0
    bound_ns = round(max(_NEAR_NS, usual_ns))

    def length_m(begin_ns: int, end_ns: int) -> float | None:
        both, _ = track.poses_at(np.array([begin_ns, end_ns]), bound_ns)
        length = float(np.linalg.norm(both[1, :3] - both[0, :3]))
        return length if length == length else None

    return length_m


def _tracker(
    motion: Path | None,
    written_as: StepFormat,
    scale: Path | None,
    confidence: float,
    rule: MotionRule,
    scope: Scope,
) -> MotionTracker | None:
    """Return what gives intervals; raises UsageError if they do not suit the output."""
    if motion is None:
        return None
    if written_as != "jsonl":
        raise UsageError(f"--motion: expected the format jsonl, found {written_as}")
    from cvo_edge.frontend.records import COLUMNS
    from cvo_edge.motion.direction import check_same
    from cvo_edge.motion.tracker import MotionTracker

    tracker = MotionTracker(motion, confidence, rule, scope)
    check_same("odometry", scale is None, tracker.calibration.pointed)
    for name in tracker.calibration.file.columns:
        if name not in COLUMNS:
            raise UsageError(f"{motion}: expected columns of {', '.join(COLUMNS)}, found {name}")
    return tracker


def _heading(
    camera: Camera, scale: Path | None, written_as: StepFormat, tracker: MotionTracker | None
) -> bytes:
    from msgspec import UNSET

    from cvo_edge.frontend.records import json_heading, tum_heading
    from cvo_edge.motion.records import motion_header

    name = None if scale is None else scale.name
    if written_as == "tum":
        return tum_heading(camera, name)
    header = UNSET if tracker is None else motion_header(tracker.calibration, tracker.level)
    return json_heading(camera, name, header)


def _line(step: Step, written_as: StepFormat, tracker: MotionTracker | None) -> bytes:
    from cvo_edge.frontend.records import columns_of, json_line, record_of, tum_row, with_intervals

    if written_as == "tum":
        return tum_row(step)
    record = record_of(step)
    if tracker is not None and step.stamp_ns is not None:
        found = tracker.step(step.stamp_ns, step.pose, columns_of(step))
        record = with_intervals(record, found)
    return json_line(record)


def _check(step: Step, source: str, camera: Camera, *, stamped: bool) -> None:
    """Raise UsageError for a source of which no frame can be used: its size, or without stamps."""
    from cvo_edge.frontend.steps import StepReason
    from cvo_edge.input.capture import shown

    if step.stamp_ns is None and stamped:
        raise UsageError(
            f"{shown(source)}: expected a stamp for every frame, {step.source or 'a frame'} has "
            "none; give --fps or --stamps"
        )
    if step.seq == 0 and StepReason.IMAGE_SIZE in step.reasons and step.size is not None:
        found = "{1}x{0}".format(*step.size)
        raise UsageError(
            f"{shown(source)}: expected images of {camera.width}x{camera.height} pixels, the size "
            f"of the camera, found {found}; give the intrinsics of these images"
        )


def _frames(seen: Counter[str]) -> int:
    return seen["ok"] + seen["degraded"] + seen["invalid"]


def _summary(seen: Counter[str]) -> str:
    named = ("ok", "degraded", "invalid")
    counts = ", ".join(f"{seen[each]} {each}" for each in named)
    lines = [f"steps    {_frames(seen)}: {counts}"]
    if remarks := ", ".join(f"{key} {n}" for key, n in sorted(seen.items()) if key not in named):
        lines.append(f"remarks  {remarks}")
    return "\n".join(lines)
