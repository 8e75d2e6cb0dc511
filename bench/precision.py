"""The cost of 8 bits for a trained run: coverage, width, error and size beside float32.

    python bench/precision.py RUN DATASET WORK [--json FILE]

Publishes the run in both precisions into WORK, each calibrated on its own graph (rule pooled), and
evaluates both on the run's test frames. ``bench/frame.py`` measures their speed.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from provenance import write_result

from cvo_edge.bundle.format import Precision
from cvo_edge.bundle.reading import read_calibration
from cvo_export.datasets import open_dataset
from cvo_export.evaluate import evaluate, find_level
from cvo_export.publish import publish
from cvo_export.training.run import load_run

CONFIDENCE = 0.9
PRECISIONS: tuple[Precision, ...] = ("fp32", "int8")


def figures(bundle: Path, dataset_text: str) -> dict[str, Any]:
    """Evaluate a bundle at 0.9."""
    report = evaluate(bundle, open_dataset(dataset_text), "test", threads=1)
    marginal, joint = (find_level(report["levels"], CONFIDENCE, s) for s in ("marginal", "joint"))
    return {
        "model_bytes": (bundle / "model.onnx").stat().st_size,
        "frames": report["frames"],
        "point_error": report["point_error"],
        "score": report["score"],
        "coverage": marginal["coverage"],
        "mean_coverage": float(np.mean(marginal["coverage"])),
        "joint_coverage": joint["joint_coverage"],
        "mean_width": marginal["mean_width"],
        "joint_mean_width": joint["mean_width"],
        "joint_volume": joint["joint_volume"],
        "normalised_interval_score": marginal["normalised_interval_score"],
    }


def main() -> None:
    """Publish, evaluate, print both; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("dataset")
    parser.add_argument("work", type=Path)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found: dict[str, Any] = {}
    for precision in PRECISIONS:
        bundle = arguments.work / f"{arguments.run.name}-{precision}"
        if not bundle.exists():
            run = load_run(arguments.run, arguments.dataset)
            publish(run, bundle, arguments.run.name, rule="pooled", precision=precision)
        found[precision] = figures(bundle, arguments.dataset)
    calibration = read_calibration(bundle)
    # A ratio for each of the six degrees of freedom, because their units differ.
    ratios = np.divide(found["int8"]["mean_width"], found["fp32"]["mean_width"])
    report = {
        "method": calibration.method,
        "backbone": calibration.provenance.backbone,
        "dataset": calibration.provenance.dataset,
        "split": calibration.calibration.split.kind,
        "seed": calibration.provenance.seed,
        "width_ratio": round(float(ratios.mean()), 4),
        **found,
    }
    print(f"{arguments.run.name}: mean width int8 / fp32 {report['width_ratio']:.3f}")
    for precision in PRECISIONS:
        row = found[precision]
        width = np.array(row["mean_width"])
        print(
            f"  {precision} {row['model_bytes'] / 1e6:5.1f} MB, coverage "
            f"{row['mean_coverage']:.3f}, all six {row['joint_coverage']:.3f}, width "
            f"{100 * width[:3].mean():.2f} cm {np.rad2deg(width[3:].mean()):.2f} deg, score "
            f"{row['normalised_interval_score']:.4f}, error "
            f"{100 * row['point_error']['median_m']:.2f} cm",
            flush=True,
        )
    if arguments.json:
        write_result(arguments.json, report)


if __name__ == "__main__":
    main()
