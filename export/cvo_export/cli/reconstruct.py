"""``cvo-export reconstruct``: poses for recordings that have none."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cvo_edge.programs.options import examples
from cvo_export.cli.app import DATA, app, resumable

SCALE = "Metric scale (one of)"


@app.command(
    epilog=examples(
        "cvo-export reconstruct walk-1.mp4 walk-2.mp4 scenes/hall --tag-size 0.16",
        "cvo-export reconstruct images/ scenes/hall --intrinsics 585,585,319.5,239.5",
    )
)
def reconstruct(
    recordings: Annotated[
        list[str],
        typer.Argument(help="Videos or folders of images of one place.", show_default=False),
    ],
    scene: Annotated[
        Path,
        typer.Argument(
            help="New folder, or the folder of an interrupted reconstruction.", show_default=False
        ),
    ],
    step: Annotated[
        float,
        typer.Option(
            help="Motion between the frames that are used, in image widths.", rich_help_panel=DATA
        ),
    ] = 0.04,
    frames: Annotated[
        int,
        typer.Option(
            min=2, help="Most frames that are used; the step grows to fit.", rich_help_panel=DATA
        ),
    ] = 300,
    intrinsics: Annotated[
        str | None,
        typer.Option(
            metavar="FX,FY,CX,CY[,K1,...]",
            help="Known camera in pixels, k1 k2 p1 p2 k3.. as in OpenCV; default: estimated.",
            rich_help_panel=DATA,
        ),
    ] = None,
    tag_size: Annotated[
        float | None,
        typer.Option(
            help="Edge of the black square of AprilTags 36h11 in view, metres.",
            rich_help_panel=SCALE,
        ),
    ] = None,
    distance: Annotated[
        tuple[str, str, float] | None,
        typer.Option(
            metavar="FRAME FRAME METRES",
            help="Distance of the camera between two frames VIDEO/frame-NNNNNN.",
            rich_help_panel=SCALE,
            show_default=False,
        ),
    ] = None,
    known_poses: Annotated[
        Path | None,
        typer.Option(
            help="Lines VIDEO/frame-NNNNNN tx ty tz qx qy qz qw of two or more frames.",
            rich_help_panel=SCALE,
        ),
    ] = None,
) -> None:
    """Find camera poses for videos without any; repeat the command to continue it.

    SCENE becomes a COLMAP data set with images, poses and points. The report
    says what can be trusted; it is also in SCENE/report.json.
    """
    from cvo_export.progress import show_progress
    from cvo_export.reconstruct.report import report_lines
    from cvo_export.reconstruct.run import Options
    from cvo_export.reconstruct.run import reconstruct as run

    options = Options(
        step=step,
        most=frames,
        intrinsics=intrinsics,
        tag_size_m=tag_size,
        distance=distance,
        known_poses=known_poses,
    )
    with resumable(), show_progress() as progress:
        report = run(recordings, scene, options, progress)
    print(*report_lines(report), sep="\n")
