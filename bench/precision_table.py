"""Print the table of ``results/int8``: float32 and 8 bits, medians over seeds, at 0.9.

python bench/precision_table.py
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parent / "results" / "int8"
COLUMNS: dict[str, Callable[[dict[str, Any]], float]] = {
    "MB": lambda row: row["model_bytes"] / 1e6,
    "error cm": lambda row: 100 * row["point_error"]["median_m"],
    "coverage": lambda row: row["mean_coverage"],
    "joint": lambda row: row["joint_coverage"],
    "width cm": lambda row: 100 * np.mean(row["mean_width"][:3]),
    "width deg": lambda row: np.rad2deg(np.mean(row["mean_width"][3:])),
    "score": lambda row: row["normalised_interval_score"],
}
DIGITS = {"coverage": 3, "joint": 3, "score": 3, "MB": 1}


def main() -> None:
    """Print one line for each data set, network, method and precision."""
    cells: dict[tuple[str, ...], list[dict[str, Any]]] = defaultdict(list)
    for path in sorted(RESULTS.glob("*.json")):
        found = json.loads(path.read_text("utf-8"))
        cells[found["dataset"], found["split"], found["backbone"], found["method"]].append(found)
    heads = ["data, split", "network", "method", "", *COLUMNS, "width int8 / fp32"]
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for (dataset, split, backbone, method), runs in cells.items():
        for precision in ("fp32", "int8"):
            figures = [
                f"{np.median([read(run[precision]) for run in runs]):.{DIGITS.get(name, 2)}f}"
                for name, read in COLUMNS.items()
            ]
            ratios = [run["width_ratio"] for run in runs]
            shown = f"{np.median(ratios):.3f}" if precision == "int8" else ""
            if precision == "int8" and len(ratios) > 1:
                shown += f" ({', '.join(f'{ratio:.3f}' for ratio in ratios)})"
            row = [f"{dataset}, {split}", backbone, method, precision, *figures, shown]
            print("| " + " | ".join(row) + " |")


if __name__ == "__main__":
    main()
