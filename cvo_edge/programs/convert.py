"""The command ``convert``: arguments and output only."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cvo_edge.errors import UsageError
from cvo_edge.files import check_output
from cvo_edge.process import say
from cvo_edge.programs.options import (
    BaseOption,
    ChildFrameIdOption,
    ForceOption,
    FrameIdOption,
    MapOption,
    UnknownVarianceOption,
)
from cvo_edge.vocabulary import Format


def convert(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDS",
            help="JSON lines of run or annotate; with --recover, an MCAP file.",
            readable=False,
            show_default=False,
        ),
    ],
    output: Annotated[
        str | None,
        typer.Option(
            "-o",
            "--output",
            help="File to write: .mcap, .rrd, .csv, .tum or .jsonl; default: RECORDS with the "
            "suffix of the format.",
            show_default=False,
        ),
    ] = None,
    format: Annotated[
        Format | None,
        typer.Option(
            "--to", "--format", help="Format; default: by the file's suffix.", show_default=False
        ),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the frames: add their images (mcap, rrd).",
            readable=False,
            show_default=False,
        ),
    ] = None,
    recover: Annotated[
        bool,
        typer.Option("--recover", help="Finish an MCAP file whose writer was killed."),
    ] = False,
    force: ForceOption = False,
    base: BaseOption = None,
    map: MapOption = None,
    frame_id: FrameIdOption = None,
    child_frame_id: ChildFrameIdOption = None,
    unknown_variance: UnknownVarianceOption = None,
) -> None:
    """Write records as a file of another program: ROS 2 messages (MCAP), rerun, CSV, TUM."""
    from cvo_edge.output.sinks import format_of
    from cvo_edge.programs import conversion
    from cvo_edge.programs.placing import Placing

    if output is None:
        if recover:
            raise UsageError("--recover: expected -o FILE.mcap, found no output")
        if format is None or format == "table":
            raise UsageError("convert: expected -o FILE or --to with csv, tum, mcap or rrd")
        output = str(source.with_suffix(f".{format}"))
    check_output(output, source, force=force)
    written_as: Format = format_of(output, format)
    placing = Placing(base, map, frame_id, child_frame_id, unknown_variance)
    if recover:
        if written_as != "mcap" or images is not None or placing.stated:
            raise UsageError(
                "--recover: expected RECORDS.mcap and -o FILE.mcap without other options"
            )
        say(conversion.recovered(source, output))
        return
    count = conversion.convert(source, output, written_as, images, placing)
    if output != "-":
        say(f"{count} records -> {output}")
