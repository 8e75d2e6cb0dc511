"""Run all kinds of fuzz tests, or the named ones: ``python -m fuzz [NAME[=TRIALS] ...]``.

Each kind writes a file to ``bench/results/faults``. At the end, prints a table of all existing
results. Exits with 1 if a trial had a finding.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable
from typing import Any

from bench.provenance import RESULTS, write_result
from fuzz import bundles, kills, media, sensors, simulation, states
from fuzz.trials import Tally

FAULTS = RESULTS / "faults"
# Name -> description, number of trials, and function.
KINDS: dict[str, tuple[str, int, Callable[[int], Tally]]] = {
    "models": ("model.onnx with changed bytes", 8000, bundles.models),
    "models_that_fit": (
        "model.onnx with changed bytes and matching digests, through verify",
        2000,
        bundles.models_that_fit,
    ),
    "calibrations": ("calibration.json with changed bytes or values", 8000, bundles.calibrations),
    "calibrations_that_fit": (
        "calibration.json with changed content and a matching digest, through verify",
        2000,
        bundles.calibrations_that_fit,
    ),
    "kills": ("run killed at a random time", 1000, kills.kills),
    "states": ("writer of a state file killed at a random time", 10000, states.states),
    "sensors": ("faulted frames of a camera among as many clean ones", 10000, sensors.sensors),
    "recordings": ("clean frames of real recordings", 1000, sensors.recordings),
    "images": ("image files with changed bytes among intact ones", 2000, media.images),
    "videos": ("a video with changed bytes", 500, media.videos),
    "coverage": ("calibration with 19, 20 and 100 scores", 1000, simulation.coverage),
}


def main() -> int:
    """Run the named kinds, or all, and return the exit code."""
    named = dict(word.partition("=")[::2] for word in sys.argv[1:])
    unknown = sorted(set(named) - set(KINDS))
    if unknown:
        known = ", ".join(KINDS)
        print(f"fuzz: expected names from {known}; found {', '.join(unknown)}", file=sys.stderr)
        return 2
    wrong = [word for word in named.values() if word and not re.fullmatch("[1-9][0-9]{0,8}", word)]
    if wrong:
        print(
            f"fuzz: expected positive numbers of trials, found {', '.join(wrong)}", file=sys.stderr
        )
        return 2
    found = 0
    for name in named or KINDS:
        what, count, trials = KINDS[name]
        count = int(named.get(name) or count)
        print(f"{name}: {what}", flush=True)
        begin = time.monotonic()
        tally = trials(count)
        if not tally.trials:
            print(f"  no trials: {', '.join(tally.outcomes)}")
            continue
        report(name, what, tally, time.monotonic() - begin)
        found += len(tally.findings)
    print(table())
    return 1 if found else 0


def report(name: str, what: str, tally: Tally, seconds: float) -> None:
    """Write one kind's result file and print its findings."""
    for finding in tally.findings[:20]:
        print(f"  {finding}", flush=True)
    content: dict[str, Any] = {
        "what": what,
        "seconds": round(seconds),
        "trials": tally.trials,
        "summary": tally.summary or ", ".join(f"{o}: {n}" for o, n in tally.outcomes.most_common()),
        "outcomes": dict(sorted(tally.outcomes.items())),
        "findings": tally.findings[:1000],
    }
    write_result(FAULTS / f"{name}.json", content)


def table() -> str:
    """Return a Markdown table of all existing results."""
    lines = ["| what | trials | findings | outcomes |", "| --- | --- | --- | --- |"]
    for name in KINDS:
        path = FAULTS / f"{name}.json"
        if path.exists():
            row = json.loads(path.read_text("utf-8"))
            cells = (row["what"], row["trials"], len(row["findings"]), row["summary"])
            lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
