"""All measurements of ``make bench``, one after the other; nothing else may run meanwhile.

    python bench/all.py [--against CHECKOUT] [--again] [NAME ...]

A program whose result is of the present commit is left out, unless it is named or ``--again`` is
given: after an interruption the same command goes on. With another checkout, ``files`` and
``against`` measure it in turns with this one. Ends with a line for each program and the goals.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from goals import goals_table
from provenance import RESULTS, ROOT, commit


class Program(NamedTuple):
    """A program of this folder, its arguments, and its result."""

    name: str
    arguments: tuple[str, ...] = ()
    result: Path | None = None

    def measured(self, against: bool) -> bool:
        """Whether its result is of this commit, and of two checkouts where two are wanted."""
        if self.result is None or not self.result.exists():
            return False
        found = json.loads(self.result.read_text("utf-8"))
        if against and "before" not in found["settings"]:
            return False
        # The results of the other programs are no difference.
        return str(found["commit"]).removesuffix("+") == commit().removesuffix("+")

    def run(self) -> str:
        """Run it; return what became of it."""
        begin = perf_counter()
        command = [sys.executable, str(ROOT / "bench" / f"{self.name}.py"), *self.arguments]
        code = subprocess.run(command, check=False).returncode
        outcome = f"failed with exit code {code}" if code else "done"
        return f"{outcome}, {perf_counter() - begin:.0f} s"


def programs(against: Path | None) -> Sequence[Program]:
    """Return all programs, in the order in which they run."""
    speed, cost = RESULTS / "speed", RESULTS / "localiser" / "cost.json"
    other = () if against is None else (str(against),)
    compared = [Program("against", other, speed / "against.json")] if other else []
    return [
        Program("networks"),
        Program("files", ("--against", *other) if other else (), speed / "files.json"),
        *compared,
        Program("frame", (), speed / "frame.json"),
        Program("localiser_cost", ("--json", str(cost)), cost),
        Program("uncertainty_peers", (), speed / "uncertainty_peers.json"),
        Program("stages", (), speed / "stages.json"),
        Program("stream", (), speed / "stream.json"),
        Program("start", (), speed / "start.json"),
        Program("peers", (), speed / "peers.json"),
        Program("decoders", (), RESULTS / "decoders" / "times.json"),
        Program("four_cameras", (), RESULTS / "service" / "four_cameras.json"),
    ]


def main() -> int:
    """Run what is wanted and has not been measured -> the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="programs; default: all")
    parser.add_argument("--against", type=Path, help="another checkout of this repository")
    parser.add_argument("--again", action="store_true", help="also what has been measured")
    arguments = parser.parse_args()
    against = None if arguments.against is None else arguments.against.resolve()
    every = programs(against)
    if unknown := set(arguments.names) - {program.name for program in every}:
        names = ", ".join(program.name for program in every)
        raise SystemExit(f"expected some of {names}, found {', '.join(sorted(unknown))}")
    lines = []
    for program in every:
        if arguments.names and program.name not in arguments.names:
            continue
        both = against is not None and program.name in ("files", "against")
        if not (arguments.again or arguments.names) and program.measured(both):
            outcome = "measured at this commit"
        else:
            print(f"== {program.name}", flush=True)
            outcome = program.run()
        lines.append(f"{program.name:<18} {outcome}")
    print("", *lines, "", goals_table(), sep="\n")
    return int(any("failed" in line for line in lines))


if __name__ == "__main__":
    sys.exit(main())
