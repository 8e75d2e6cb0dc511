"""Figures of conformal sets on held-out frames: coverage, width, score, volume, adaptiveness."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.stats import betabinom, spearmanr

from cvo_edge.bundle.format import Calibration, Threshold
from cvo_edge.conformal import conformal_rank, interval_score
from cvo_edge.covariance import chi_square_quantile, in_chart, nees
from cvo_edge.guarantee import statement
from cvo_edge.odometer import Odometer
from cvo_edge.sets import ConformalSet
from cvo_export.bundles.choice import moving, workspace
from cvo_export.bundles.observed import Observed
from cvo_export.bundles.thresholds import effective_frames
from cvo_export.bundles.volume import ellipsoids_log_volume
from cvo_export.data.pose_errors import pose_errors
from cvo_export.datasets import PoseDataset

Array = NDArray[np.float64]

# Status of a coverage band: exact, indicative (frames are correlated), or no band.
Claim = Literal["exact", "indicative", "none"]
# Probability with which the coverage of a valid method lies within the band.
_BAND_PROBABILITY = 0.99
_LEAST_WIDTH = 1e-3
_ROUNDING = 1e-9
_LARGEST_LOG = 700.0
# Ratio of variances below which a covariance has no inverse.
_SINGULAR = 1e-14


def point_error(seen: Observed) -> dict[str, float]:
    """Return the median and two quantiles of the position (m) and rotation (deg) errors."""
    distance, angle = pose_errors(seen.pose, seen.true_pose)
    return {
        "median_m": float(np.median(distance)),
        "median_deg": float(np.median(angle)),
        "p90_m": float(np.quantile(distance, 0.9)),
        "p99_m": float(np.quantile(distance, 0.99)),
        "p90_deg": float(np.quantile(angle, 0.9)),
        "p99_deg": float(np.quantile(angle, 0.99)),
    }


def set_log_volume(found: ConformalSet, deviation: Array, seed: int) -> float:
    """Return the logarithm of the volume of a six-DoF set, in standardised units.

    The set is a product of six sets or a union of ellipsoids. ``deviation`` (6,) is the standard
    deviation of the known poses per DoF, m and rad. ``seed`` is the seed of the Monte Carlo
    estimate; use a different one for each frame. A width of 0 counts as a thousandth of the
    deviation, because a single zero would make the mean volume of all frames 0.
    """
    box = np.log(np.maximum(found.width() / deviation, _LEAST_WIDTH)).sum()
    if found.ellipsoids is None:
        return float(box)
    ellipsoids = ellipsoids_log_volume(found.ellipsoids, seed) - np.log(deviation).sum()
    return float(min(ellipsoids, box))


def adaptiveness(width: Array, error: Array) -> dict[str, float | None]:
    """Compute ``Sets.adaptiveness`` from widths and absolute errors (n, 6)."""
    third = len(error) // 3
    # Widths that differ only by rounding count as equal.
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
    """Return the central 99 % of the coverage of ``n_test`` frames exchangeable with calibration.

    With n scores and rank k, coverage given the calibration is Beta(k, n + 1 - k), so the number
    of covered frames is Beta-binomial (Angelopoulos and Bates 2021, section 3.2). None if k > n,
    because the set is then unbounded.
    """
    k = conformal_rank(n_calibration, confidence)
    if k > n_calibration or n_test < 1:
        return None
    tail = 0.5 * (1.0 - _BAND_PROBABILITY)
    covered = betabinom(n_test, k, n_calibration + 1 - k)
    return [float(covered.ppf(tail) / n_test), float(covered.ppf(1.0 - tail) / n_test)]


@dataclass(frozen=True)
class Sets:
    """The sets of all observed frames at the thresholds of a calibration.

    ``calibration`` is the odometer's own, possibly with other thresholds; ``claim`` says how far
    its coverage band can be trusted.
    """

    odometer: Odometer
    seen: Observed
    calibration: Calibration
    claim: Claim

    @cached_property
    def effective(self) -> float:
        """Effective number of independent frames among the observed ones."""
        return effective_frames(self.seen.scored(self.odometer.head))

    @property
    def deviation(self) -> Array:
        """Standard deviation of the known poses per DoF, (6,), m and rad."""
        return np.array(self.calibration.pose.standard_deviation)

    def covered(self, sets: list[ConformalSet]) -> NDArray[np.bool_]:
        """Return whether each true value lies in its set, (n, 6)."""
        return np.array([each.covers(y) for each, y in zip(sets, self.seen.truth, strict=True)])

    def covered_jointly(self, sets: list[ConformalSet]) -> float:
        """Return the share of frames whose set contains all six true values."""
        pairs = zip(sets, self.seen.truth, strict=True)
        return float(np.mean([each.contains(y) for each, y in pairs]))

    def levels(self) -> list[dict[str, Any]]:
        """Return the report's entries for all thresholds."""
        return [self.level(entry) for entry in self.calibration.thresholds]

    def level(self, entry: Threshold) -> dict[str, Any]:
        """Return the report's entry for one threshold."""
        chart = self.odometer.chart
        sets = [
            each.trimmed(chart.turn_centre(point))
            for each, point in zip(
                self.seen.sets(self.odometer.head, entry), self.seen.point, strict=True
            )
        ]
        covered = self.covered(sets)
        bounded = np.array([np.isfinite((each.lower, each.upper)).all() for each in sets])
        limits = workspace(self.calibration.pose)
        limited = [each.within(*limits) for each in sets]
        n, n_test = self.calibration.calibration.n, len(covered)
        used = [level for level in self.odometer.head.side_confidences(0.9) if level is not None]
        one_bound = len(used) < len(self.odometer.head.side_confidences(0.9))
        # A single bound is penalised by 1/alpha, an interval by 2/alpha.
        alpha = (1.0 - entry.confidence) * (2.0 if one_bound else 1.0)
        # The band describes one order statistic of frame scores. It does not apply to a rule that
        # counts sequences, to sets with two thresholds, or to Bonferroni's six joint sets.
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
            "statement": None
            if self.claim == "none"
            else statement(self.calibration.calibration, self.odometer.head, entry),
            "left_out": msgspec.to_builtins(entry.left_out),
            "joint_coverage": self.covered_jointly(sets),
            **self.widths(limited, alpha),
            "nees": self.nees(sets, entry),
            "unbounded_share": float(1.0 - bounded.mean()),
            **(
                self.volumes(limited)
                if entry.scope == "joint"
                else {"adaptiveness": self.adaptiveness(limited)}
            ),
            **self.pieces(sets),
            **self.odometer.head.figures(sets),
        }

    def widths(self, sets: list[ConformalSet], alpha: float) -> dict[str, Any]:
        """Return widths and interval scores (6,) of bounded sets, and the standardised score.

        The standardised score is the mean over the DoF that move of interval score / standard
        deviation.
        """
        width = np.array([each.width() for each in sets])
        distance = np.array(
            [each.distance(y) for each, y in zip(sets, self.seen.truth, strict=True)]
        )
        score = interval_score(width, distance, alpha).mean(axis=0)
        moves = moving(self.calibration.pose)
        return {
            "mean_width": width.mean(axis=0).tolist(),
            "median_width": np.median(width, axis=0).tolist(),
            "interval_score": score.tolist(),
            "normalised_interval_score": float((score / self.deviation)[moves].mean()),
        }

    def nees(self, sets: list[ConformalSet], entry: Threshold) -> dict[str, float] | None:
        """Return how well the covariances of ``PoseInterval.covariance`` fit the errors.

        ``mean`` and ``median`` of NEES / 6, whose mean is 1 where they fit, and ``inside``, the
        share of NEES up to the chi-square quantile at 0.9. Sets that are unbounded or have no width
        do not count; None if all are such.
        """
        pairs = zip(sets, self.seen.point, strict=True)
        found = np.array([in_chart(s, p, entry.confidence, entry.scope) for s, p in pairs])
        rows = np.flatnonzero(np.isfinite(found).all(axis=(1, 2)))
        spread = np.linalg.eigvalsh(found[rows])
        rows = rows[spread[:, 0] > _SINGULAR * spread[:, -1]]
        if not rows.size:
            return None
        values = nees((self.seen.truth - self.seen.point)[rows], found[rows])
        return {
            "mean": float(values.mean() / 6.0),
            "median": float(np.median(values) / 6.0),
            "inside": float(np.mean(values <= chi_square_quantile(0.9))),
        }

    def adaptiveness(self, sets: list[ConformalSet]) -> dict[str, float | None]:
        """Return how closely widths follow the point errors, averaged over the DoF.

        ``width_ratio`` is the mean width of the third of the frames with the largest errors over
        the mean width of the third with the smallest; ``rank_correlation`` is Spearman's, between
        width and error. Both are None if the widths of some DoF are constant or zero, or if there
        are fewer than three frames.
        """
        return adaptiveness(
            np.array([each.width() for each in sets]),
            np.abs(self.seen.truth - self.seen.point),
        )

    def volumes(self, sets: list[ConformalSet]) -> dict[str, Any]:
        """Return the volumes of the bounded joint sets over all frames, in standardised units."""
        logarithm = np.array(
            [set_log_volume(each, self.deviation, seed) for seed, each in enumerate(sets)]
        )
        # A larger logarithm would overflow to infinity, which JSON cannot store.
        volume = np.exp(np.minimum(logarithm, _LARGEST_LOG))
        return {
            "joint_volume": {
                "mean": float(volume.mean()),
                "median": float(np.median(volume)),
                "geometric_mean": float(np.exp(min(logarithm.mean(), _LARGEST_LOG))),
            }
        }

    def own(self) -> dict[str, Any] | None:
        """Return the figures of the network's own uncalibrated bounds at 90 %.

        None for a network without bounds.
        """
        sets = self.odometer.head.own_sets(self.seen.outputs, self.seen.point)
        if not sets:
            return None
        covered = self.covered(sets)
        return {
            "coverage": covered.mean(axis=0).tolist(),
            "joint_coverage": float(covered.all(axis=1).mean()),
            **self.widths(sets, 0.1),
        }

    def pieces(self, sets: list[ConformalSet]) -> dict[str, Any]:
        """Return how often sets are disjoint: per DoF (6,), and in at least one DoF of a frame.

        Empty for methods whose sets are always intervals.
        """
        if any(each.bands is None for each in sets):
            return {}
        gaps = np.array([[len(row) > 1 for row in each.bands or ()] for each in sets])
        return {
            "disjoint_share": gaps.mean(axis=0).tolist(),
            "disjoint_frames": float(gaps.any(axis=1).mean()),
        }

    def sequences(self, dataset: PoseDataset) -> dict[str, dict[str, Any]]:
        """Return the coverage of each sequence at 0.9, with marginal and with joint thresholds."""
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
