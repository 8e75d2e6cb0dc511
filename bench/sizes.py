"""The size of the network's input: regression methods on real recordings.

    python bench/sizes.py WORK [--only WORD ...] [--json FILE]

Trains, publishes in both precisions (rule pooled) and evaluates every cell that WORK lacks: flights
and walk with the default budget, drone and car with a small one. ``bench/pareto.py`` searches among
more networks with a small part of this budget.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pareto
from precision import PRECISIONS, figures
from provenance import write_result

from cvo_export.publish import publish
from cvo_export.training.run import load_run

SCORE = "normalised_interval_score"
SIZES = ("256x192", "192x144", "160x120")
# Recordings, their split, and options of ``train`` for short ones.
DATA = {name: (*which, "") for name, which in pareto.DATA.items()} | {
    "drone": ("euroc:$CVO_DATA/euroc_mh05", "random", "--copies 6 --steps 4000"),
    "car": ("kitti:$CVO_DATA/kitti_00", "random", "--copies 6 --steps 4000"),
}


class Cell(NamedTuple):
    """One network."""

    method: str
    data: str
    size: str
    seed: int = 0

    @property
    def name(self) -> str:
        """File name."""
        return f"{self.method}-{self.size}-{self.data}-{self.seed}"


CELLS = (
    *(Cell("cjp", "flights", size, seed) for size in SIZES for seed in range(3)),
    *(Cell("cjp", data, size) for data in ("walk", "drone", "car") for size in SIZES),
    *(Cell("cqr", "flights", size) for size in SIZES[:2]),
)


def measured(cell: Cell, work: Path) -> dict[str, Any]:
    """Return the figures of one network by precision, made if WORK lacks them."""
    path = work / f"{cell.name}.json"
    if path.exists():
        found: dict[str, Any] = json.loads(path.read_text("utf-8"))
        return found
    dataset, split, short = (os.path.expandvars(word) for word in DATA[cell.data])
    run = work / "runs" / cell.name
    options = f"--split {split} --size {cell.size} --seed {cell.seed} {short}"
    options += f" --cache {work / 'features'} --weights {os.path.expandvars(pareto.PRETRAINED)}"
    main_of = "from cvo_export.cli import main; main()"
    command = [sys.executable, "-c", main_of, "train", cell.method, dataset, str(run)]
    subprocess.run([*command, *options.split()], check=True, stdout=subprocess.DEVNULL)
    found = {}
    for precision in PRECISIONS:
        bundle = work / "bundles" / f"{cell.name}-{precision}"
        if not bundle.exists():
            publish(load_run(run, dataset), bundle, cell.name, rule="pooled", precision=precision)
        found[precision] = figures(bundle, dataset)
    path.write_text(json.dumps(found), "utf-8")
    return found


def main() -> None:
    """Print the scores; write all that are there as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--only", nargs="*", default=[], help="words of the networks' names")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    rows = []
    for cell in CELLS:
        wanted = all(word in cell.name for word in arguments.only)
        if not wanted and not (arguments.work / f"{cell.name}.json").exists():
            continue
        found = measured(cell, arguments.work)
        rows.append({**cell._asdict(), **found})
        scores = ", ".join(f"{each} {found[each][SCORE]:.3f}" for each in PRECISIONS)
        print(f"{cell.name}: {scores}", flush=True)
    if arguments.json:
        write_result(arguments.json, {"results": rows})


if __name__ == "__main__":
    main()
