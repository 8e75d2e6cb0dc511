"""The size of the network's input: CJP with its default budget on real recordings.

    python bench/sizes.py WORK [--sizes 256x192,160x120] [--json FILE]

Trains, publishes in both precisions (rule pooled) and evaluates each size, recording and seed that
WORK lacks. ``bench/pareto.py`` searches among more networks with a small part of this budget.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from itertools import product
from pathlib import Path
from typing import Any

from pareto import DATA, PRETRAINED
from precision import PRECISIONS, figures
from provenance import write_result

from cvo_export.publish import publish
from cvo_export.training.run import load_run

SIZES, SEEDS = ("256x192", "192x144", "160x120"), (0, 1, 2)


def cell(work: Path, size: str, data: str, seed: int) -> dict[str, Any]:
    """Return the figures of one network by precision, made if WORK lacks them."""
    name = f"cjp-{size}-{data}-{seed}"
    path = work / f"{name}.json"
    if path.exists():
        found: dict[str, Any] = json.loads(path.read_text("utf-8"))
        return found
    dataset, split = (os.path.expandvars(word) for word in DATA[data])
    run = work / "runs" / name
    options = f"--split {split} --size {size} --seed {seed} --cache {work / 'features'}"
    options += f" --weights {os.path.expandvars(PRETRAINED)}"
    main_of = "from cvo_export.cli import main; main()"
    command = [sys.executable, "-c", main_of, "train", "cjp", dataset, str(run)]
    subprocess.run([*command, *options.split()], check=True, stdout=subprocess.DEVNULL)
    found = {}
    for precision in PRECISIONS:
        bundle = work / "bundles" / f"{name}-{precision}"
        if not bundle.exists():
            publish(load_run(run, dataset), bundle, name, rule="pooled", precision=precision)
        found[precision] = figures(bundle, dataset)
    path.write_text(json.dumps(found), "utf-8")
    return found


def main() -> None:
    """Print the scores; write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--sizes", default=",".join(SIZES))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed, data, size in product(SEEDS, DATA, arguments.sizes.split(",")):
        found = cell(arguments.work, size, data, seed)
        rows.append({"size": size, "data": data, "seed": seed, **found})
        scores = ", ".join(f"{each} {found[each]['score']:.3f}" for each in PRECISIONS)
        print(f"{size} {data} seed {seed}: score {scores}", flush=True)
    if arguments.json:
        write_result(arguments.json, {"results": rows})


if __name__ == "__main__":
    main()
