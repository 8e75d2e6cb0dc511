"""The command line ``cvo-edge``: argument parsing and exit codes only."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from cvo_edge.errors import GateError, UsageError
from cvo_edge.files import check_output
from cvo_edge.process import guarded
from cvo_edge.programs.benching import bench
from cvo_edge.programs.convert import convert
from cvo_edge.programs.examine import cache, doctor, inspect, schema, verify
from cvo_edge.programs.motion import annotate, audit, conformalize
from cvo_edge.programs.odometry import odometry
from cvo_edge.programs.options import (
    BundleArgument,
    ForceOption,
    JsonOption,
    examples,
)
from cvo_edge.programs.running import run
from cvo_edge.programs.serve import serve

app = typer.Typer(
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Pose intervals from camera images: a 6-DoF pose per frame and, for each degree of "
    "freedom, an interval that holds the truth with a stated probability.",
)


@app.command(
    "demo", epilog=examples("cvo-edge demo", "cvo-edge demo my-bundle --picture my-bundle.png")
)
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
    force: ForceOption = False,
) -> None:
    """Run a bundle on the packaged clip, compare it with the ground truth and draw a picture."""
    from cvo_edge.programs.demo import BUNDLE, demo

    check_output(picture, force=force)
    demo(bundle or BUNDLE, picture)


app.command(
    epilog=examples(
        "cvo-edge run my-bundle recordings/flight-07 -o flight-07.jsonl",
        "cvo-edge run my-bundle /dev/video0 --scope joint --format table",
        "cvo-edge run my-bundle images/ --ground-truth images/ -o out.jsonl",
    )
)(run)
app.command(
    epilog=examples(
        "cvo-edge serve my-bundle /dev/video0 -o /var/lib/cvo-edge/records.jsonl",
        "cvo-edge serve my-bundle rtsp://10.0.0.7/stream -o records.jsonl --metrics 9100",
    )
)(serve)


app.command(
    epilog=examples(
        "cvo-edge bench my-bundle",
        "cvo-edge bench my-bundle flight.mp4 --mode throughput --json bench.json",
        "cvo-edge bench my-bundle images/ --stages --against-script",
        "cvo-edge bench my-bundle images/ --compare bench.json --report bench.html",
    )
)(bench)


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


_SHOWN: dict[Callable[..., None], tuple[str, ...]] = {
    convert: (
        "cvo-edge convert flight.jsonl -o flight.mcap --images recordings/flight-07",
        "cvo-edge convert flight.jsonl --to rrd",
    ),
    odometry: (
        "cvo-edge odometry drive.mp4 --camera camera.json -o steps.jsonl",
        "cvo-edge odometry images/ --camera sensor.yaml --scale wheels.tum",
    ),
    conformalize: (
        "cvo-edge conformalize a-est.tum a-gt.tum b-est.tum b-gt.tum -o motion.json",
        "cvo-edge conformalize --pairs drives.txt -o motion.json",
    ),
    annotate: (
        "cvo-edge annotate estimate.tum motion.json -o intervals.jsonl",
        "my-estimator | cvo-edge annotate - motion.json",
    ),
    audit: ("cvo-edge audit --pairs held-out.txt motion.json --picture audit.png",),
    verify: ("cvo-edge verify my-bundle", "cvo-edge verify my-bundle --public-key key.pem"),
    inspect: ("cvo-edge inspect my-bundle", "cvo-edge inspect my-bundle --json"),
    schema: ("cvo-edge schema > calibration.schema.json",),
    doctor: ("cvo-edge doctor",),
    cache: ("cvo-edge cache", "cvo-edge cache --clear"),
}
for command, shown in _SHOWN.items():
    app.command(epilog=examples(*shown))(command)


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
