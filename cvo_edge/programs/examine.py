"""The commands that examine a bundle or this machine: arguments and output only."""

from __future__ import annotations

import json
from typing import Annotated, Literal

import typer

from cvo_edge.errors import SinkError
from cvo_edge.programs.options import (
    BundleArgument,
    JsonOption,
    NameOption,
    PublicKeyOption,
    ThreadsOption,
)


def verify(
    bundle: BundleArgument,
    threads: ThreadsOption = None,
    public_key: PublicKeyOption = None,
    name: NameOption = None,
    timeout: Annotated[
        float, typer.Option(help="Seconds allowed for loading and self-test.")
    ] = 60.0,
) -> None:
    """Check every digest of a bundle, load it and run its self-test on this machine.

    The self-test runs on the model and on its cached copy, if there is one,
    in a separate process with limits of time and memory.
    """
    from cvo_edge.programs.verify import verify_bundle

    verdict = verify_bundle(
        bundle, threads=threads, timeout_s=timeout, public_key=public_key, name=name
    )
    print(verdict.line())


def inspect(bundle: BundleArgument, as_json: JsonOption = False) -> None:
    """Show a bundle: method, model, thresholds and the calibration behind them."""
    import msgspec

    from cvo_edge.bundle.reading import read_calibration
    from cvo_edge.programs.inspect import inspect_lines

    calibration = read_calibration(bundle)
    if as_json:
        print(json.dumps(msgspec.to_builtins(calibration), indent=1))
    else:
        print(*inspect_lines(calibration), sep="\n")


def schema(
    file: Annotated[
        Literal["calibration", "motion"],
        typer.Argument(help="calibration.json or motion.json."),
    ] = "calibration",
) -> None:
    """Print the JSON Schema of calibration.json or motion.json."""
    from cvo_edge.programs.inspect import calibration_schema, motion_schema

    print(json.dumps(calibration_schema() if file == "calibration" else motion_schema(), indent=1))


def doctor(as_json: JsonOption = False) -> None:
    """Show processor, cores, memory and versions of this machine."""
    from cvo_edge.programs.inspect import doctor_lines
    from cvo_edge.programs.measure import environment, memory_mib

    report = {**environment(), "memory_mib": memory_mib()}
    if as_json:
        print(json.dumps(report, indent=1))
    else:
        print(*doctor_lines(report), sep="\n")


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all copies.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List the optimised models of this machine (in $CVO_EDGE_CACHE or ~/.cache)."""
    import msgspec

    from cvo_edge.engine.model_cache import ModelCache
    from cvo_edge.programs.inspect import cache_lines

    found = ModelCache.default()
    if clear:
        obstacle = found.obstacle(writing=True)
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
