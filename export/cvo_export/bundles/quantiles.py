"""The quantiles of a bundle: thresholds at many confidences, rounded upwards, as many as fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration, Column, QuantileTable, Threshold, version_of
from cvo_edge.bundle.reading import encode_calibration
from cvo_edge.errors import CalibrationFileError
from cvo_edge.heads import Head
from cvo_edge.heads.plausible import Draws
from cvo_edge.vocabulary import SCOPES, Scope

Array = NDArray[np.float64]
# Confidences (m,) and a scope -> thresholds (m, sides, 6), infinite where unbounded.
Bounds = Callable[[Sequence[float], Scope], Array]

# Steps of the confidence, below and above one half; and from 0.99 on steps of 1 - confidence in two
# digits.
_COARSE, _STEPS, _HALF, _TAIL = 20, 200, 0.5, 0.01
# The largest scores are kept one by one.
_RANKS = 250
_HIGH = 0.9
# What rounding may add: a share of the step to the next larger threshold.
_SHARE = 0.05
_LAST_DIGIT = 1e-9
# Confidences are rounded downwards to this many decimals.
_DECIMALS = 9


def with_quantiles(calibration: Calibration, head: Head, bounds: Bounds) -> Calibration:
    """Return a calibration with quantiles, as many as its file has room for; else unchanged.

    ``bounds`` gives the exact thresholds, by which those of the calibration were made.
    """
    confidences = _confidences(calibration, head)
    exact = {scope: bounds(confidences, scope) for scope in SCOPES}
    symmetric = head.side_confidences(_HIGH) == (_HIGH,)
    for every, below in ((1, 1.0), (2, _HIGH), (4, _HIGH), (4, 1.0), (16, 1.0)):
        kept = _kept(confidences, exact, every, below)
        if not kept:
            break
        table = _table(calibration, head, confidences, exact, kept, symmetric=symmetric)
        version = version_of(calibration.preprocess, table)
        found = replace(calibration, schema_version=version, quantiles=table)
        try:
            encode_calibration(found)
        except CalibrationFileError:
            # Too large; if anything else were wrong, writing the bundle without them says so.
            continue
        return found
    return calibration


def _confidences(calibration: Calibration, head: Head) -> list[float]:
    """Return ascending confidences: round ones, and where the thresholds change or end."""
    source = calibration.calibration
    draws = Draws.of(source)
    at_high = [replace(calibration.thresholds[0], confidence=_HIGH, scope=each) for each in SCOPES]
    levels = {level for entry in at_high for level in head.levels(entry, source.joint) if level}
    # The miscoverage of a confidence is shared by sides and degrees of freedom.
    shares = {(1.0 - level) / (1.0 - _HIGH) for level in levels}
    top = 1.0 - draws.cap / (draws.given + 1)
    # What one frame counts, if recordings are equally long.
    step = draws.given / (draws.given + 1) / source.n
    ends = [top - place * step for place in range(min(_RANKS, source.n))]
    found = {1.0 - (1.0 - level) / share for level in ends for share in shares}
    least = 1.0 - max(found)
    found = {each for each in found if each > _HALF} | {max(found)}
    found |= {number / _COARSE for number in range(1, _COARSE // 2)}
    found |= {number / _STEPS for number in range(_STEPS // 2, _STEPS - 1)}
    decade = _TAIL
    while decade > least:
        found |= {1.0 - decade * tenth / 100 for tenth in range(10, 100)}
        decade /= 10
    rounded = {math.floor(each * 10**_DECIMALS + 1e-3) / 10**_DECIMALS for each in found}
    stored = {each.confidence for each in calibration.thresholds}
    return sorted(each for each in rounded - stored if 0.0 < each <= max(found))


def _kept(
    confidences: Sequence[float], exact: dict[Scope, Array], every: int, below: float
) -> list[int]:
    """Return which confidences to keep: every so many below a confidence, without repetitions.

    A row of thresholds that equals the next one says nothing: confidences take the next larger one.
    """
    rows = np.concatenate([each.reshape(len(each), -1) for each in exact.values()], axis=1)
    last = [*(rows[1:] != rows[:-1]).any(axis=1).tolist(), True]
    finite = np.isfinite(rows).any(axis=1)
    told = [i for i in range(len(confidences)) if last[i] and finite[i]]
    # The most confident ones matter most, and the last one tells where the finite ones end.
    return [
        number
        for place, number in enumerate(reversed(told))
        if place % every == 0 or confidences[number] >= below
    ][::-1]


def _table(
    calibration: Calibration,
    head: Head,
    confidences: Sequence[float],
    exact: dict[Scope, Array],
    kept: list[int],
    *,
    symmetric: bool,
) -> QuantileTable:
    at = [confidences[number] for number in kept]
    rounded = {
        scope: _rounded(calibration.thresholds, at, exact[scope][kept], scope) for scope in SCOPES
    }
    if symmetric and not head.one_joint_score:
        # Rounding must not turn the order of the scopes; a last digit is that of the joint scale.
        joint, marginal = rounded["joint"], rounded["marginal"]
        with np.errstate(invalid="ignore"):
            turned = joint < marginal - _LAST_DIGIT * np.maximum(1.0, np.abs(marginal))
        rounded["joint"] = np.where(turned, marginal, joint)
    columns = {scope: _columns(values) for scope, values in rounded.items()}
    return QuantileTable(
        confidences=tuple(at), marginal=columns["marginal"], joint=columns["joint"]
    )


def _columns(values: Array) -> tuple[Column | None, ...]:
    """Thresholds (m, sides, 6) -> columns as they are stored."""
    if (values == values[:, :, :1]).all():
        values = values[:, :, :1]
    flat = values.reshape(len(values), -1).T
    return tuple(
        tuple(value if math.isfinite(value) else None for value in column)
        if np.isfinite(column).any()
        else None
        for column in flat.tolist()
    )


def _rounded(
    thresholds: Sequence[Threshold], at: Sequence[float], exact: Array, scope: Scope
) -> Array:
    """Round thresholds (m, sides, 6) upwards, but not beyond what is stored at a higher level."""
    stored = [entry for entry in thresholds if entry.scope == scope]
    confidences = [*at, *(entry.confidence for entry in stored)]
    sides = exact.shape[1]
    own = np.array(
        [
            [[math.inf if q is None else q for q in row or (None,) * 6] for row in rows[:sides]]
            for rows in ((entry.q_hat, entry.q_hat_upper) for entry in stored)
        ]
    )
    order = np.argsort(confidences)
    values = np.concatenate([exact, own]).reshape(len(confidences), -1)[order]
    fixed = np.arange(len(confidences))[order] >= len(at)
    rounded = np.stack([_column_rounded(column, fixed) for column in values.T], axis=1)
    return rounded[~fixed].reshape(exact.shape)


def _column_rounded(values: Array, fixed: NDArray[np.bool_]) -> Array:
    """Round ascending values (m,) upwards to few digits; those that are fixed stay.

    The next larger value leaves room; a value that is fixed leaves none to equal ones.
    """
    found, larger, stored = values.copy(), math.inf, set(values[fixed].tolist())
    for row in range(len(values) - 1, -1, -1):
        value = float(values[row])
        if row + 1 < len(values) and values[row + 1] > value:
            larger = float(values[row + 1])
        if math.isfinite(value) and math.isfinite(larger) and value not in stored:
            found[row] = _shortest(value, value + _SHARE * (larger - value))
    return found


def _shortest(least: float, most: float) -> float:
    """Return the number of the fewest decimals from least to most."""
    for decimals in range(16):
        scale = 10.0**decimals
        found = math.ceil(least * scale) / scale
        if least <= found <= most:
            return found
    return least
