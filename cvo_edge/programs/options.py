"""What several commands share: arguments and options, their panels, and examples for help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

INTERVALS, RUNTIME, REPORT = "Intervals", "Runtime", "Output"


def examples(*commands: str) -> str:
    """Return the epilog that lists commands, one per line."""
    return "\n\n".join(["Examples:", *commands])


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
CameraOption = Annotated[
    Path | None,
    typer.Option(
        "--camera",
        help="Another camera: WIDTHxHEIGHT,FX,FY,CX,CY, or a JSON file with these fields.",
        readable=False,
        show_default=False,
        rich_help_panel="Input",
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
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
