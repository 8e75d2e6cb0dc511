"""All of it, or what is named: ``python -m fuzz [NAME[=TRIALS] ...]``.

Each kind writes its file into ``bench/results/faults``; a table of all that are there is printed at
the end, and into ``table.txt``. Exits with 1 where a trial found something.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cvo_edge.programs.measure import environment
from fuzz import bundles, kills, media, sensors, simulation
from fuzz.trials import Tally

RESULTS = Path(__file__).resolve().parent.parent / "bench" / "results" / "faults"
# Name -> what is tried, how often, and by what.
KINDS: dict[str, tuple[str, int, Callable[[int], Tally]]] = {
    "models": ("model.onnx with changed bytes", 8000, bundles.models),
    "models_that_fit": ("the same, digests recomputed, by verify", 2000, bundles.models_that_fit),
    "artifacts": ("calibration.json with changed bytes or values", 8000, bundles.artifacts),
    "artifacts_that_fit": (
        "the same, digest recomputed, by verify",
        2000,
        bundles.artifacts_that_fit,
    ),
    "kills": ("run killed at any time", 1000, kills.kills),
    "sensors": ("frames of a camera, faulted, among as many clean ones", 10000, sensors.sensors),
    "recordings": ("frames of real recordings, all clean", 1000, sensors.recordings),
    "images": ("image files with changed bytes, between good ones", 2000, media.images),
    "videos": ("a video with changed bytes", 500, media.videos),
    "coverage": ("calibration with 19, 20 and 100 scores", 1000, simulation.coverage),
}


def main() -> int:
    """Run what is named."""
    named = dict(word.partition("=")[::2] for word in sys.argv[1:])
    unknown = sorted(set(named) - set(KINDS))
    if unknown:
        print(f"fuzz: expected {', '.join(KINDS)}, found {', '.join(unknown)}", file=sys.stderr)
        return 2
    wrong = [word for word in named.values() if word and not re.fullmatch("[1-9][0-9]{0,8}", word)]
    if wrong:
        print(f"fuzz: expected numbers of trials, found {', '.join(wrong)}", file=sys.stderr)
        return 2
    found = 0
    for name in named or KINDS:
        what, count, trials = KINDS[name]
        count = int(named.get(name) or count)
        print(f"{name}: {what}", flush=True)
        begin = time.monotonic()
        tally = trials(count)
        if not tally.trials:
            print(f"  nothing to try: {', '.join(tally.outcomes)}")
            continue
        report(name, what, count, tally, time.monotonic() - begin)
        found += len(tally.findings)
    print(text := table())
    (RESULTS / "table.txt").write_text(text, "utf-8")
    return 1 if found else 0


def report(name: str, what: str, count: int, tally: Tally, seconds: float) -> None:
    """Write one kind's file, and its findings to the terminal."""
    for finding in tally.findings[:20]:
        print(f"  {finding}", flush=True)
    RESULTS.mkdir(parents=True, exist_ok=True)
    content: dict[str, Any] = {
        "command": f"python -m fuzz {name}={count}",
        "what": what,
        "date": datetime.now(UTC).date().isoformat(),
        "seconds": round(seconds),
        "environment": environment(),
        "trials": tally.trials,
        "summary": tally.summary or ", ".join(f"{o}: {n}" for o, n in tally.outcomes.most_common()),
        "outcomes": dict(sorted(tally.outcomes.items())),
        "findings": tally.findings[:1000],
    }
    (RESULTS / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n", "utf-8")


def table() -> str:
    """Return all results that are there as text."""
    lines = ["| what | trials | findings | outcomes |", "| --- | --- | --- | --- |"]
    for name in KINDS:
        path = RESULTS / f"{name}.json"
        if path.exists():
            row = json.loads(path.read_text("utf-8"))
            cells = (row["what"], row["trials"], len(row["findings"]), row["summary"])
            lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
