"""The command ``bench``: arguments and output only."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from cvo_edge.errors import GateError, UsageError
from cvo_edge.files import check_output, write_report, write_text
from cvo_edge.process import say
from cvo_edge.programs.options import (
    REPORT,
    BundleArgument,
    CacheOption,
    ForceOption,
    JsonFileOption,
    ThreadsOption,
    model_cache,
)
from cvo_edge.vocabulary import Mode

# As many times as fit into memory.
MOST_MEASURED = 10**7
_GATES, _COMPARISONS = "Gates", "Comparisons"


def bench(
    bundle: BundleArgument,
    source: Annotated[
        str | None, typer.Argument(help="As for run; default: a fixed image, 640 pixels wide.")
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST_MEASURED,
            help="Frames to measure; default: 200, beside the script the whole source.",
            show_default=False,
        ),
    ] = None,
    warmup: Annotated[
        int, typer.Option(min=0, max=MOST_MEASURED, help="Frames to run before measuring.")
    ] = 20,
    mode: Annotated[
        Mode, typer.Option(help="As for run; live plays files at 30 frames per second.")
    ] = "latency",
    threads: ThreadsOption = None,
    cache: CacheOption = True,
    stages: Annotated[
        bool,
        typer.Option(
            "--stages", help="Also show where the time of a frame goes.", rich_help_panel=REPORT
        ),
    ] = False,
    against_script: Annotated[
        bool,
        typer.Option(
            "--against-script",
            help="Also time run beside a script of ten lines on the files of SOURCE.",
            rich_help_panel=_COMPARISONS,
        ),
    ] = False,
    compare: Annotated[
        Path | None,
        typer.Option(
            help="Compare with an earlier file of --json; exit 8 for a regression, 5 if bundle, "
            "mode, source or machine differ.",
            readable=False,
            show_default=False,
            rich_help_panel=_COMPARISONS,
        ),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="Growth that is no regression: of ratios and memory; of times, twice as much. "
            "Default: 0.15.",
            show_default=False,
            rich_help_panel=_COMPARISONS,
        ),
    ] = None,
    json_file: JsonFileOption = None,
    report: Annotated[
        Path | None,
        typer.Option(
            help="Write the report as a page, with --stages, to a file.html.",
            readable=False,
            show_default=False,
            rich_help_panel=REPORT,
        ),
    ] = None,
    force: ForceOption = False,
    max_p95_ms: Annotated[
        float | None,
        typer.Option(help="Exit 8 if the total's p95 is longer.", rich_help_panel=_GATES),
    ] = None,
    max_rss_mib: Annotated[
        float | None,
        typer.Option(help="Exit 8 if peak memory is larger.", rich_help_panel=_GATES),
    ] = None,
) -> None:
    """Measure latency, memory and processor time next to the bare model call."""
    from cvo_edge.programs import bench_page, regressions, script
    from cvo_edge.programs.bench import benchmark
    from cvo_edge.programs.bench_report import benchmark_lines
    from cvo_edge.programs.stages import stage_lines

    if tolerance is not None and compare is None:
        raise UsageError("--tolerance: expected --compare FILE with it, found none")
    allowed = regressions.checked_tolerance(
        regressions.TOLERANCE if tolerance is None else tolerance
    )
    inputs = source, bundle, compare
    if json_file is not None:
        check_output(json_file, *inputs, force=force)
    if report is not None:
        check_output(bench_page.checked_page(report), *inputs, json_file, force=force)
    files = script.check_read_again(source) if against_script else ""
    earlier = None if compare is None else regressions.read_report(compare)
    models = model_cache(cache)
    stages = stages or report is not None
    found = benchmark(
        bundle,
        source,
        frames=frames or 200,
        warmup=warmup,
        mode=mode,
        threads=threads,
        cache=models,
        stages=stages,
    )
    lines = benchmark_lines(found)
    if stages:
        lines += stage_lines(found["stages"], mode)
    if against_script:
        say(script.announcement(files, frames, found["throughput_fps"]))
        turns = script.against_script(bundle, files, frames=frames, threads=threads, cache=models)
        found["against_script"] = turns
        lines += script.script_lines(turns)
    comparison = None
    if earlier is not None:
        comparison = regressions.compared(str(compare), earlier, found, allowed)
        found["comparison"] = comparison.as_report()
        lines += regressions.comparison_lines(comparison)
    if json_file is not None:
        write_report(json_file, found)
    if report is not None:
        write_text(str(report), bench_page.page(found))
    if json_file != "-":
        print(*lines, sep="\n")
    _check_limits(found, max_p95_ms, max_rss_mib)
    if comparison is not None:
        regressions.check(comparison)


def _check_limits(
    found: dict[str, Any], max_p95_ms: float | None, max_rss_mib: float | None
) -> None:
    """Raise GateError for a limit that is missed; written so that NaN is."""
    p95, rss = found["latency_ms"]["total"]["p95"], found["memory_mib"]["peak_rss"]
    if max_p95_ms is not None and not p95 <= max_p95_ms:
        raise GateError(f"bench: expected p95 of at most {max_p95_ms:g} ms, found {p95:.3f} ms")
    if max_rss_mib is not None and not rss <= max_rss_mib:
        raise GateError(f"bench: expected peak memory of at most {max_rss_mib:g} MiB, found {rss}")
