"""Figures of conformal sets on held-out frames: coverage, width, score, volume, adaptiveness."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import betabinom, spearmanr

from cvo_edge import geometry
from cvo_edge.bundle.format import Calibration, Threshold
from cvo_edge.conformal import conformal_rank, interval_score
from cvo_edge.odometer import Odometer
from cvo_edge.sets import ConformalSet
from cvo_export.bundles.thresholds import Observed, effective_frames, workspace
from cvo_export.bundles.volume import ellipsoids_log_volume
from cvo_export.datasets import PoseDataset

Array = NDArray[np.float64]

# Of coverage: a band that holds, one that would if frames were independent draws, or none.
Claim = Literal["exact", "indicative", "none"]
# The band that a valid method's coverage stays in with this probability.
_BAND_PROBABILITY = 0.99
_LEAST_WIDTH = 1e-3
_ROUNDING = 1e-9
_LARGEST_LOG = 700.0


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
    """Widths and absolute errors (n, 6) -> ``Sets.adaptiveness``."""
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


@dataclass(frozen=True)
class Sets:
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
        """Standard deviation of each DoF of the known poses, (6,), m and rad."""
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
        limits = workspace(self.calibration.pose)
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
            **self.odometer.head.figures(sets),
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
        """For sets that may be in pieces: how often there is a gap (6,), and in any of the six."""
        if any(each.bands is None for each in sets):
            return {}
        gaps = np.array([[len(row) > 1 for row in each.bands or ()] for each in sets])
        return {
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
