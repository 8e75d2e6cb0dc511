"""What each rule covers of new recordings: calibration recordings drawn again many times.

    python bench/redraw.py BUNDLE DATASET [--deals 300] [--json FILE]

The network, val and the solver's limits stay fixed. In each deal as many recordings as the bundle
was calibrated on are drawn from those of cal and test; the others are tested. Figures are means
over all deals at 0.9: coverage per degree of freedom, joint coverage, width and interval score; and
the median over all deals of the median width over that of the pooled rule (``over_pooled``, mean
over the degrees of freedom). The rule ``capped`` has its default cap.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from provenance import write_result

from cvo_edge.conformal import interval_score
from cvo_edge.engine.loading import read_bundle
from cvo_edge.errors import UsageError
from cvo_edge.heads import Head
from cvo_edge.odometer import Odometer
from cvo_edge.vocabulary import Rule
from cvo_export.bundles.observed import Observed, Scored, observe
from cvo_export.bundles.rule import DEFAULT_CAP
from cvo_export.bundles.thresholds import Quantiles
from cvo_export.data.splits import same_split
from cvo_export.datasets import open_dataset

Array = NDArray[np.float64]

CONFIDENCE = 0.9
RULES: tuple[Rule, ...] = get_args(Rule)


class Figures(NamedTuple):
    """Coverage, mean width and median width of each degree of freedom (6,), and two of all."""

    coverage: Array
    mean_width: Array
    median_width: Array
    joint_coverage: float
    score: float


def deal_figures(
    head: Head, cal: Scored, test: Observed, val: Scored, rule: Rule, unit: Array
) -> dict[str, Figures]:
    """Return the figures of one deal by scope; none for a scope with an unbounded threshold."""
    found: dict[str, Figures] = {}
    cap = DEFAULT_CAP if rule == "capped" else None
    for entry in Quantiles(head, cal, val, rule, "max", cap).entries():
        if entry.confidence != CONFIDENCE or None in entry.q_hat:
            continue
        sets = test.sets(head, entry)
        covered = np.array([each.covers(y) for each, y in zip(sets, test.truth, strict=True)])
        inside = [each.contains(y) for each, y in zip(sets, test.truth, strict=True)]
        width = np.array([each.width() for each in sets])
        distance = np.array([each.distance(y) for each, y in zip(sets, test.truth, strict=True)])
        score = interval_score(width, distance, 1.0 - CONFIDENCE) / unit
        found[entry.scope] = Figures(
            coverage=covered.mean(axis=0),
            mean_width=width.mean(axis=0),
            median_width=np.median(width, axis=0),
            joint_coverage=float(np.mean(inside)),
            score=float(score.mean()),
        )
    return found


def main() -> None:
    """Print the figures of all rules; write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("dataset")
    parser.add_argument("--deals", type=int, default=300)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    bundle = read_bundle(arguments.bundle)
    dataset = open_dataset(arguments.dataset)
    calibration = bundle.calibration
    roles = same_split(dataset, calibration.calibration.split).roles
    unit = np.array(calibration.pose.standard_deviation)
    with Odometer(bundle) as odometer:
        head = odometer.head
        seen = observe(odometer, dataset, np.concatenate([roles["cal"], roles["test"]]))
        val = observe(odometer, dataset, roles["val"]).scored(head)
    recordings = np.unique(seen.sequence)
    count = len(np.unique(dataset.sequence[roles["cal"]]))
    if len(recordings) <= count:
        raise UsageError(
            f"{dataset.name}: expected a split by sequence, found {len(recordings)} recordings in "
            "cal and test"
        )
    generator = np.random.default_rng(0)
    collected: dict[tuple[str, str], list[tuple[Figures, float]]] = {}
    for _ in range(arguments.deals):
        drawn = np.isin(seen.sequence, generator.permutation(recordings)[:count])
        cal, test = seen.where(drawn).scored(head), seen.where(~drawn)
        dealt = {rule: deal_figures(head, cal, test, val, rule, unit) for rule in RULES}
        for rule, scopes in dealt.items():
            for scope, found in scopes.items():
                over = np.mean(found.median_width / dealt["pooled"][scope].median_width)
                collected.setdefault((rule, scope), []).append((found, float(over)))
    figures: dict[str, Any] = {}
    print(f"{arguments.deals} deals: {count} of {len(recordings)} recordings calibrate")
    for (rule, scope), deals in collected.items():
        coverage = np.mean([each.coverage for each, _ in deals], axis=0)
        width = np.mean([each.mean_width for each, _ in deals], axis=0)
        joint = float(np.mean([each.joint_coverage for each, _ in deals]))
        score = float(np.mean([each.score for each, _ in deals]))
        over = float(np.median([ratio for _, ratio in deals]))
        figures.setdefault(rule, {})[scope] = {
            "coverage": coverage.tolist(),
            "mean_width": width.tolist(),
            "joint_coverage": joint,
            "normalised_interval_score": score,
            "over_pooled": over,
        }
        print(
            f"{rule:<13} {scope:<9} coverage {coverage.mean():.3f} (least {coverage.min():.3f}), "
            f"joint {joint:.3f}, width {100 * width[:3].mean():.2f} cm "
            f"{np.rad2deg(width[3:].mean()):.2f} deg, score {score:.3f}, "
            f"width over pooled {over:.3f}"
        )
    if arguments.json:
        report = {"bundle": calibration.name, "deals": arguments.deals, "recordings": count}
        write_result(arguments.json, {**report, **figures})


if __name__ == "__main__":
    main()
