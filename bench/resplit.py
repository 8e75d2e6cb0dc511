"""A sharp check of validity: fixed network, calibration and test frames split again many times.

    python bench/resplit.py BUNDLE DATASET [--resplits 200] [--json FILE]

The coverage of one split scatters by several percent around its expectation k/(n+1). Splitting the
pooled calibration and test frames again many times, with the network fixed, averages this scatter
away and shows whether scores, rank rule and sets are right. Every second split mirrors the previous
one (antithetic variates), so that 200 splits scatter no more than some 1400 independent ones.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from provenance import write_result

from cvo_edge.conformal import conformal_quantile, conformal_rank
from cvo_edge.engine.loading import read_bundle
from cvo_edge.odometer import Odometer
from cvo_export.bundles.observed import observe
from cvo_export.data.splits import same_split
from cvo_export.datasets import open_dataset

CONFIDENCE = 0.9


def resplit(
    scores: NDArray[np.float64], joint: NDArray[np.float64], n: int, resplits: int
) -> tuple[NDArray[np.float64], float]:
    """Mean coverage per DoF (6,) and mean joint coverage over many deals.

    Of marginal scores (m, 6) and joint ones (m,).
    """
    generator = np.random.default_rng(0)
    marginal, jointly = [], []
    order = np.arange(len(scores))
    for deal in range(resplits):
        order = order[::-1] if deal % 2 else generator.permutation(len(scores))
        cal, test = order[:n], order[n:]
        q_hat = [conformal_quantile(scores[cal, dof], CONFIDENCE) for dof in range(6)]
        marginal.append((scores[test] <= q_hat).mean(axis=0))
        jointly.append((joint[test] <= conformal_quantile(joint[cal], CONFIDENCE)).mean())
    return np.mean(marginal, axis=0), float(np.mean(jointly))


def main() -> None:
    """Print mean coverages beside k/(n+1); write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("dataset")
    parser.add_argument("--resplits", type=int, default=200)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    bundle = read_bundle(arguments.bundle)
    recorded = bundle.calibration.calibration.split
    dataset = open_dataset(arguments.dataset)
    roles = same_split(dataset, recorded).roles
    with Odometer(bundle) as odometer:
        seen = observe(odometer, dataset, np.concatenate([roles["cal"], roles["test"]]))
        scored = seen.scored(odometer.head)
        val = observe(odometer, dataset, roles["val"]).scored(odometer.head)
        joint = odometer.head.joint_scale(val.joint).comparable(scored.joint).max(axis=(1, 2))
    n = roles["cal"].size
    expected = conformal_rank(n, CONFIDENCE) / (n + 1)
    marginal, jointly = resplit(scored.marginal[:, 0], joint, n, arguments.resplits)
    worst = max(abs(float(value) - expected) for value in (*marginal, jointly))
    print(f"{arguments.resplits} deals of {len(joint)} frames, n = {n}: k/(n+1) = {expected:.4f}")
    print("coverage per DoF " + " ".join(f"{value:.4f}" for value in marginal))
    print(f"joint coverage   {jointly:.4f}")
    print(f"largest difference {worst:.4f}")
    if arguments.json:
        report = {
            "bundle": bundle.calibration.name,
            "resplits": arguments.resplits,
            "n": n,
            "expected": expected,
            "coverage": marginal.tolist(),
            "joint_coverage": jointly,
            "largest_difference": worst,
        }
        write_result(arguments.json, report)


if __name__ == "__main__":
    main()
