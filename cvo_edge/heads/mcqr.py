"""Multivariate conformalized quantile regression (MCQR): one region for all six degrees of freedom.

The model gives a codebook y_1 .. y_J of points that fill a region of likely residuals (directional
quantiles in the latent space of a conditional variational autoencoder, Feldman, Bates and Romano
2021, decoded along fixed rays), and a lower triangular scale matrix B, which describes the spread
and correlation of this frame's errors. The nonconformity score of a truth y is its scaled distance

    s = min_j |B^-1 (y - y_j)|

and the region {y : s(y) <= r} is a union of J ellipsoids, so it follows the shape of the codebook.
Its hull [min_j y_jd - r |B_d|, max_j y_jd + r |B_d|], with |B_d| the norm of row d, holds all six
degrees of freedom at once if the region holds the truth.

The joint scope uses this region. Its hull is too wide for a single degree of freedom, so the
marginal scope applies six thresholds of conformalized quantile regression (``cvo_edge.heads.cqr``)
to the raw hull (r = 1): ``calibration.score`` says whether they are added to its bounds
(``additive``) or multiply its half-widths about its midpoint (``normalised``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration, SixPositive, Threshold
from cvo_edge.conformal import JointScale, LinearScale
from cvo_edge.errors import CalibrationFileError
from cvo_edge.heads.base import Candidate, Head, Limit
from cvo_edge.heads.cqr import IntervalScore, below_spread, infinite_where_null, refuse_negative
from cvo_edge.sets import ConformalSet, Ellipsoids, scaled_distance, unbounded_set
from cvo_edge.vocabulary import Joint, Scope

Array = NDArray[np.float64]

_HAIR = 1e-12
# Only the lower triangle of the scale matrix is used; outputs are finite here.
_LOWER = np.tril(np.ones((6, 6)))
# Frames per block of distances: each frame needs J differences in memory.
_BLOCK = 500


class McqrParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """``method_parameters`` of an MCQR bundle.

    ``points``: J, size of the codebook. ``half_width_floor``: smallest half-width per DoF (m, rad)
    of the raw hull in the normalised score.
    """

    points: Annotated[int, Meta(ge=1, le=4096)]
    half_width_floor: SixPositive


class McqrHead(Head):
    """Score, region and intervals of multivariate conformalized quantile regression."""

    method = "mcqr"
    parameters_type = McqrParameters
    score_names = ("normalised", "additive")
    one_joint_score = True
    set_kind = "six at once, a region"
    parameters: McqrParameters

    def __init__(self, parameters: McqrParameters, score: str) -> None:
        super().__init__(parameters, score)
        floor = np.array(parameters.half_width_floor)
        self._score = IntervalScore(floor if score == "normalised" else None)
        self.outputs = {
            "pose": (1, 7),
            "codebook": (1, parameters.points, 6),
            "scale": (1, 6, 6),
        }

    def check(self, thresholds: Sequence[Threshold], joint: Joint) -> None:
        """As ``Head``: a single distance for all six DoF in the joint scope."""
        super().check(thresholds, joint)
        if joint != "max":
            raise CalibrationFileError(
                "calibration.joint: expected max for mcqr, which has one score for all six DoF, "
                f"found {joint}"
            )
        for entry in thresholds:
            radius = entry.q_hat[0]
            if self.score == "normalised":
                refuse_negative(entry, "mcqr")
            if entry.scope == "joint" and not (
                entry.q_hat == (radius,) * 6 and (radius is None or radius >= 0.0)
            ):
                raise CalibrationFileError(
                    "thresholds.q_hat: expected the same distance of at least 0 six times for mcqr "
                    f"and scope joint, found {list(entry.q_hat)} at {entry.confidence}"
                )

    def largest_marginal(self, radius: float) -> float:
        """As ``Head``: a truth in the region lies in its hull, which is the raw one at radius 1."""
        if self.score == "normalised":
            return max(1.0, radius)
        return 0.0 if radius <= 1.0 else math.inf

    def parameter_limits(self, calibration: Calibration) -> tuple[Limit, ...]:
        """As ``Head``."""
        return below_spread("half_width_floor", self.parameters.half_width_floor, calibration)

    def joint_scale(self, scores: Array) -> JointScale:
        """As ``Head``: no scaling, because all six scores are the same distance."""
        return LinearScale(np.ones(scores.shape[1:]))

    def shifts(self, scope: Scope) -> bool:
        """As ``Head``; the marginal additive score may be negative."""
        return scope == "marginal" and self.score == "additive"

    def plain_scores(
        self,
        outputs: Mapping[str, NDArray[Any]],
        point: Array,
        truth: Array,
        scope: Scope = "marginal",
    ) -> Array:
        """Outputs stacked over n frames, truth (n, 6) -> scores (n, 1, 6); ``point`` is not used.

        Marginal: the score of each DoF against the raw hull. Joint: the scaled distance, repeated
        six times.
        """
        codebook, scale = outputs["codebook"], outputs["scale"] * _LOWER
        if scope == "joint":
            blocks = np.array_split(np.arange(len(truth)), len(truth) // _BLOCK + 1)
            distance = np.concatenate(
                [scaled_distance(codebook[rows], scale[rows], truth[rows]) for rows in blocks]
            )
            return np.tile(distance[:, np.newaxis, np.newaxis], (1, 1, 6))
        extent = np.linalg.norm(scale, axis=2)
        lower = codebook.min(axis=1).astype(np.float64) - extent
        upper = codebook.max(axis=1).astype(np.float64) + extent
        sides = self._score.sides(lower, upper, 0.5 * (lower + upper), truth)
        return np.asarray(sides.max(axis=1, keepdims=True))

    def plain_set(
        self, outputs: Mapping[str, NDArray[Any]], point: Array, threshold: Threshold
    ) -> ConformalSet:
        """Outputs of one frame -> its region and hull, or six intervals; ``point`` is not used."""
        q_hat = infinite_where_null(threshold.q_hat)
        radius = float(q_hat[0])
        if threshold.scope == "joint" and radius == np.inf:
            return unbounded_set()
        codebook = outputs["codebook"][0]
        scale = outputs["scale"][0] * _LOWER
        # Minima along the rows of a copy are four times as fast as along the columns.
        columns = np.ascontiguousarray(codebook.T)
        lowest = columns.min(axis=1).astype(np.float64)
        highest = columns.max(axis=1).astype(np.float64)
        extent = np.sqrt((scale * scale).sum(axis=1))
        if threshold.scope == "joint":
            # Slightly enlarged, so that rounding leaves no point of the region outside its hull.
            furthest = np.maximum(np.abs(lowest), np.abs(highest))
            reach = radius * extent * (1.0 + _HAIR) + _HAIR * furthest
            ellipsoids = Ellipsoids(codebook, scale, radius)
            return ConformalSet(lowest - reach, highest + reach, ellipsoids=ellipsoids)
        lower, upper = lowest - extent, highest + extent
        middle, q = 0.5 * (lower + upper), q_hat.tolist()
        return self._score.inverse(lower.tolist(), upper.tolist(), middle.tolist(), q, q)

    def candidates(self) -> tuple[Candidate, ...]:
        """As ``Head``."""
        names = dict.fromkeys((self.score, *self.score_names))
        return tuple(Candidate(name, self.parameters) for name in names)

    def joint_description(self, joint: Joint) -> str:
        """As ``Head``."""
        return "distance to the nearest codebook point"
