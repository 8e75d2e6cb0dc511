"""The README's table from bench/results/*.json: the median of the seeds, and each seed.

python bench/table.py redkitchen kitchen_flights
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parent / "results"
METHODS = ("cjp", "cqr", "csp", "mcqr")
HEADER = (
    "| recording, split | method | median error | score | coverage at 0.9, per DoF "
    "| joint scope: all six | median width |\n|---|---|---|---|---|---|---|"
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


def row(recording: str, method: str, reports: list[dict[str, Any]]) -> str:
    """Return a line of the table."""
    marginal = [level(report, "marginal") for report in reports]
    joint = [level(report, "joint") for report in reports]
    widths = np.array([entry["median_width"] for entry in marginal])
    cells = [
        f"{recording}, {reports[0]['split']}",
        method,
        cell([100 * report["point_error"]["median_m"] for report in reports], "{:.2f}")
        + " cm, "
        + cell([report["point_error"]["median_deg"] for report in reports], "{:.2f}")
        + " deg",
        cell([entry["normalised_interval_score"] for entry in marginal], "{:.3f}"),
        cell([float(np.mean(entry["coverage"])) for entry in marginal], "{:.3f}")
        + f"; single DoF {min(min(entry['coverage']) for entry in marginal):.3f} to "
        f"{max(max(entry['coverage']) for entry in marginal):.3f}",
        cell([entry["joint_coverage"] for entry in joint], "{:.3f}"),
        f"{100 * np.median(widths[:, :3]):.1f} cm, {np.rad2deg(np.median(widths[:, 3:])):.2f} deg",
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the table of the recordings named on the command line."""
    print(HEADER)
    for recording in sys.argv[1:]:
        for method in METHODS:
            paths = sorted(RESULTS.glob(f"{method}-{recording}-[0-9].json"))
            if paths:
                print(row(recording, method, [json.loads(p.read_text("utf-8")) for p in paths]))


if __name__ == "__main__":
    main()
