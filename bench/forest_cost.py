"""The cost of the forest inside a CQR bundle: time, file size, memory at load.

    python bench/forest_cost.py BUNDLE SOURCE [--frames 300] [--json FILE]

The bundle's model is timed beside the same model cut off before the forest, one call after the
other on the same frames; memory is the growth of a fresh process that loads either.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from time import perf_counter

import numpy as np
from networks import pose_alone
from provenance import write_result

from cvo_edge.engine.loading import read_bundle
from cvo_edge.engine.session import Session
from cvo_edge.input import preprocess
from cvo_edge.input.sources import open_source
from cvo_edge.odometer import Odometer

LOAD = """
import sys
from pathlib import Path
from cvo_edge.programs.measure import memory_mib
from cvo_edge.engine.session import Session
content = Path(sys.argv[1]).read_bytes()
before = memory_mib()
session = Session(content)
after = memory_mib()
print(after["rss"] - before["rss"], after["peak_rss"] - before["peak_rss"])
"""


def load_mib(model_bytes: bytes) -> list[float]:
    """Growth of resident and of peak memory while a fresh process loads the model, MiB."""
    with tempfile.NamedTemporaryFile(suffix=".onnx") as file:
        file.write(model_bytes)
        file.flush()
        command = [sys.executable, "-c", LOAD, file.name]
        found = [
            subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
            for _ in range(5)
        ]
    return np.median(np.array(found, dtype=float), axis=0).round(1).tolist()


def main() -> None:
    """Time, measure and print; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("source")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    bundle = read_bundle(arguments.bundle)
    spec = bundle.calibration.preprocess
    images = [frame.image for frame in islice(open_source(arguments.source), 50)]
    tensors = [
        preprocess.model_input(image, spec.height, spec.width, spec.crop)
        for image in map(preprocess.to_bgr8, images)
        if image is not None
    ]
    cut = pose_alone(bundle.model_bytes)
    whole, point = Session(bundle.model_bytes), Session(cut)
    spent: dict[str, list[float]] = {"whole": [], "without": [], "step": []}
    with Odometer(bundle) as odometer:
        for count, (image, tensor) in enumerate(
            islice(cycle(zip(images, tensors, strict=True)), arguments.frames + 20)
        ):
            # The order rotates, because a later call finds warmer caches.
            calls = {
                "whole": partial(whole.run, {"image": tensor}),
                "without": partial(point.run, {"image": tensor}),
                "step": partial(odometer.step, image),
            }
            names = list(calls)
            for name in names[count % 3 :] + names[: count % 3]:
                begin = perf_counter()
                calls[name]()
                if count >= 20:
                    spent[name].append(1e3 * (perf_counter() - begin))
    median = {name: round(float(np.median(values)), 4) for name, values in spent.items()}
    difference = np.array(spent["whole"]) - np.array(spent["without"])
    forest_ms = float(np.median(difference))
    report = {
        "bundle": bundle.calibration.name,
        "frames": arguments.frames,
        "median_ms": median,
        "forest_ms": round(forest_ms, 4),
        "share_of_frame": round(forest_ms / median["step"], 4),
        "model_mib": round(len(bundle.model_bytes) / 2**20, 2),
        "without_mib": round(len(cut) / 2**20, 2),
        "load_mib": {"whole": load_mib(bundle.model_bytes), "without": load_mib(cut)},
        "threads": whole.threads,
    }
    print(json.dumps(report, indent=1))
    if arguments.json:
        write_result(arguments.json, report)


if __name__ == "__main__":
    main()
