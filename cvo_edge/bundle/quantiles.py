"""Thresholds at any confidence: those that are stored, and quantiles of the calibration scores.

A bundle stores ``thresholds`` at a few confidences. It may also hold ``quantiles``: thresholds at
many more, rounded upwards. A confidence between two of them gets the thresholds of the next larger
one, which are never below the exact quantile, so that the guarantee holds as it does at the stored
confidences. Beyond the largest one with a finite quantile, thresholds are unbounded.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple, get_args

from cvo_edge.bundle.format import (
    Calibration,
    Column,
    QuantileTable,
    SixOrUnbounded,
    Threshold,
)
from cvo_edge.documents import shown
from cvo_edge.errors import CalibrationFileError, UsageError
from cvo_edge.given import given_number
from cvo_edge.vocabulary import SCOPES, Scope

# The range of ``Threshold.confidence``.
_LARGEST_CONFIDENCE = 1.0 - 1e-9


class Reach(NamedTuple):
    """For a scope: the largest confidence with six finite thresholds, 0 for none."""

    scope: Scope
    confidence: float


def threshold_at(calibration: Calibration, confidence: float, scope: Scope) -> Threshold:
    """Return the threshold for a confidence and scope: the stored one, or one by the quantiles.

    Raises UsageError for a confidence or scope out of range, and for a confidence that is not
    stored in a bundle without quantiles; the message names its stored neighbours.
    """
    if scope not in get_args(Scope):
        raise UsageError(
            f"scope: expected one of {', '.join(get_args(Scope))}, found {shown(scope)}"
        )
    wanted = given_number(confidence, "confidence")
    found = calibration.threshold(wanted, scope)
    if found is not None:
        return found
    if not 0.0 < wanted <= _LARGEST_CONFIDENCE:
        raise UsageError(f"confidence: expected a number between 0 and 1, found {wanted:.15g}")
    table = calibration.quantiles
    if table is None:
        raise _not_stored(calibration, wanted, scope)
    return _between(calibration, table, wanted, scope)


def table_entries(calibration: Calibration) -> tuple[Threshold, ...]:
    """Return the thresholds at every confidence of the quantiles, for both scopes."""
    table = calibration.quantiles
    if table is None:
        return ()
    return tuple(
        _between(calibration, table, confidence, scope)
        for scope in SCOPES
        for confidence in table.confidences
        if calibration.threshold(confidence, scope) is None
    )


def reaches(calibration: Calibration) -> tuple[Reach, ...]:
    """Return, for each scope, the largest confidence whose thresholds are finite."""
    found = []
    entries = (*calibration.thresholds, *table_entries(calibration))
    for scope in SCOPES:
        finite = [e.confidence for e in entries if e.scope == scope and _is_finite(e)]
        found.append(Reach(scope, max(finite, default=0.0)))
    return tuple(found)


def check_quantiles(calibration: Calibration) -> None:
    """Raise CalibrationFileError if quantiles contradict each other or the stored thresholds."""
    table = calibration.quantiles
    if table is None:
        return
    for low, high in pairwise(table.confidences):
        if not low < high:
            raise CalibrationFileError(
                f"quantiles.confidences: expected ascending numbers, found {low} before {high}"
            )
    for scope in SCOPES:
        entries = [entry for entry in calibration.thresholds if entry.scope == scope]
        entries.sort(key=lambda entry: entry.confidence)
        sides = 1 if entries[0].q_hat_upper is None else 2
        columns = getattr(table, scope)
        if len(columns) not in (6 * sides, sides):
            raise CalibrationFileError(
                f"quantiles.{scope}: expected {6 * sides} lists, or {sides} for six equal ones, "
                f"found {len(columns)}"
            )
        for number, column in enumerate(columns):
            _check_column(table, column, f"quantiles.{scope}[{number}]")
        for side in range(sides):
            for dof, column in enumerate(_of_side(columns, side, sides)):
                stored = [(e.confidence, _sides(e)[side][dof]) for e in entries]
                _check_against(table, column, stored, f"quantiles.{scope}, degree of freedom {dof}")


def _check_column(table: QuantileTable, column: Column | None, where: str) -> None:
    if column is None:
        return
    if len(column) != len(table.confidences):
        raise CalibrationFileError(
            f"{where}: expected one number for each of the {len(table.confidences)} confidences, "
            f"found {len(column)}"
        )
    for low, high in pairwise(map(_number, column)):
        if low > high:
            raise CalibrationFileError(
                f"{where}: expected numbers that grow with the confidence, found {low:.9g} before "
                f"{high:.9g}"
            )


def _check_against(
    table: QuantileTable,
    column: Column | None,
    stored: Sequence[tuple[float, float | None]],
    where: str,
) -> None:
    """Check that a column lies between the stored thresholds around each confidence."""
    values = [_number(value) for value in column or (None,) * len(table.confidences)]
    for confidence, threshold in stored:
        place = bisect_left(table.confidences, confidence)
        below = values[place - 1] if place else -math.inf
        above = values[place] if place < len(values) else math.inf
        if not below <= _number(threshold) <= above and column is not None:
            raise CalibrationFileError(
                f"{where}: expected the threshold at {confidence:g}, {_number(threshold):.9g}, "
                f"between its neighbours, found {below:.9g} and {above:.9g}"
            )


def _between(
    calibration: Calibration, table: QuantileTable, confidence: float, scope: Scope
) -> Threshold:
    """Return the least of the thresholds that are known at this confidence or a larger one."""
    place = bisect_left(table.confidences, confidence)
    stored = [
        entry
        for entry in calibration.thresholds
        if entry.scope == scope and entry.confidence >= confidence
    ]
    above = min(stored, key=lambda entry: entry.confidence, default=None)
    shape = _sides(calibration.thresholds[0])
    columns = getattr(table, scope)
    rows: list[SixOrUnbounded] = []
    for side in range(len(shape)):
        of_table = [
            math.inf if column is None or place == len(column) else _number(column[place])
            for column in _of_side(columns, side, len(shape))
        ]
        of_stored = (None,) * 6 if above is None else _sides(above)[side]
        least = [min(q, _number(s)) for q, s in zip(of_table, of_stored, strict=True)]
        a, b, c, d, e, f = (value if math.isfinite(value) else None for value in least)
        rows.append((a, b, c, d, e, f))
    upper = rows[1] if len(rows) == 2 else None
    return Threshold(confidence=confidence, scope=scope, q_hat=rows[0], q_hat_upper=upper)


def _not_stored(calibration: Calibration, wanted: float, scope: Scope) -> UsageError:
    stored = calibration.confidences(scope)
    nearest = [*[c for c in stored if c < wanted][-1:], *[c for c in stored if c > wanted][:1]]
    return UsageError(
        f"confidence: {wanted:g} is not stored in the bundle for the {scope} scope, which holds no "
        f"quantiles; nearest: {' and '.join(f'{c:g}' for c in nearest) or 'none'}; stored: "
        f"{', '.join(f'{c:g}' for c in stored) or 'none'}"
    )


def _of_side(columns: Sequence[Column | None], side: int, sides: int) -> Sequence[Column | None]:
    """Return the six columns of a side."""
    if len(columns) == sides:
        return (columns[side],) * 6
    return columns[6 * side : 6 * side + 6]


def _sides(entry: Threshold) -> tuple[SixOrUnbounded, ...]:
    return (entry.q_hat,) if entry.q_hat_upper is None else (entry.q_hat, entry.q_hat_upper)


def _number(value: float | None) -> float:
    return math.inf if value is None else value


def _is_finite(entry: Threshold) -> bool:
    """Whether some side is finite in all six degrees of freedom; one may be left open by design."""
    return any(None not in side for side in _sides(entry))
