"""The command line ``cvo-edge``: argument parsing and exit codes only."""

from __future__ import annotations

import glob
import json
import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from cvo_edge.errors import GateError, SinkError, SourceError, UsageError
from cvo_edge.files import write_text
from cvo_edge.process import guarded, say

if TYPE_CHECKING:
    from cvo_edge.engine.model_cache import ModelCache

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Pose intervals from camera images: a 6-DoF pose per frame and, for each degree of "
    "freedom, an interval that holds the truth with a stated probability.",
)


class ScopeName(StrEnum):
    """For each degree of freedom, or for all six at once."""

    MARGINAL = "marginal"
    JOINT = "joint"


class ModeName(StrEnum):
    """What a stream is to be good at."""

    LIVE = "live"
    LATENCY = "latency"
    THROUGHPUT = "throughput"


class FormatName(StrEnum):
    """Output formats."""

    JSONL = "jsonl"
    CSV = "csv"
    TUM = "tum"
    TABLE = "table"


# A thousand years of a camera; as many times as fit into memory.
MOST_FRAMES, MOST_MEASURED = 10**12, 10**7

# readable: what cannot be read has an exit code of ours.
BundleArgument = Annotated[
    Path,
    typer.Argument(
        help="Folder with model.onnx and calibration.json.", readable=False, show_default=False
    ),
]
ThreadsOption = Annotated[
    int | None, typer.Option(help="Cores to use; all allowed ones by default.")
]
CacheOption = Annotated[
    bool,
    typer.Option(
        "--cache/--no-cache", help="Keep the model as it is prepared for this machine, see cache."
    ),
]
PublicKeyOption = Annotated[
    Path | None,
    typer.Option(
        help="Ed25519 key (PEM): take a bundle only if it is signed with it.",
        readable=False,
        show_default=False,
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.command()
def run(
    bundle: BundleArgument,
    source: Annotated[
        str,
        typer.Argument(
            help="Folder of images, glob, video file, camera index or device, address of a stream.",
            show_default=False,
        ),
    ],
    output: Annotated[str, typer.Option("-o", "--output", help="File, or - for stdout.")] = "-",
    format: Annotated[
        FormatName | None,
        typer.Option(
            help="Output format; by default that of the file's suffix (.jsonl, .csv, .tum), "
            "else jsonl.",
            show_default=False,
        ),
    ] = None,
    confidence: Annotated[float, typer.Option(help="One of those stored in the bundle.")] = 0.9,
    scope: Annotated[
        ScopeName, typer.Option(help="Each degree of freedom, or all six at once.")
    ] = ScopeName.MARGINAL,
    mode: Annotated[
        ModeName | None,
        typer.Option(
            help="live: the newest frame, with little processor time; latency: one frame after the "
            "other, each as fast as can be; throughput: most frames a second. By default live for "
            "a camera, else latency.",
            show_default=False,
        ),
    ] = None,
    threads: ThreadsOption = None,
    max_frames: Annotated[
        int | None, typer.Option(min=1, max=MOST_FRAMES, help="Stop after so many.")
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Stamp frames at this rate from zero.")] = None,
    timeout: Annotated[
        float, typer.Option(help="Seconds to wait for the next frame of a camera or video.")
    ] = 5.0,
    ground_truth: Annotated[
        Path | None,
        typer.Option(
            help="TUM file or folder of .pose.txt; the summary then shows coverage.", readable=False
        ),
    ] = None,
    region: Annotated[
        bool,
        typer.Option("--region", help="mcqr, scope joint: the region's points in every record."),
    ] = False,
    cache: CacheOption = True,
    public_key: PublicKeyOption = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No summary on stderr.")] = False,
) -> None:
    """Estimate a pose interval for every frame of a source."""
    from cvo_edge.ground_truth import open_ground_truth
    from cvo_edge.input.capture import shown
    from cvo_edge.input.sources import open_source
    from cvo_edge.odometer import Odometer
    from cvo_edge.output.records import header_of
    from cvo_edge.output.sinks import Sink, format_of
    from cvo_edge.programs.run import RunSummary
    from cvo_edge.programs.run import run as run_frames

    written_as = format_of(output, format.value if format else None)
    _refuse_overwriting(output, source, ground_truth, bundle, public_key)
    truth = open_ground_truth(ground_truth) if ground_truth else None
    frames = open_source(source, fps, timeout)
    with Odometer.load(
        bundle,
        threads=threads,
        mode=mode or (ModeName.LIVE if frames.live else ModeName.LATENCY),
        confidence=confidence,
        scope=scope.value,
        cache=_model_cache(cache),
        public_key=public_key,
    ) as odometer:
        if region and not odometer.has_region:
            raise UsageError(
                f"region: expected a bundle of mcqr and the scope joint, found "
                f"{odometer.calibration.method} and {scope.value}"
            )
        summary = RunSummary(odometer.chart.dof, confidence, scope, with_truth=truth is not None)
        header = header_of(
            odometer.calibration,
            odometer.chart,
            confidence,
            scope.value,
            stamps="fps" if fps else "arrival" if frames.live else None,
        )
        with Sink(output, written_as, header, region=region) as sink:
            try:
                run_frames(
                    odometer,
                    frames,
                    sink.write,
                    summary=summary,
                    truth=truth,
                    max_frames=max_frames,
                )
            finally:
                if not quiet and summary.frames:
                    say("\n".join(summary.lines()))
    if summary.statuses["invalid"] == summary.frames:
        raise SourceError(
            f"{shown(source)}: expected at least one valid frame, found none in {summary.frames}"
        )


@app.command()
def bench(
    bundle: BundleArgument,
    source: Annotated[
        str | None, typer.Argument(help="As for run; a still 640x480 image by default.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=MOST_MEASURED, help="Frames that count.")] = 200,
    warmup: Annotated[
        int, typer.Option(min=0, max=MOST_MEASURED, help="Frames before those.")
    ] = 20,
    mode: Annotated[
        ModeName, typer.Option(help="As for run; live plays files at 30 frames a second.")
    ] = ModeName.LATENCY,
    threads: ThreadsOption = None,
    cache: CacheOption = True,
    json_file: Annotated[
        str | None, typer.Option("--json", help="Write the report as JSON to a file or -.")
    ] = None,
    max_p95_ms: Annotated[
        float | None, typer.Option(help="Exit 8 where the total's p95 is longer.")
    ] = None,
    max_rss_mib: Annotated[
        float | None, typer.Option(help="Exit 8 where peak memory is larger.")
    ] = None,
) -> None:
    """Measure latency, memory and processor time, beside the bare model call."""
    from cvo_edge.programs.bench import benchmark, benchmark_lines

    if json_file is not None:
        _refuse_overwriting(json_file, source, bundle)
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


@app.command()
def verify(
    bundle: BundleArgument,
    threads: ThreadsOption = None,
    public_key: PublicKeyOption = None,
    timeout: Annotated[
        float, typer.Option(help="Seconds that loading and self-test may take.")
    ] = 60.0,
) -> None:
    """Check every digest of a bundle, load it and run its self-test on this machine.

    Of the model as it is, and as the cache has it prepared, where it has; in a process of its own,
    with limits of time and memory.
    """
    from cvo_edge.programs.verify import verify_bundle

    verdict = verify_bundle(bundle, threads=threads, timeout_s=timeout, public_key=public_key)
    print(
        f"{verdict.name}: digests match, model loads, self-test passed "
        f"(largest difference {verdict.largest_difference:.2g}, tolerance {verdict.tolerance:g})"
    )


@app.command()
def inspect(bundle: BundleArgument, as_json: JsonOption = False) -> None:
    """Show what a bundle is: method, model, thresholds, where they come from."""
    import msgspec

    from cvo_edge.bundle.reading import read_calibration
    from cvo_edge.programs.inspect import inspect_lines

    calibration = read_calibration(bundle)
    if as_json:
        print(json.dumps(msgspec.to_builtins(calibration), indent=1))
    else:
        print(*inspect_lines(calibration), sep="\n")


@app.command()
def schema() -> None:
    """Print the JSON Schema of calibration.json."""
    from cvo_edge.programs.inspect import calibration_schema

    print(json.dumps(calibration_schema(), indent=1))


@app.command()
def doctor(as_json: JsonOption = False) -> None:
    """Show what this machine offers: processor, cores, versions, memory."""
    from cvo_edge.programs.inspect import doctor_lines
    from cvo_edge.programs.measure import environment, memory_mib

    report = {**environment(), "memory_mib": memory_mib()}
    if as_json:
        print(json.dumps(report, indent=1))
    else:
        print(*doctor_lines(report), sep="\n")


@app.command()
def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all of them.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List the models that were prepared for this machine (in $CVO_EDGE_CACHE, or ~/.cache)."""
    import msgspec

    from cvo_edge.engine.model_cache import ModelCache
    from cvo_edge.programs.inspect import cache_lines

    found = ModelCache.default()
    if clear:
        obstacle = found.obstacle()
        if obstacle is not None:
            raise SinkError(f"{found.folder}: {obstacle}")
        removed = found.clear()
        report = {"folder": str(found.folder), "removed": removed}
        print(json.dumps(report) if as_json else f"{found.folder}: {removed} removed")
        return
    if as_json:
        entries = [msgspec.to_builtins(entry) for entry in found.entries()]
        print(json.dumps({"folder": str(found.folder), "models": entries}, indent=1))
    else:
        print(*cache_lines(found), sep="\n")


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


def _refuse_overwriting(output: str, *inputs: str | Path | None) -> None:
    """Raise UsageError where the output is one of the inputs, or lies in one or behind its glob."""
    written = Path(output)
    if output == "-" or not os.path.exists(written):  # noqa: PTH110 - also of a name too long
        return
    for given in inputs:
        if given is None:
            continue
        name = str(given)
        files = [name, *glob.iglob(name, recursive=True), *glob.iglob(f"{glob.escape(name)}/*")]
        if any(os.path.exists(file) and written.samefile(file) for file in files):  # noqa: PTH110
            raise UsageError(f"output: expected a file of its own, found {output} among the input")


def main() -> NoReturn:
    """Run ``cvo-edge``."""
    guarded("cvo-edge", app)
