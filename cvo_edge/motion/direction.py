"""Estimators without a scale: the direction of a motion in place of its translation.

A single camera says in which direction it moves, not how far. Its file has steps of length 1, or 0
where it knows no direction, and says so in a comment, ``# scale: none``. Rotations are calibrated
as for any estimator. The error of a direction is the angle between the estimated and the true
translation of a motion. Only motions count whose estimate is at least half a step long and whose
truth moves a millimetre; intervals hold for a share of these.

In ``motion.json``, direction takes the place of position, in rad: its threshold, usual scale and
coefficients. Bounds of translations are null.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import UsageError
from cvo_edge.motion.errors import Errors
from cvo_edge.motion.horizon_fit import Fit, fit_horizon
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.records import LEAST_STEPS
from cvo_edge.motion.thresholds import Scores
from cvo_edge.spread import Spread
from cvo_edge.vocabulary import MotionRule

Array = NDArray[np.float64]

# The column of position, which holds the direction.
COLUMN = 6
# Metres of the truth below which a motion has no direction.
LEAST_M = 1e-3


def angles(moved: Array, true: Array) -> Array:
    """Motions of the estimate and of the truth (m, 7) -> angles (m,), rad; NaN without any."""
    a, b = moved[:, :3], true[:, :3]
    across = np.linalg.norm(np.cross(a, b), axis=1)
    found = np.arctan2(across, np.sum(a * b, axis=1))
    known = (np.linalg.norm(a, axis=1) >= LEAST_STEPS) & (np.linalg.norm(b, axis=1) >= LEAST_M)
    return np.asarray(np.where(known, found, np.nan))


def rotations(errors: Errors) -> Errors:
    """Return errors of rotation alone."""
    residuals = errors.residuals.copy()
    residuals[:, :3] = 0.0
    return errors._replace(residuals=residuals)


def directions(errors: Errors) -> Errors:
    """Return errors of the direction alone, of motions that have one."""
    known = np.isfinite(errors.residuals[:, 0])
    residuals = errors.residuals[known]
    residuals[:, 1:] = 0.0
    return Errors(
        errors.end[known],
        errors.numbers[known],
        errors.sizes[known],
        residuals,
    )


class DirectionFit(NamedTuple):
    """The fit of a horizon with its direction, usual scale, thresholds (rules, levels)."""

    fit: Fit
    usual: float
    q: Array


def fit_direction(
    errors: Spread[Errors],
    groups: Sequence[str],
    fit: Fit,
    rules: Sequence[MotionRule],
    levels: Sequence[float],
    *,
    learned: bool,
    least: int,
) -> DirectionFit:
    """Calibrate the direction of recordings with at least so many motions that have one.

    Without two drives, its thresholds are infinite. ``fit`` is that of the rotation.
    """
    counts = errors.map(_count).collect()
    used = [place for place, count in enumerate(counts) if count >= least]
    own = [groups[place] for place in used]
    if len(set(own)) < 2:
        return DirectionFit(fit, 1.0, np.full((len(rules), len(levels)), np.inf))
    pointed = errors.take(used)
    # An angle is no error about which a bias could be learned.
    crossed = fit_horizon(pointed, own, learned, biased=False)
    q = Scores(crossed.scaled.map(_score).collect(), own).table(rules, levels)[:, :, 0]
    scale = fit.scale
    if (found := crossed.fit.scale) is not None:
        if scale is None:
            scale = found._replace(coefficients=np.zeros_like(found.coefficients))
        scale.coefficients[:, COLUMN] = found.coefficients[:, COLUMN]
    usual = float(np.mean(pointed.map(_usual, [crossed.fit] * len(used)).collect()))
    return DirectionFit(Fit(fit.bias, scale), usual, q)


def _count(errors: Errors) -> int:
    return len(errors.end)


def _score(scaled: tuple[Array, Array]) -> Array:
    return scaled[1][:, COLUMN : COLUMN + 1]


def _usual(errors: Errors, fit: Fit) -> float:
    return float(fit.scales(errors)[:, COLUMN].mean())


def check_same(name: str, unscaled: bool, pointed: bool) -> None:
    """Raise UsageError for an estimate without a scale and a calibration with one, or reverse."""
    if unscaled == pointed:
        return
    kinds = {True: "steps without a scale", False: "metres"}
    raise UsageError(
        f"{name}: expected {kinds[pointed]}, as in the calibration, found {kinds[unscaled]} (by "
        "its comment # scale: none)"
    )


def check_without_metres(
    horizons: Sequence[Horizon] | None, windows: Sequence[Horizon] | None
) -> None:
    """Raise UsageError for what steps without a scale cannot have: metres and tubes."""
    for each in horizons or ():
        if each.unit == "m":
            raise UsageError(
                f"horizon {each}: expected frames or seconds, as the estimates have no scale"
            )
    if windows:
        raise UsageError(f"window {windows[0]}: expected none, as the estimates have no scale")
