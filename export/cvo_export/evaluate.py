"""Coverage, width and error of a bundle on held-out frames, through the runtime, as users do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy.stats import betabinom, spearmanr

from cvo_edge import geometry
from cvo_edge.bundle.format import Calibration, Threshold
from cvo_edge.bundle.reading import read_bundle
from cvo_edge.conformal import conformal_rank, interval_score
from cvo_edge.errors import GateError, UsageError
from cvo_edge.heads.cqr import CqrHead, IntervalScore
from cvo_edge.heads.csp import CspHead
from cvo_edge.odometer import Odometer
from cvo_edge.sets import ConformalSet
from cvo_export.bundles.thresholds import (
    Observed,
    Rule,
    effective_frames,
    observe,
    with_thresholds,
    workspace,
)
from cvo_export.bundles.volume import ellipsoids_log_volume
from cvo_export.data.noise import Noise, noisy
from cvo_export.data.splits import Split, same_split
from cvo_export.datasets import PoseDataset
from cvo_export.vocabulary import Subset as Subset

Array = NDArray[np.float64]
# Of coverage: a band that holds, one that would if frames were independent draws, or none.
Claim = Literal["exact", "indicative", "none"]

# The band that a valid method's coverage stays in with this probability.
_BAND_PROBABILITY = 0.99

# What the table says of the claims that are not exact.
_INDICATIVE = "? indicative: frames of one recording are no independent draws"
_NO_CLAIM = "- no band: thresholds of clean frames promise nothing of noisy ones"

_LEAST_WIDTH = 1e-3
_ROUNDING = 1e-9
_LARGEST_LOG = 700.0


def evaluate(
    bundle_dir: Path,
    dataset: PoseDataset,
    subset: Subset,
    threads: int | None = None,
    noise: Noise | None = None,
) -> dict[str, Any]:
    """Evaluate every stored confidence and scope; the report of ``cvo-export evaluate --json``.

    ``test``: the frames that the run recorded as test, found again by the split in the bundle;
    ``all``: every frame of a data set that the run has not seen. Frames that a check flags are left
    out and counted.

    With ``noise``, drawn by the split's seed, all frames are degraded. The bundle's own thresholds,
    of clean frames, are evaluated beside those of the run's cal frames with the same noise
    (``recalibrated``). Without, where the run was split by sequence, the other calibration rule is
    evaluated beside the bundle's own.

    Raises
    ------
    SourceError
        The data set is not the one that was split, or no frame passes the checks.
    UsageError
        Noise on ``all``, or a calibration rule that is not computed here.
    """
    bundle = read_bundle(bundle_dir)
    calibration = bundle.calibration
    recorded = calibration.calibration.split
    first = calibration.thresholds[0]
    split = same_split(dataset, recorded) if subset == "test" else None
    if noise is not None:
        if split is None:
            raise UsageError(
                "noise: expected --subset test, as unseen data have no calibration frames to be "
                f"recalibrated on, found {subset}"
            )
        dataset = noisy(dataset, noise, recorded.seed)
    indices = subset_indices(calibration, dataset, subset)
    claim: Claim = "exact" if split is not None and split.kind == "random" else "indicative"
    with Odometer(
        bundle, threads=threads, confidence=first.confidence, scope=first.scope
    ) as odometer:
        seen = observe(odometer, dataset, indices)
        # Clean frames and noisy ones are not exchangeable.
        sets = _Sets(odometer, seen, calibration, claim if noise is None else "none")
        levels = sets.levels()
        report = {
            "bundle": calibration.name,
            "method": calibration.method,
            "dataset": dataset.name,
            "subset": subset,
            "split": recorded.kind,
            "noise": None if noise is None else {**asdict(noise), "seed": recorded.seed},
            "rule": calibration.calibration.rule,
            "score": calibration.calibration.score,
            "frames": {
                "total": len(indices),
                "bounded": _bounded(levels, len(seen.indices)),
                "degraded": seen.degraded,
                "invalid": seen.invalid,
            },
            "n_calibration": calibration.calibration.n,
            # Then "all" may hold frames that the network was trained on.
            "named_as_training_data": dataset.name == calibration.provenance.dataset,
            "point_error": point_error(seen),
            "own": sets.own(),
            "levels": levels,
            "sequences": sets.sequences(dataset),
        }
        if split is not None and noise is not None:
            again = _recalibrated(odometer, dataset, split, calibration)
            others = _Sets(odometer, seen, again, claim)
            report["recalibrated"] = {
                "n_calibration": again.calibration.n,
                "left_out": split.roles["cal"].size - again.calibration.n,
                "levels": others.levels(),
                "sequences": others.sequences(dataset),
            }
        elif split is not None and split.kind == "sequence":
            other = _recalibrated(odometer, dataset, split, _by_the_other_rule(calibration))
            others = _Sets(odometer, seen, other, claim)
            report["other_rule"] = {"rule": other.calibration.rule, "levels": others.levels()}
    return report


def subset_indices(
    calibration: Calibration, dataset: PoseDataset, subset: Subset
) -> NDArray[np.int64]:
    """Frame numbers of the recorded test role, or all.

    Raises SourceError where the data set is not the one that was split.
    """
    if subset == "all":
        return np.arange(len(dataset))
    return same_split(dataset, calibration.calibration.split).roles["test"]


def point_error(seen: Observed) -> dict[str, float]:
    """Median and 90 % quantile of position (m) and angle (deg) of the point estimate."""
    distance = np.linalg.norm(seen.pose[:, :3] - seen.true_pose[:, :3], axis=1)
    difference = geometry.quaternion_multiply(
        geometry.quaternion_conjugate(seen.pose[:, 3:]), seen.true_pose[:, 3:]
    )
    angle = np.rad2deg(np.linalg.norm(geometry.quaternion_log(difference), axis=1))
    return {
        "median_m": float(np.median(distance)),
        "median_deg": float(np.median(angle)),
        "p90_m": float(np.quantile(distance, 0.9)),
        "p90_deg": float(np.quantile(angle, 0.9)),
    }


def set_log_volume(found: ConformalSet, deviation: Array, seed: int) -> float:
    """Logarithm of the volume in which all six degrees of freedom lie, in standardised units.

    The product of six sets, or a union of ellipsoids. ``deviation`` (6,): standard deviation of
    each degree of freedom's poses, m and rad; ``seed`` of the estimate, one for each frame. A set
    without width counts as a thousandth of the deviation: a single one would make all volumes 0.
    """
    box = np.log(np.maximum(found.width() / deviation, _LEAST_WIDTH)).sum()
    if found.ellipsoids is None:
        return float(box)
    ellipsoids = ellipsoids_log_volume(found.ellipsoids, seed) - np.log(deviation).sum()
    return float(min(ellipsoids, box))


def adaptiveness(width: Array, error: Array) -> dict[str, float | None]:
    """Widths and absolute errors (n, 6) -> ``_Sets.adaptiveness``."""
    third = len(error) // 3
    # What differs by rounding alone is one width.
    if third == 0 or not np.all(np.ptp(width, axis=0) > _ROUNDING * np.abs(width).max(axis=0)):
        return {"width_ratio": None, "rank_correlation": None}
    ratios, correlations = [], []
    for dof in range(width.shape[1]):
        ordered = width[np.argsort(error[:, dof]), dof]
        if not ordered[:third].mean() > 0.0:
            return {"width_ratio": None, "rank_correlation": None}
        ratios.append(ordered[-third:].mean() / ordered[:third].mean())
        correlations.append(spearmanr(width[:, dof], error[:, dof]).statistic)
    return {
        "width_ratio": float(np.mean(ratios)),
        "rank_correlation": float(np.mean(correlations)),
    }


def coverage_band(n_calibration: int, n_test: int, confidence: float) -> list[float] | None:
    """Central 99 % of the coverage of ``n_test`` frames by an exchangeable calibration.

    With n scores and rank k, coverage given the calibration is Beta(k, n + 1 - k), so the number
    covered is Beta-binomial (Angelopoulos and Bates 2021, section 3.2). None where k > n: the set
    is everything.
    """
    k = conformal_rank(n_calibration, confidence)
    if k > n_calibration or n_test < 1:
        return None
    tail = 0.5 * (1.0 - _BAND_PROBABILITY)
    covered = betabinom(n_test, k, n_calibration + 1 - k)
    return [float(covered.ppf(tail) / n_test), float(covered.ppf(1.0 - tail) / n_test)]


def check_coverage(report: Mapping[str, Any], least: float) -> None:
    """Raise GateError where a DoF's marginal coverage at 0.9 is below ``least``.

    That of the bundle's own thresholds, also under noise.
    """
    level = find_level(report["levels"], 0.9, "marginal")
    worst = min(level["coverage"])
    if not worst >= least:
        raise GateError(f"evaluate: expected coverage of at least {least:g}, found {worst:.4f}")


def find_level(levels: list[dict[str, Any]], confidence: float, scope: str) -> dict[str, Any]:
    """Return the entry for this confidence, one of those every bundle stores, and scope."""
    return next(
        level for level in levels if level["confidence"] == confidence and level["scope"] == scope
    )


def table(report: Mapping[str, Any]) -> list[str]:
    """Return the report as lines of text for a person."""
    error, frames = report["point_error"], report["frames"]
    lines = [
        f"{report['bundle']} ({report['method']}, {report['score']} score) on {report['dataset']}, "
        f"{report['subset']} frames of a {report['split']} split",
        f"frames {frames['total']}, invalid {frames['invalid']}, degraded {frames['degraded']}; "
        f"calibrated on "
        f"{report['n_calibration']}",
        f"point error  median {100 * error['median_m']:.2f} cm {error['median_deg']:.2f} deg, "
        f"90 % {100 * error['p90_m']:.2f} cm {error['p90_deg']:.2f} deg",
    ]
    if report["noise"] is not None:
        noise = Noise(report["noise"]["name"], report["noise"]["strength"])
        lines.append(f"noise {noise} ({noise.unit}), seed {report['noise']['seed']}")
    if report["subset"] == "all" and report["named_as_training_data"]:
        lines.append("the name is that of the training data: true only if no frame is of it")
    if report["own"] is not None:
        own = report["own"]
        coverage = " ".join(f"{value:.3f}" for value in own["coverage"])
        lines.append(
            f"own bounds for 0.9, not calibrated: coverage {coverage}, all six "
            f"{own['joint_coverage']:.3f}, score {own['normalised_interval_score']:.3f}"
        )
    if report["noise"] is None:
        lines += ["", *_level_lines(report["rule"], report["levels"])]
        if "other_rule" in report:
            other = report["other_rule"]
            lines += ["", *_level_lines(other["rule"], other["levels"])]
        return lines + _sequence_lines(report["sequences"])
    again = report["recalibrated"]
    return [
        *lines,
        "",
        f"clean: the bundle's own thresholds, of {report['n_calibration']} frames without noise",
        *_level_lines(report["rule"], report["levels"], _NO_CLAIM),
        *_sequence_lines(report["sequences"]),
        "",
        f"recalibrated: thresholds of {again['n_calibration']} calibration frames with the same "
        f"noise; left out {again['left_out']}",
        *_level_lines(report["rule"], again["levels"]),
        *_sequence_lines(again["sequences"]),
    ]


def _bounded(levels: list[dict[str, Any]], frames: int) -> int:
    """Frames with finite bounds at the lowest stored confidence of all."""
    lowest = min(levels, key=lambda level: level["confidence"])
    return round((1.0 - float(lowest["unbounded_share"])) * frames)


def _level_lines(rule: str, levels: list[dict[str, Any]], footnote: str = _INDICATIVE) -> list[str]:
    lines = [
        f"{rule + ' rule':<20}{'coverage: tx ty tz, three rotations':^42}{'joint':>7}"
        f"{'99 % band':>16}{'width cm':>10}{'deg':>7}{'score':>8}",
    ]
    for level in levels:
        coverage = "".join(f"{value:>7.3f}" for value in level["coverage"])
        band = level["coverage_band"]
        shown = "-" if band is None else f"{band[0]:.3f}-{band[1]:.3f}"
        shown += " " if level["coverage_band_exact"] or band is None else "?"
        width = np.array(level["median_width"])
        lines.append(
            f"{level['confidence']:<8g}{level['scope']:<12}{coverage}"
            f"{level['joint_coverage']:>7.3f}{shown:>16}{100 * width[:3].mean():>10.2f}"
            f"{np.rad2deg(width[3:].mean()):>7.2f}{level['normalised_interval_score']:>8.3f}"
        )
    lines += [
        f"{level['confidence']:<8g}{level['scope']:<12}"
        f"classes in a set {np.mean(level['set_size']):.1f}, in pieces "
        f"{100 * np.mean(level['disjoint_share']):.1f} % of sets, "
        f"{100 * level['disjoint_frames']:.0f} % of frames"
        for level in levels
        if level["confidence"] == 0.9 and "set_size" in level
    ]
    lines += [
        f"{level['confidence']:<8g}{level['scope']:<12}volume over that of the poses' deviations, "
        f"to the power 1/6: {level['joint_volume']['geometric_mean'] ** (1 / 6):.3f}"
        for level in levels
        if level["confidence"] == 0.9 and "joint_volume" in level
    ]
    if not all(level["coverage_band_exact"] for level in levels):
        lines.append(footnote)
    return lines


def _sequence_lines(sequences: Mapping[str, Any]) -> list[str]:
    if len(sequences) < 2:
        return []
    lines = ["", f"{'sequence':<14}{'frames':>8}{'coverage at 0.9 per DoF':>44}{'joint':>10}"]
    for name, entry in sequences.items():
        cells = "".join(f"{value:>8.2f}" for value in entry["coverage"])
        lines.append(f"{name:<14}{entry['frames']:>8}{cells:>48}{entry['joint_coverage']:>10.2f}")
    return lines


def _recalibrated(
    odometer: Odometer, dataset: PoseDataset, split: Split, draft: Calibration
) -> Calibration:
    """Return the draft with thresholds of the run's cal frames, as this data set shows them."""
    val, cal = (observe(odometer, dataset, split.roles[role]) for role in ("val", "cal"))
    return with_thresholds(draft, val, cal)


def _by_the_other_rule(calibration: Calibration) -> Calibration:
    source = calibration.calibration
    rule: Rule = "pooled" if source.rule == "hierarchical" else "hierarchical"
    return replace(calibration, calibration=replace(source, rule=rule))


@dataclass(frozen=True)
class _Sets:
    """The sets of all observed frames at the thresholds of a calibration, and what it claims.

    The calibration is the odometer's own, or that with other thresholds.
    """

    odometer: Odometer
    seen: Observed
    calibration: Calibration
    claim: Claim

    @cached_property
    def effective(self) -> float:
        """Independent frames that the observed ones are worth."""
        return effective_frames(self.seen.scored(self.odometer.head))

    @property
    def deviation(self) -> Array:
        return np.array(self.calibration.pose.standard_deviation)

    def covered(self, sets: list[ConformalSet]) -> NDArray[np.bool_]:
        """Which true numbers lie in these sets, (n, 6)."""
        return np.array([each.covers(y) for each, y in zip(sets, self.seen.truth, strict=True)])

    def covered_jointly(self, sets: list[ConformalSet]) -> float:
        """Share of frames whose true numbers lie in these sets all six at once."""
        pairs = zip(sets, self.seen.truth, strict=True)
        return float(np.mean([each.contains(y) for each, y in pairs]))

    def levels(self) -> list[dict[str, Any]]:
        """Return the report's entries for all thresholds."""
        return [self.level(entry) for entry in self.calibration.thresholds]

    def level(self, entry: Threshold) -> dict[str, Any]:
        """Return the report's entry for one threshold."""
        sets = self.seen.sets(self.odometer.head, entry)
        covered = self.covered(sets)
        bounded = np.array([np.isfinite((each.lower, each.upper)).all() for each in sets])
        limits = workspace(self.calibration)
        limited = [each.within(*limits) for each in sets]
        n, n_test = self.calibration.calibration.n, len(covered)
        used = [level for level in self.odometer.head.side_confidences(0.9) if level is not None]
        one_bound = len(used) < len(self.odometer.head.side_confidences(0.9))
        # A single bound is penalised by 1/alpha, an interval by 2/alpha.
        alpha = (1.0 - entry.confidence) * (2.0 if one_bound else 1.0)
        # The band is that of one order statistic of frames: it says nothing of a rule that counts
        # sequences, of two thresholds a set, or of six that hold together by Bonferroni.
        banded = (
            self.claim != "none"
            and self.calibration.calibration.rule == "pooled"
            and len(used) == 1
            and any(None not in side for side in (entry.q_hat, entry.q_hat_upper or (None,)))
            and (entry.scope, self.calibration.calibration.joint) != ("joint", "bonferroni")
        )
        return {
            "confidence": entry.confidence,
            "scope": entry.scope,
            "coverage": covered.mean(axis=0).tolist(),
            "coverage_bounded": covered[bounded].mean(axis=0).tolist() if bounded.any() else None,
            "coverage_band": coverage_band(n, n_test, entry.confidence) if banded else None,
            "coverage_band_effective": coverage_band(
                max(1, int(self.calibration.calibration.n_effective)),
                max(1, int(self.effective)),
                entry.confidence,
            )
            if banded
            else None,
            "coverage_band_exact": self.claim == "exact",
            "joint_coverage": self.covered_jointly(sets),
            **self.widths(limited, alpha),
            "unbounded_share": float(1.0 - bounded.mean()),
            **(
                self.volumes(limited)
                if entry.scope == "joint"
                else {"adaptiveness": self.adaptiveness(limited)}
            ),
            **self.pieces(sets),
        }

    def widths(self, sets: list[ConformalSet], alpha: float) -> dict[str, Any]:
        """Widths and interval score (6,) of bounded sets, and its mean over the deviations."""
        width = np.array([each.width() for each in sets])
        distance = np.array(
            [each.distance(y) for each, y in zip(sets, self.seen.truth, strict=True)]
        )
        score = interval_score(width, distance, alpha).mean(axis=0)
        return {
            "mean_width": width.mean(axis=0).tolist(),
            "median_width": np.median(width, axis=0).tolist(),
            "interval_score": score.tolist(),
            "normalised_interval_score": float((score / self.deviation).mean()),
        }

    def adaptiveness(self, sets: list[ConformalSet]) -> dict[str, float | None]:
        """How far widths follow the point's errors, mean over the degrees of freedom.

        ``width_ratio``: mean width on the third of the frames with the largest errors over that on
        the third with the least; ``rank_correlation``: Spearman's, of width and error. None where a
        degree of freedom has one width for all frames, or none at all, and with too few frames.
        """
        return adaptiveness(
            np.array([each.width() for each in sets]),
            np.abs(self.seen.truth - self.seen.point),
        )

    def volumes(self, sets: list[ConformalSet]) -> dict[str, Any]:
        """Return volumes of the joint sets of all frames, bounded, in standardised units."""
        logarithm = np.array(
            [set_log_volume(each, self.deviation, seed) for seed, each in enumerate(sets)]
        )
        # No number of JSON is larger.
        volume = np.exp(np.minimum(logarithm, _LARGEST_LOG))
        return {
            "joint_volume": {
                "mean": float(volume.mean()),
                "median": float(np.median(volume)),
                "geometric_mean": float(np.exp(min(logarithm.mean(), _LARGEST_LOG))),
            }
        }

    def own(self) -> dict[str, Any] | None:
        """Return the figures of the network's own bounds, taken as 90 %, before any threshold.

        None for a network that gives none.
        """
        outputs = self.seen.outputs
        if not isinstance(self.odometer.head, CqrHead) or "lower" not in outputs:
            return None
        lower, upper = outputs["lower"].astype(np.float64), outputs["upper"].astype(np.float64)
        # The additive score's set at the threshold zero.
        rows = zip(lower, upper, self.seen.point, strict=True)
        sets = [IntervalScore(None).inverse(*row, np.zeros(6), np.zeros(6)) for row in rows]
        covered = self.covered(sets)
        return {
            "coverage": covered.mean(axis=0).tolist(),
            "joint_coverage": float(covered.all(axis=1).mean()),
            **self.widths(sets, 0.1),
        }

    def pieces(self, sets: list[ConformalSet]) -> dict[str, Any]:
        """For sets of classes: how many of them (6,), and how often there is a gap (6,), at all."""
        if not isinstance(self.odometer.head, CspHead):
            return {}
        gaps = np.array([[len(row) > 1 for row in each.bands or ()] for each in sets])
        classes = np.array([self.odometer.head.classes_in(each) for each in sets])
        return {
            "set_size": classes.mean(axis=0).tolist(),
            "disjoint_share": gaps.mean(axis=0).tolist(),
            "disjoint_frames": float(gaps.any(axis=1).mean()),
        }

    def sequences(self, dataset: PoseDataset) -> dict[str, dict[str, Any]]:
        """Coverage of each sequence at 0.9, marginal thresholds and the joint ones."""
        marginal = self.calibration.threshold(0.9, "marginal")
        joint = self.calibration.threshold(0.9, "joint")
        if marginal is None or joint is None:
            return {}
        head = self.odometer.head
        covered = self.covered(self.seen.sets(head, marginal))
        pairs = zip(self.seen.sets(head, joint), self.seen.truth, strict=True)
        jointly = np.array([each.contains(y) for each, y in pairs])
        found = {}
        for number in np.unique(self.seen.sequence).tolist():
            rows = np.flatnonzero(np.equal(self.seen.sequence, number))
            found[dataset.sequence_names[number]] = {
                "frames": int(rows.size),
                "coverage": covered[rows].mean(axis=0).tolist(),
                "joint_coverage": float(jointly[rows].mean()),
            }
        return found
