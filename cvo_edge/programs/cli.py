"""The command line ``cvo-edge``: argument parsing and exit codes only."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from cvo_edge.errors import GateError, UsageError
from cvo_edge.files import check_output, write_report
from cvo_edge.process import guarded
from cvo_edge.programs.convert import (
    convert,
)
from cvo_edge.programs.examine import cache, doctor, inspect, schema, verify
from cvo_edge.programs.motion import annotate, audit, conformalize
from cvo_edge.programs.odometry import odometry
from cvo_edge.programs.options import (
    BundleArgument,
    CacheOption,
    ForceOption,
    JsonFileOption,
    JsonOption,
    ThreadsOption,
    examples,
    model_cache,
)
from cvo_edge.programs.running import run
from cvo_edge.programs.serve import serve
from cvo_edge.vocabulary import Mode

app = typer.Typer(
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Pose intervals from camera images: a 6-DoF pose per frame and, for each degree of "
    "freedom, an interval that holds the truth with a stated probability.",
)

# As many times as fit into memory.
MOST_MEASURED = 10**7


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
    force: ForceOption = False,
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
        check_output(json_file, source, bundle, force=force)
    report = benchmark(
        bundle,
        source,
        frames=frames,
        warmup=warmup,
        mode=mode,
        threads=threads,
        cache=model_cache(cache),
    )
    if json_file is not None:
        write_report(json_file, report)
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
