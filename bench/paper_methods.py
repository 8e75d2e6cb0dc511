"""The paper's methods on recordings: train, publish and evaluate over seeds.

    python bench/paper_methods.py METHOD RECORDING WORK [--seeds 0 1 2] [--name NAME]
        [--study paper-methods] [-- OPTIONS OF cvo-export train]

RECORDING is ``redkitchen`` (split by frames) or ``kitchen_flights`` (split by flight), both in
``$CVO_DATA``; the pretrained backbone is in ``$CVO_WEIGHTS``. Writes
``results/STUDY/NAME-RECORDING-SEED.json``. Interrupted training resumes with the same command.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

from networks import METHODS
from provenance import RESULTS, write_result

from cvo_export.evaluate import table

# That of all results.
SIZE = "256x192"
SPLITS = {"redkitchen": "random", "kitchen_flights": "sequence"}
CVO_EXPORT = (sys.executable, "-c", "from cvo_export.cli import main; main()")


def timed(*arguments: str | Path) -> int:
    """Run ``cvo-export`` with its progress on stderr -> whole seconds it took."""
    begin = time.monotonic()
    subprocess.run([*CVO_EXPORT, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)
    return round(time.monotonic() - begin)


def main() -> None:
    """Run all seeds, one after the other; print each table and write each result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("method", choices=METHODS)
    parser.add_argument("recording", choices=SPLITS)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--name", help="name of a variant; by default the method's")
    parser.add_argument("--study", default="paper-methods", help="folder of bench/results")
    parser.add_argument("options", nargs="*", help="options of cvo-export train, after --")
    arguments = parser.parse_args()
    for seed in arguments.seeds:
        name = f"{arguments.name or arguments.method}-{arguments.recording}-{seed}"
        dataset = f"7scenes:{os.environ['CVO_DATA']}/{arguments.recording}"
        weights = Path(os.environ["CVO_WEIGHTS"]) / "mobilenetv2_100_imagenet.safetensors"
        run, bundle = arguments.work / name, arguments.work / f"{name}-bundle"
        report_file = arguments.work / f"{name}.json"
        how = ("--split", SPLITS[arguments.recording], "--seed", str(seed), "--weights", weights)
        cache = ("--size", SIZE, "--cache", arguments.work / "features")
        seconds = {
            "train": timed(
                "train", arguments.method, dataset, run, *how, *cache, *arguments.options
            ),
            "publish": timed("publish", run, bundle, "--rule", "pooled"),
            "evaluate": timed("evaluate", bundle, dataset, "--json", report_file),
        }
        report = json.loads(report_file.read_text("utf-8"))
        print(*table(report), sep="\n", flush=True)
        content = {"seconds": seconds, **report}
        write_result(RESULTS / arguments.study / f"{name}.json", content)


if __name__ == "__main__":
    main()
