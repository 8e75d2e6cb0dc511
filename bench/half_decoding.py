"""What a bundle loses that reads JPEG files at half size, and what other pixels cost it.

    python bench/half_decoding.py FULL HALF FORMAT:PATH NAME

``FULL`` and ``HALF`` are bundles of one run, published with ``--decode full`` and ``half``. The
frames of its role ``test`` run through each, read in two ways: at half size, and as the means of
four pixels, which is what whole pictures become. Writes ``results/decoders/NAME.json``.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from provenance import RESULTS, write_result

from cvo_edge.input.preprocess import halved
from cvo_edge.odometer import Odometer
from cvo_export.bundles.figures import Sets
from cvo_export.bundles.observed import Observed, observe
from cvo_export.data.splits import same_split
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.evaluate import find_level

CONFIDENCE = 0.9


def as_means(dataset: PoseDataset) -> PoseDataset:
    """Return the data set read as the rounded means of four pixels of whole pictures."""

    def read_image(index: int) -> NDArray[np.uint8]:
        whole = dataset.read_image(index)
        return halved(whole, whole.shape[0] // 2, whole.shape[1] // 2)

    return replace(dataset, read_image=read_image)


def figures_of(odometer: Odometer, seen: Observed, total: int) -> dict[str, Any]:
    """Coverage, width and errors at 0.9, of the frames that passed the checks."""
    levels = Sets(odometer, seen, odometer.calibration, "indicative").levels()
    found: dict[str, Any] = {"frames": total, "passed": len(seen.indices)}
    for scope in ("marginal", "joint"):
        level = find_level(levels, CONFIDENCE, scope)
        keys = ("coverage", "joint_coverage", "mean_width", "normalised_interval_score")
        found[scope] = {key: level[key] for key in keys if key in level}
    return found


def moved(one: Observed, other: Observed, width: list[float]) -> dict[str, float]:
    """How far poses move with the pixels, in widths of the mean marginal interval."""
    both, rows, others = np.intersect1d(one.indices, other.indices, return_indices=True)
    shares = np.abs(one.point[rows] - other.point[others]) / np.array(width)
    middle, high = np.percentile(shares, (50, 99)).tolist()
    return {"frames": len(both), "median": middle, "p99": high, "max": float(shares.max())}


def main() -> None:
    """Run both bundles both ways and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("full", "half", "dataset", "name"):
        parser.add_argument(name)
    arguments = parser.parse_args()
    dataset = open_dataset(arguments.dataset)
    ways = {"half": dataset.decoded("half"), "means": as_means(dataset)}
    results: dict[str, Any] = {}
    for decode, own in (("full", "means"), ("half", "half")):
        with Odometer.load(getattr(arguments, decode), threads=1) as odometer:
            indices = same_split(dataset, odometer.calibration.calibration.split).roles["test"]
            seen = {way: observe(odometer, read, indices) for way, read in ways.items()}
            found = {way: figures_of(odometer, seen[way], indices.size) for way in ways}
            width = found[own]["marginal"]["mean_width"]
            moves = moved(seen["half"], seen["means"], width)
            results[decode] = {"read": found, "moved": moves}
    write_result(RESULTS / "decoders" / f"{arguments.name}.json", {"results": results})


if __name__ == "__main__":
    main()
