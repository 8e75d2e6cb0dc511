"""What several commands share: arguments and options, their panels, and examples for help."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cvo_edge.errors import UsageError
from cvo_edge.vocabulary import Existing, Format, Mode, Scope

if TYPE_CHECKING:
    from cvo_edge.engine.model_cache import ModelCache

INTERVALS, RUNTIME, REPORT = "Intervals", "Runtime", "Output"
ADAPTATION = "Adaptation"
FRAMES = "Frames of messages"
_POSE = "<tx,ty,tz,qx,qy,qz,qw>"
# A thousand years of a camera.
MOST_FRAMES = 10**12
# An odometer keeps 1,024 frames for their labels.
MOST_DELAY = 1023


def examples(*commands: str) -> str:
    """Return the epilog that lists commands, one per line."""
    return "\n\n".join(["Examples:", *commands])


def existing_file(append: bool, force: bool, format: str) -> Existing:
    """Return what happens to an output that exists; raises UsageError for a contradiction."""
    if append and force:
        raise UsageError("--append: expected it without --force, found both")
    if append and format in ("csv", "mcap", "rrd", "table"):
        raise UsageError(f"--append: expected the format jsonl or tum, found {format}")
    return "append" if append else "force" if force else "replace"


def model_cache(wanted: bool) -> ModelCache | None:
    """Return the user's cache of models, imported only where it is wanted."""
    if not wanted:
        return None
    from cvo_edge.engine.model_cache import ModelCache

    return ModelCache.default()


# readable: a file that cannot be read has an exit code of ours.
BundleArgument = Annotated[
    Path,
    typer.Argument(
        help="Folder with model.onnx and calibration.json.", readable=False, show_default=False
    ),
]
ThreadsOption = Annotated[
    int | None,
    typer.Option(help="Cores to use; default: all allowed.", rich_help_panel=RUNTIME),
]
CacheOption = Annotated[
    bool,
    typer.Option(
        "--cache/--no-cache",
        help="Keep an optimised copy of the model for later starts; see the command cache.",
        rich_help_panel=RUNTIME,
    ),
]
PublicKeyOption = Annotated[
    Path | None,
    typer.Option(
        help="Accept only a bundle signed with this Ed25519 key (PEM).",
        readable=False,
        show_default=False,
        rich_help_panel=RUNTIME,
    ),
]
NameOption = Annotated[
    str | None,
    typer.Option(
        "--name",
        help="With --public-key: the bundle's name; default: that of the first bundle that this "
        "device has run from the folder.",
        show_default=False,
        rich_help_panel=RUNTIME,
    ),
]
CameraOption = Annotated[
    Path | None,
    typer.Option(
        "--camera",
        help="Another camera: WIDTHxHEIGHT,FX,FY,CX,CY, a JSON file with these fields, or a "
        "sensor.yaml as EuRoC has it.",
        readable=False,
        show_default=False,
        rich_help_panel="Input",
    ),
]
StampsOption = Annotated[
    str | None,
    typer.Option(
        "--stamps",
        metavar="<names|FILE>",
        help="Where the stamps are: in the names of images, or in a list such as rgb.txt, data.csv "
        "or times.txt; for a video, a time a line or lines timestamp frame.",
        show_default=False,
        rich_help_panel="Input",
    ),
]
BitDepthOption = Annotated[
    int,
    typer.Option(
        "--bit-depth",
        min=9,
        max=16,
        help="Bits that the camera fills in image files of 16 bits, e.g. 12.",
        rich_help_panel="Input",
    ),
]
ExpectMotionOption = Annotated[
    bool,
    typer.Option(
        "--expect-motion",
        help="The camera always moves: a picture that stands still is a doubt.",
        rich_help_panel="Input",
    ),
]
OutputOption = Annotated[
    str,
    typer.Option("-o", "--output", help="File, or - for stdout.", rich_help_panel=REPORT),
]
FormatOption = Annotated[
    Format | None,
    typer.Option(
        help="Format of the records; default: by the file's suffix (.jsonl, .csv, .tum, .mcap, "
        ".rrd), else jsonl.",
        show_default=False,
        rich_help_panel=REPORT,
    ),
]
AppendOption = Annotated[
    bool,
    typer.Option(
        "--append",
        help="Keep the records of an existing file, and add to them.",
        rich_help_panel=REPORT,
    ),
]
ForceOption = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Replace an existing file that cvo-edge did not write.",
        rich_help_panel=REPORT,
    ),
]
ModeOption = Annotated[
    Mode | None,
    typer.Option(
        metavar="<mode>",
        help="live: newest frame, least processor time; latency: every frame, each as fast as "
        "possible; throughput: most frames per second. Default: live for a camera, throughput for "
        "a recording, latency for one that has no end yet, comes with labels or is one image.",
        show_default=False,
        rich_help_panel=RUNTIME,
    ),
]
RegionOption = Annotated[
    bool,
    typer.Option(
        "--region",
        help="Write the region into every record (mcqr, scr, fused; joint scope).",
        rich_help_panel=REPORT,
    ),
]
MaxFramesOption = Annotated[
    int | None,
    typer.Option(
        "--max-frames",
        min=1,
        max=MOST_FRAMES,
        help="Stop after this many frames.",
        rich_help_panel="Input",
    ),
]
TimeoutOption = Annotated[
    float | None,
    typer.Option(
        "--timeout",
        help="Seconds to wait for the next frame of a camera or video; default: 5. With --follow: "
        "end after so long without a new image; default: never.",
        show_default=False,
        rich_help_panel="Input",
    ),
]
FollowOption = Annotated[
    bool,
    typer.Option(
        "--follow",
        help="Wait for new images in the folder, until --timeout or a signal.",
        rich_help_panel="Input",
    ),
]
GroundTruthOption = Annotated[
    str | None,
    typer.Option(
        metavar="<PATH>",
        help="True poses in any format that training reads (7-Scenes, TUM, EuRoC, KITTI, COLMAP, "
        "ROS bags...); adds coverage to the summary. A bag may have options: "
        "rosbag:PATH,pose=TOPIC.",
        rich_help_panel=REPORT,
    ),
]
LabelsOption = Annotated[
    str | None,
    typer.Option(
        "--labels",
        metavar="<PATH>",
        help="True poses of some frames, as for --ground-truth; the intervals adapt to them.",
        show_default=False,
        rich_help_panel=ADAPTATION,
    ),
]
LabelDelayOption = Annotated[
    int,
    typer.Option(
        "--label-delay",
        min=0,
        max=MOST_DELAY,
        help="Frames from a frame to its label.",
        rich_help_panel=ADAPTATION,
    ),
]
StateOption = Annotated[
    Path | None,
    typer.Option(
        "--state",
        help="File that keeps what was adapted for the next run.",
        readable=False,
        show_default=False,
        rich_help_panel=ADAPTATION,
    ),
]
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
BaseOption = Annotated[
    str | None,
    typer.Option(
        "--base",
        metavar=_POSE,
        help="Pose of the robot's base in the camera (x right, y down, z forward): messages give "
        "the base's pose.",
        show_default=False,
        rich_help_panel=FRAMES,
    ),
]
MapOption = Annotated[
    str | None,
    typer.Option(
        "--map",
        metavar=_POSE,
        help="Pose of the bundle's world in the map: messages give poses in the map.",
        show_default=False,
        rich_help_panel=FRAMES,
    ),
]
FrameIdOption = Annotated[
    str | None,
    typer.Option(
        help="Name of the frame that poses are in; default: the bundle's, or map with --map.",
        show_default=False,
        rich_help_panel=FRAMES,
    ),
]
ChildFrameIdOption = Annotated[
    str | None,
    typer.Option(
        help="Name of the frame whose pose is given; default: the bundle's, or base_link with "
        "--base.",
        show_default=False,
        rich_help_panel=FRAMES,
    ),
]
UnknownVarianceOption = Annotated[
    float | None,
    typer.Option(
        help="Also give poses without bounds, with this variance (m^2, rad^2; 1 to 1e12). Default: "
        "no pose.",
        show_default=False,
        rich_help_panel=FRAMES,
    ),
]
SourceArgument = Annotated[
    str,
    typer.Argument(
        help="Folder of images, glob, video file, - or a pipe, camera index or device, or stream "
        "address.",
        show_default=False,
    ),
]
RunConfidenceOption = Annotated[
    float,
    typer.Option(
        help="One stored in the bundle, or any if it holds quantiles; see inspect.",
        rich_help_panel=INTERVALS,
    ),
]
RunScopeOption = Annotated[
    Scope,
    typer.Option(
        help="Whether it holds for each degree of freedom or for all six at once.",
        rich_help_panel=INTERVALS,
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
JsonFileOption = Annotated[
    str | None,
    typer.Option("--json", help="Write the report as JSON to a file or -.", rich_help_panel=REPORT),
]
