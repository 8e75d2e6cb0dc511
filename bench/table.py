"""The README's table from bench/results/*.json: the median of the seeds, and each seed.

python bench/table.py redkitchen kitchen_flights [--runs mcqr,mcqr-passes]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parent / "results"
METHODS = "cjp,cqr,csp,mcqr"
HEADER = (
    "| recording, split | method | median error | score | coverage at 0.9, per DoF "
    "| joint scope: all six | its volume^(1/6) | median width |\n" + "|---" * 8 + "|"
)


def level(report: dict[str, Any], scope: str) -> dict[str, Any]:
    """Return the report's level at 0.9 of this scope."""
    return next(
        entry
        for entry in report["levels"]
        if entry["confidence"] == 0.9 and entry["scope"] == scope
    )


def cell(values: list[float], form: str) -> str:
    """Return the median in bold, then every seed's value."""
    each = ", ".join(form.format(value) for value in values)
    return f"**{form.format(float(np.median(values)))}** ({each})"


def row(recording: str, name: str, reports: list[dict[str, Any]]) -> str:
    """Return a line of the table."""
    marginal = [level(report, "marginal") for report in reports]
    joint = [level(report, "joint") for report in reports]
    widths = np.array([entry["median_width"] for entry in marginal])
    cells = [
        f"{recording}, {reports[0]['split']}",
        name,
        cell([100 * report["point_error"]["median_m"] for report in reports], "{:.2f}")
        + " cm, "
        + cell([report["point_error"]["median_deg"] for report in reports], "{:.2f}")
        + " deg",
        cell([entry["normalised_interval_score"] for entry in marginal], "{:.3f}"),
        cell([float(np.mean(entry["coverage"])) for entry in marginal], "{:.3f}")
        + f"; single DoF {min(min(entry['coverage']) for entry in marginal):.3f} to "
        f"{max(max(entry['coverage']) for entry in marginal):.3f}",
        cell([entry["joint_coverage"] for entry in joint], "{:.3f}"),
        cell([entry["joint_volume"]["geometric_mean"] ** (1 / 6) for entry in joint], "{:.3f}")
        if all("joint_volume" in entry for entry in joint)
        else "-",
        f"{100 * np.median(widths[:, :3]):.1f} cm, {np.rad2deg(np.median(widths[:, 3:])):.2f} deg",
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the table of the recordings named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--runs", default=METHODS, help="methods or names of variants, with commas")
    arguments = parser.parse_args()
    print(HEADER)
    for recording in arguments.recordings:
        for name in arguments.runs.split(","):
            paths = sorted(RESULTS.glob(f"{name}-{recording}-[0-9].json"))
            if paths:
                print(row(recording, name, [json.loads(p.read_text("utf-8")) for p in paths]))


if __name__ == "__main__":
    main()
