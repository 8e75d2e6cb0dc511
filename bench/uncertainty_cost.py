"""What uncertainty costs: array to intervals, against the same network with its pose alone.

    python bench/uncertainty_cost.py BUNDLE SOURCE [--frames 400] [--json FILE]

The bundle's graph is cut at its output ``pose``; what only the other outputs need is gone. Both
take turns on the same frames, each first equally often: preprocessing and the cut graph, and the
odometer's step. The cost is the median difference over the median of the former.
"""

from __future__ import annotations

import argparse
import json
from itertools import cycle, islice
from pathlib import Path
from time import perf_counter

import numpy as np
import onnx
from onnx.utils import Extractor

from cvo_edge import preprocess
from cvo_edge.artifact import read_bundle
from cvo_edge.odometer import Odometer
from cvo_edge.profile import environment, quantiles
from cvo_edge.session import Session
from cvo_edge.sources import open_source

WARM_UP = 40


def pose_alone(model_bytes: bytes) -> bytes:
    """Return the part of the model that gives the pose."""
    extractor = Extractor(onnx.load_from_string(model_bytes))
    part: bytes = extractor.extract_model(["image"], ["pose"]).SerializeToString()
    return part


def main() -> None:
    """Time both, print the cost; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("source")
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    bundle = read_bundle(arguments.bundle)
    frames = islice(open_source(arguments.source), 50)
    images = [frame.image for frame in frames if frame.image is not None]
    spec = bundle.calibration.preprocess
    point = Session(pose_alone(bundle.model_bytes))
    alone: list[float] = []
    whole: list[float] = []
    conformal: list[float] = []
    with Odometer(bundle) as odometer:

        def pose_only(image: preprocess.Image) -> float:
            begin = perf_counter()
            bgr = preprocess.to_bgr8(image)
            if bgr is None:
                raise SystemExit(f"{arguments.source}: expected colour images")
            tensor = preprocess.model_input(bgr, spec.height, spec.width, spec.crop)
            point.run({"image": tensor})
            return 1e3 * (perf_counter() - begin)

        def intervals(image: preprocess.Image) -> float:
            begin = perf_counter()
            estimate = odometer.step(image)
            spent = 1e3 * (perf_counter() - begin)
            conformal.append(estimate.latency_ms["conformal"])
            return spent

        for number, image in enumerate(islice(cycle(images), WARM_UP + arguments.frames)):
            if number % 2:
                first, second = intervals(image), pose_only(image)
            else:
                second, first = pose_only(image), intervals(image)
            whole.append(first)
            alone.append(second)
    difference = float(np.median(np.subtract(whole, alone)[WARM_UP:]))
    cost = difference / float(np.median(alone[WARM_UP:]))
    numpy_part = float(np.median(conformal[WARM_UP:]))
    print(
        f"{bundle.calibration.name} ({bundle.calibration.method}): cost of uncertainty {cost:.3f}; "
        f"{difference:.3f} ms more than {np.median(alone[WARM_UP:]):.3f} ms, of it "
        f"{numpy_part:.3f} ms after the network"
    )
    if arguments.json:
        report = {
            "bundle": bundle.calibration.name,
            "method": bundle.calibration.method,
            "backbone": bundle.calibration.provenance.backbone,
            "frames": arguments.frames,
            "warmup": WARM_UP,
            "cost": round(cost, 4),
            "difference_ms": round(difference, 4),
            "after_network_ms": round(numpy_part, 4),
            "pose_alone_ms": quantiles(alone[WARM_UP:]),
            "intervals_ms": quantiles(whole[WARM_UP:]),
            "environment": environment(point.threads),
        }
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
