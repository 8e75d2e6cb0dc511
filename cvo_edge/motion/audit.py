"""How often intervals of ``motion.json`` hold the truth of other recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from cvo_edge.covariance import nees
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.motion.covariance import CHI_SQUARE, SPANS_S, sums_of
from cvo_edge.motion.direction import angles, check_same
from cvo_edge.motion.drift import Running
from cvo_edge.motion.intervals import (
    Intervals,
    Level,
    MotionCalibration,
    MotionHorizon,
    MotionWindow,
)
from cvo_edge.motion.pairs import Pair
from cvo_edge.motion.recordings import trace_of
from cvo_edge.motion.relative import motion, norms, residual
from cvo_edge.motion.trace import Rows
from cvo_edge.motion.windows import window_errors

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

_MOST_ANCHORS = 300


class HorizonAudit(Struct, frozen=True):
    """Coverage of one recording at one horizon.

    Attributes
    ----------
    dof, joint, position, rotation
        Coverage of each degree of freedom, of all six at once, and of the two balls.
    half_widths, radii
        Mean half-widths and radii, m and rad.
    nees, nees_inside
        Mean NEES of the covariance ``interval`` over six, and the share up to the chi-square
        quantile at 0.9, whatever the confidence.
    directions
        null but for an estimator without a scale: the number of motions with a direction.
        ``position`` and the first of ``radii`` (rad) are then about these; ``dof``, ``joint`` and
        ``half_widths`` are about the three degrees of freedom of rotation; NEES are 0.
    """

    horizon: str
    motions: int
    dof: tuple[float, ...]
    joint: float
    position: float
    rotation: float
    half_widths: tuple[float, ...]
    radii: tuple[float, float]
    nees: float
    nees_inside: float
    directions: int | None = None


class NeesAudit(Struct, frozen=True):
    """The covariance ``integrated`` summed over a time: mean NEES over six, and share inside."""

    seconds: float
    sums: int
    nees: float
    nees_inside: float


class WindowAudit(Struct, frozen=True):
    """Share of one recording's windows whose tube holds the truth throughout.

    ``six``: all six degrees of freedom at once.
    """

    window: str
    windows: int
    position: float
    rotation: float
    six: float


class RecordingAudit(Struct, frozen=True):
    """One recording.

    Figures count what is stated, as ``annotate`` does.

    Attributes
    ----------
    withheld
        Share of poses without intervals because the motion is unlike any calibrated one.
    other_rate
        Share of poses at another rate, without horizons in frames and covariances of steps.
    """

    name: str
    group: str
    withheld: float
    other_rate: float
    horizons: tuple[HorizonAudit, ...]
    windows: tuple[WindowAudit, ...]
    integrated: tuple[NeesAudit, ...]


class Audit(Struct, frozen=True):
    """All recordings, with what was claimed.

    ``calibrated_on``: names of recordings that seem to be in the calibration, which test nothing.
    """

    calibration: str
    digest: str
    confidence: float
    rule: str
    scope: str
    statement: str
    recordings: tuple[RecordingAudit, ...]
    calibrated_on: tuple[str, ...]
    horizons: tuple[str, ...]

    def over(self, horizon: str) -> list[HorizonAudit]:
        """Return the figures at a horizon, of recordings with motions over it."""
        every = (each for one in self.recordings for each in one.horizons)
        return [each for each in every if each.horizon == horizon and each.motions]

    def failure(self, least: float) -> str | None:
        """Return why the coverage is not at least this at every horizon, or None."""
        for horizon in self.horizons:
            coverage = self.coverage(horizon)
            found = "no motion" if coverage is None else f"{coverage:.3f}"
            if coverage is None or coverage < least:
                return (
                    f"expected a coverage of at least {least:g} at every horizon, found {found} at "
                    f"{horizon}"
                )
        return None

    def coverage(self, horizon: str) -> float | None:
        """Return the coverage at a horizon, averaged over recordings; None without motions.

        That of the degrees of freedom in the marginal scope, that of all six in the joint one.
        """
        joint = self.scope == "joint"
        every = self.over(horizon)
        found = [each.joint if joint else float(np.mean(each.dof)) for each in every]
        pointed = [each.position for each in every if each.directions]
        shares = [float(np.mean(each)) for each in (found, pointed) if each]
        return min(shares, default=None)


def audit(calibration: MotionCalibration, level: Level, pairs: Sequence[Pair]) -> Audit:
    """Compare the intervals of recordings with their truth.

    Raises UsageError if a column of the scale is missing, and SourceError if no recording has a
    motion over any horizon.
    """
    recordings, known = [], []
    measure = _pointed_horizon if calibration.pointed else _horizon
    for pair in pairs:
        check_same(pair.name, pair.unscaled, calibration.pointed)
        missing = [name for name in calibration.file.columns if name not in pair.columns]
        if missing:
            raise UsageError(f"{pair.name}: expected the column {missing[0]}, found none")
        rows = trace_of(scaled(calibration, pair), calibration.limits, calibration.file.columns)
        # Paths of steps of length 1 are as long as others.
        if not calibration.pointed and _known(calibration, rows):
            known.append(pair.name)
        truth, differs = pair.truth, calibration.other_rate(rows.stamps_ns)
        given = _given(calibration, rows)
        ends = np.flatnonzero(given)
        in_frames = np.flatnonzero(given & ~differs)
        horizons = [
            measure(
                each,
                each.intervals(rows, level, in_frames if each.horizon.unit == "f" else ends),
                truth,
            )
            for each in calibration.horizons
        ]
        # A tube is stated at the poses of the window that have one.
        stated = np.where(given[:, np.newaxis], truth, np.nan)
        windows = [_window(each, rows, stated, level) for each in calibration.windows]
        recordings.append(
            RecordingAudit(
                pair.name,
                pair.group,
                float(1.0 - given.mean()),
                float(differs.mean()),
                tuple(horizons),
                tuple(windows),
                tuple(_integrated(calibration, rows, truth, in_frames)),
            )
        )
    if not any(each.motions for one in recordings for each in one.horizons):
        raise SourceError(
            f"{pairs[0].name}: expected motions over {calibration.file.horizons[0].horizon} or "
            "another horizon with a truth at both ends, found none: all poses are missing, or too "
            "far apart in time or space for this calibration"
        )
    file = calibration.file
    return Audit(
        file.name,
        file.digest,
        level.confidence,
        level.rule,
        level.scope,
        calibration.statement(level),
        tuple(recordings),
        tuple(known),
        tuple(spec.horizon for spec in file.horizons),
    )


def scaled(calibration: MotionCalibration, pair: Pair) -> Pair:
    """Return a pair with the calibration's correction of the scale."""
    return replace(pair, estimate=calibration.scaled(pair.estimate))


def _given(calibration: MotionCalibration, rows: Rows) -> Mask:
    """Return at which rows the motion is like that of calibrated drives."""
    ends = np.arange(len(rows.part))
    novelty = calibration.familiar.novelty(rows, ends)
    running = Running(calibration.limits.period_s).all(novelty, rows.part)
    limit = calibration.familiar.limit
    return np.array([value is None or value <= limit for value in running])


def _known(calibration: MotionCalibration, rows: Rows) -> bool:
    """Whether a recording is, by its time and path, one of those that were calibrated on."""
    seconds, metres = 1e-9 * float(rows.stamps_ns[-1] - rows.stamps_ns[0]), float(rows.path_m[-1])
    return any(
        abs(each.seconds - seconds) <= 1e-3 * seconds and abs(each.metres - metres) <= 1e-3 * metres
        for each in calibration.file.recordings
    )


def _window(window: MotionWindow, rows: Rows, truth: Array, level: Level) -> WindowAudit:
    errors = window_errors(rows, truth, window.window)
    if not len(errors.anchor):
        return WindowAudit(window.spec.window, 0, 0.0, 0.0, 0.0)
    inside = window.scored(errors, level)
    position, rotation, six = inside.mean(axis=0).tolist()
    return WindowAudit(window.spec.window, len(inside), position, rotation, six)


def _integrated(
    calibration: MotionCalibration, rows: Rows, truth: Array, ends: Integers
) -> Iterator[NeesAudit]:
    """Yield the NEES of sums of steps; ``ends``: rows at which a step's covariance is stated."""
    factors = calibration.file.integrated
    if factors is None:
        return
    found = calibration.horizons[calibration.steps].intervals(rows, Level(), ends)
    scales = np.ones((len(rows.part), 6))
    scales[found.end] = found.scale[:, :6]
    # No sum goes over a step without a covariance.
    unknown = np.ones(len(rows.part), np.int64)
    unknown[found.end] = 0
    whole = rows._replace(part=rows.part + np.cumsum(unknown))
    apart = max(1, len(rows.part) // _MOST_ANCHORS)
    for span_s, sums in zip(SPANS_S, sums_of(whole, truth, scales, SPANS_S, apart), strict=True):
        if len(sums.residuals):
            found_nees = nees(sums.residuals, sums.covariance(np.array(factors)))
            yield NeesAudit(span_s, len(found_nees), *_nees(found_nees))


def _nees(values: Array) -> tuple[float, float]:
    return float(values.mean()) / 6.0, float((values <= CHI_SQUARE).mean())


def _pointed_horizon(horizon: MotionHorizon, found: Intervals, truth: Array) -> HorizonAudit:
    """Return the figures of an estimator without a scale."""
    true = motion(truth[found.start], truth[found.end])
    off = residual(found.moved, true)[:, 3:]
    known = np.isfinite(off).all(axis=1)
    off, angle = off[known], angles(found.moved, true)[known]
    lower, upper, radii = found.lower[known, 3:], found.upper[known, 3:], found.radii[known]
    inside = (lower <= off) & (off <= upper)
    pointed = np.isfinite(angle)
    turned = np.linalg.norm(off - found.bias[known, 3:], axis=1)
    return HorizonAudit(
        horizon.spec.horizon,
        len(off),
        tuple(_means(inside, 3)),
        _means(np.atleast_2d(inside.all(axis=1)).T, 1)[0],
        _means((angle <= radii[:, 0])[pointed, np.newaxis], 1)[0],
        _means((turned <= radii[:, 1])[:, np.newaxis], 1)[0],
        tuple(_means(0.5 * (upper - lower), 3)),
        (_means(radii[pointed, :1], 1)[0], _means(radii[:, 1:], 1)[0]),
        0.0,
        0.0,
        int(pointed.sum()),
    )


def _means(values: NDArray[Any], columns: int) -> list[float]:
    """Return the means over rows; zeros without any."""
    means: list[float] = (values.mean(axis=0) if len(values) else np.zeros(columns)).tolist()
    return means


def _horizon(horizon: MotionHorizon, found: Intervals, truth: Array) -> HorizonAudit:
    name = horizon.spec.horizon
    off = residual(found.moved, motion(truth[found.start], truth[found.end]))
    known = np.isfinite(off).all(axis=1)
    if not known.any():
        return HorizonAudit(name, 0, (0.0,) * 6, 0.0, 0.0, 0.0, (0.0,) * 6, (0.0, 0.0), 0.0, 0.0)
    off, lower, upper = off[known], found.lower[known], found.upper[known]
    inside = (lower <= off) & (off <= upper)
    position, rotation = (norms(off - found.bias[known]) <= found.radii[known]).mean(axis=0)
    half = 0.5 * (upper - lower).mean(axis=0)
    radii = found.radii[known].mean(axis=0)
    return HorizonAudit(
        name,
        len(off),
        tuple(inside.mean(axis=0).tolist()),
        float(inside.all(axis=1).mean()),
        float(position),
        float(rotation),
        tuple(half.tolist()),
        (float(radii[0]), float(radii[1])),
        *_nees(nees(off, horizon.shape.covariance(found.scale[known], found.bias[known]))),
    )
