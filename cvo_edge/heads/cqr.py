"""Conformalized quantile regression (CQR): the network's interval with a conformal correction.

The model gives a point m and bounds Q_l, Q_h (here the quantiles of a forest, inside the graph)
whose coverage is not guaranteed. The nonconformity score measures how far the truth y lies outside,
and its inverse moves the bounds by the conformal quantile q. ``calibration.score`` names one of
three scores:

- ``additive`` (Romano, Patterson and Candes 2019, eq. 6): Q_l - y below, y - Q_h above, so the
  set is [Q_l - q, Q_h + q]; a negative q narrows.
- ``normalised`` (CQR-r, Sesia and Candes 2020): (m - y)/(m - Q_l) below, (y - m)/(Q_h - m) above,
  with a lower limit on the half-widths, so the set is [m - q (m - Q_l), m + q (Q_h - m)]. Frames
  with wide bounds get a larger correction.
- ``residual``: |y - m|, for a model that gives a point and no bounds; the set is [m - q, m + q].

``sides`` says how the two sides are calibrated: ``symmetric`` uses one q for the maximum of both;
``asymmetric`` uses one q per side, each at half the miscoverage (Romano et al., theorem 2);
``lower`` and ``upper`` calibrate one bound at the whole miscoverage and leave the other unbounded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import gt
from typing import Any, ClassVar

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration, SixOrUnbounded, SixPositive, Threshold
from cvo_edge.errors import CalibrationFileError
from cvo_edge.heads.base import Candidate, Head, Limit
from cvo_edge.sets import ConformalSet
from cvo_edge.vocabulary import Joint, Scope, Sides

Array = NDArray[np.float64]
Six = Sequence[float]

_ZEROS = (0.0,) * 6
_POINT: dict[str, tuple[int, ...]] = {"pose": (1, 7)}
_BOUNDED: dict[str, tuple[int, ...]] = {**_POINT, "lower": (1, 6), "upper": (1, 6)}


@dataclass(frozen=True, eq=False)
class IntervalScore:
    """The score of an interval and its inverse; all arrays in metres and radians.

    ``floor`` (6,) is the smallest half-width of the normalised score; None selects the additive.
    """

    floor: Array | None

    def sides(self, lower: Array, upper: Array, point: Array, truth: Array) -> Array:
        """Bounds, point and truth (n, 6) -> scores below and above, (n, 2, 6)."""
        if self.floor is None:
            return np.stack([lower - truth, truth - upper], axis=1)
        below = (point - truth) / np.maximum(point - lower, self.floor)
        above = (truth - point) / np.maximum(upper - point, self.floor)
        return np.stack([below, above], axis=1)

    def inverse(self, lower: Six, upper: Six, point: Six, q_low: Six, q_high: Six) -> ConformalSet:
        """Bounds, point and thresholds of a frame -> its set, or the midpoint if it is empty.

        Six numbers each, finite but for the thresholds; for so few, numpy would take longer.
        """
        if self.floor is None:
            low = [bound - q for bound, q in zip(lower, q_low, strict=True)]
            high = [bound + q for bound, q in zip(upper, q_high, strict=True)]
        else:
            floor = self.floor.tolist()
            low = [
                at - q * max(at - bound, least)
                for at, bound, q, least in zip(point, lower, q_low, floor, strict=True)
            ]
            high = [
                at + q * max(bound - at, least)
                for at, bound, q, least in zip(point, upper, q_high, floor, strict=True)
            ]
        crossed = any(map(gt, low, high))
        if crossed:
            pairs = [_uncrossed(*pair) for pair in zip(low, high, strict=True)]
            low, high = ([pair[side] for pair in pairs] for side in (0, 1))
        return ConformalSet(np.array(low), np.array(high), crossed=crossed)


class CqrParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """``method_parameters`` of a CQR bundle.

    ``half_width_floor``: smallest half-width per DoF (m, rad) in the normalised score. ``sides``:
    how the two sides are calibrated (see the module).
    """

    half_width_floor: SixPositive
    sides: Sides


class CqrHead(Head):
    """Score and set of conformalized quantile regression."""

    method = "cqr"
    parameters_type: ClassVar[type[Struct]] = CqrParameters
    score_names: ClassVar[tuple[str, ...]] = ("additive", "normalised", "residual")

    def __init__(self, parameters: Any, score: str) -> None:  # noqa: ANN401 - as ``Head``
        super().__init__(parameters, score)
        # CJP has no such parameter: its network gives both bounds.
        self._sides: Sides = getattr(parameters, "sides", "symmetric")
        floor = np.array(parameters.half_width_floor)
        self._score = IntervalScore(floor if score == "normalised" else None)
        self._bounds = score != "residual"
        self.outputs = _BOUNDED if self._bounds else _POINT

    def check(self, thresholds: Sequence[Threshold], joint: Joint) -> None:
        """As ``Head``: one threshold per side, and factors that are not negative."""
        symmetric = self._sides == "symmetric"
        if any((entry.q_hat_upper is None) != symmetric for entry in thresholds):
            raise CalibrationFileError(
                f"thresholds.q_hat_upper: expected {'null' if symmetric else 'six values'} with "
                f"{self._sides} sides, found {'six values' if symmetric else 'null'}"
            )
        for number, level in enumerate(self.side_confidences(0.9)):
            side = "q_hat_upper" if number else "q_hat"
            if level is None and any(
                q is not None for entry in thresholds for q in getattr(entry, side) or ()
            ):
                raise CalibrationFileError(
                    f"thresholds.{side}: expected null with {self._sides} sides, found numbers"
                )
        if symmetric and self.score != "additive":
            for entry in thresholds:
                refuse_negative(entry, self.score)

    def parameter_limits(self, calibration: Calibration) -> tuple[Limit, ...]:
        """As ``Head``."""
        return below_spread("half_width_floor", self.parameters.half_width_floor, calibration)

    def side_confidences(self, confidence: float) -> tuple[float | None, ...]:
        """As ``Head``; ``asymmetric`` gives each side half the miscoverage."""
        return {
            "symmetric": (confidence,),
            "asymmetric": (0.5 + 0.5 * confidence,) * 2,
            "lower": (confidence, None),
            "upper": (None, confidence),
        }[self._sides]

    def shifts(self, scope: Scope) -> bool:
        """As ``Head``; additive scores, and those of a single side, may be negative."""
        return self.score == "additive" or self._sides != "symmetric"

    def plain_scores(
        self,
        outputs: Mapping[str, NDArray[Any]],
        point: Array,
        truth: Array,
        scope: Scope = "marginal",
    ) -> Array:
        """Outputs stacked over n frames, point and truth (n, 6) -> scores (n, sides, 6)."""
        sides = self._score.sides(*self._interval(outputs, point), point, truth)
        return sides.max(axis=1, keepdims=True) if self._sides == "symmetric" else sides

    def plain_set(
        self, outputs: Mapping[str, NDArray[Any]], point: Array, threshold: Threshold
    ) -> ConformalSet:
        """Outputs and point (6,) of one frame -> its set, or the midpoint if the set is empty."""
        lower = upper = at = point.tolist()
        if self._bounds:
            lower, upper = outputs["lower"].ravel().tolist(), outputs["upper"].ravel().tolist()
        q_low = q_high = infinite_where_null(threshold.q_hat).tolist()
        if threshold.q_hat_upper is not None:
            q_high = infinite_where_null(threshold.q_hat_upper).tolist()
        return self._score.inverse(lower, upper, at, q_low, q_high)

    def candidates(self) -> tuple[Candidate, ...]:
        """As ``Head``; a network without bounds has only the residual score."""
        names = (self.score,) if not self._bounds else (self.score, "normalised", "additive")
        return tuple(Candidate(name, self.parameters) for name in dict.fromkeys(names))

    def own_sets(self, outputs: Mapping[str, NDArray[Any]], point: Array) -> list[ConformalSet]:
        """As ``Head``: the set of the additive score at the threshold zero."""
        if not self._bounds:
            return []
        lower, upper = self._interval(outputs, point)
        rows = zip(lower.tolist(), upper.tolist(), point.tolist(), strict=True)
        return [IntervalScore(None).inverse(*row, _ZEROS, _ZEROS) for row in rows]

    def description(self) -> str:
        """As ``Head``: which bounds are calibrated."""
        return str(getattr(self.parameters, "sides", ""))

    def _interval(self, outputs: Mapping[str, NDArray[Any]], point: Array) -> tuple[Array, Array]:
        if not self._bounds:
            return point, point
        return outputs["lower"].astype(np.float64), outputs["upper"].astype(np.float64)


def _uncrossed(low: float, high: float) -> tuple[float, float]:
    """Return both bounds, or their midpoint twice if the lower one is above the upper one."""
    return (low, high) if low <= high else (0.5 * (low + high),) * 2


def refuse_negative(entry: Threshold, what: str) -> None:
    """Raise CalibrationFileError for a negative q_hat of a score that is never negative."""
    smallest = min(q for q in (*entry.q_hat, 0.0) if q is not None)
    if smallest < 0.0:
        raise CalibrationFileError(
            f"thresholds.q_hat: expected factors of at least 0 for {what}, found {smallest} at "
            f"{entry.confidence} {entry.scope}"
        )


def below_spread(key: str, values: SixPositive, calibration: Calibration) -> tuple[Limit, ...]:
    """Floors (6,), m and rad -> their limits, the standard deviations of the poses."""
    pairs = zip(values, calibration.pose.standard_deviation, strict=True)
    return tuple(Limit(f"{key}[{dof}]", value, most) for dof, (value, most) in enumerate(pairs))


@lru_cache(maxsize=64)
def infinite_where_null(q_hat: SixOrUnbounded) -> Array:
    """Stored threshold -> read-only array (6,), infinite where the threshold is unbounded."""
    numbers = np.array([np.inf if q is None else q for q in q_hat])
    numbers.setflags(write=False)
    return numbers
