"""Learn from pairs of an estimate and a truth what intervals on an estimator's motion hold it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import UsageError
from cvo_edge.motion.covariance import MOST_ANCHORS, SPANS_S, fit_factors, fit_shape, sums_of
from cvo_edge.motion.drift import fit_familiar
from cvo_edge.motion.errors import errors_of
from cvo_edge.motion.format import (
    LEVELS,
    CorrectionSpec,
    FamiliarSpec,
    HorizonSpec,
    LimitsSpec,
    MotionFile,
    RecordingSpec,
    ScaleSpec,
    ThresholdSpec,
    TubeThresholdSpec,
    WindowSpec,
)
from cvo_edge.motion.horizon_fit import fit_horizon
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.intervals import MotionHorizon
from cvo_edge.motion.pairs import Pair
from cvo_edge.motion.relative import motion, norms, residual
from cvo_edge.motion.thresholds import Scores
from cvo_edge.motion.trace import Limits, Rows, rows_of
from cvo_edge.motion.windows import knots_of, profile_of, window_errors, window_scores
from cvo_edge.vocabulary import MOTION_RULES

Array = NDArray[np.float64]

DEFAULT_HORIZONS = tuple(map(Horizon.parse, ("1f", "1s", "5s", "10m", "100m")))
DEFAULT_WINDOWS = tuple(map(Horizon.parse, ("10s", "100m")))
# A recording with fewer motions over a horizon is left out there.
_LEAST_MOTIONS = 20
# Bias and scale have some twenty numbers each. So many motions that do not overlap fix them.
_LEAST_APART = 200
_JOINT_LEVEL = 0.9
_MOST_RECORDINGS = 100
# Significant digits of coefficients and thresholds: nine horizons have to fit into 64 KiB.
_COARSE, _FINE, _EXACT = 4, 5, 9
# Limits, as multiples of what was found in the recordings.
_GAP, _FAST, _SLACK_MPS, _SLACK_RADPS = 3.0, 3.0, 1.0, 0.5
_NEARLY_ALL = 0.999


def conformalize(
    pairs: Sequence[Pair],
    name: str,
    horizons: Sequence[Horizon] | None = None,
    windows: Sequence[Horizon] | None = None,
    *,
    learned: bool = True,
    columns: Sequence[str] = (),
    correction: CorrectionSpec | None = None,
) -> MotionFile:
    """Calibrate an estimator.

    Parameters
    ----------
    pairs
        Recordings of two or more groups, corrected if they are to be.
    name
        Estimator and vehicle.
    horizons, windows
        What to calibrate; None: those of the defaults that half of the drives are long enough for.
    learned
        Whether bias and scale are learned, where they pay; else scores are plain errors.
    columns
        Names of columns of the estimates' files that the scale uses.
    correction
        What was corrected.

    Raises
    ------
    UsageError
        There are fewer than two groups, a recording lacks a column, or no two groups are long
        enough for a horizon or a window.
    """
    groups = sorted({pair.group for pair in pairs})
    if len(groups) < 2:
        raise UsageError(
            f"conformalize: expected recordings of at least two drives, found {len(groups)}; the "
            "errors of one drive say nothing about the next"
        )
    for pair in pairs:
        if missing := [column for column in columns if column not in pair.columns]:
            raise UsageError(
                f"{pair.name}: expected the column {missing[0]}, found "
                f"{', '.join(pair.columns) or 'none besides the pose'}"
            )
    limits = limits_of(pairs)
    # The order of recordings must not change the file: sums of floats depend on it.
    ordered = sorted(pairs, key=lambda pair: (pair.group, pair.name))
    recordings = [
        _Recording(pair.group, trace_of(pair, limits, columns), pair.truth) for pair in ordered
    ]
    specs = [
        found
        for horizon in (DEFAULT_HORIZONS if horizons is None else horizons)
        if (found := _horizon(horizon, recordings, learned, needed=horizons is not None))
    ]
    tubes = [
        tube
        for window in (DEFAULT_WINDOWS if windows is None else windows)
        if (tube := _window(window, recordings, needed=windows is not None))
    ]
    if not specs:
        raise UsageError(
            "conformalize: expected recordings that are long enough for a horizon of "
            f"{', '.join(map(str, DEFAULT_HORIZONS))}, found none; name shorter ones"
        )
    return MotionFile(
        name=name,
        limits=LimitsSpec(
            period_s=limits.period_s, gap_s=limits.gap_s, speed=limits.speed, turn=limits.turn
        ),
        correction=correction or CorrectionSpec(offset_s=None, q_xyzw=None, scale=None),
        columns=tuple(columns),
        groups=len(groups),
        recordings=tuple(map(_recording, ordered[:_MOST_RECORDINGS], recordings)),
        familiar=_familiar(recordings, limits.period_s),
        integrated=_integrated(specs, recordings),
        horizons=tuple(specs),
        windows=tuple(tubes),
    )


class _Recording(NamedTuple):
    """A recording's group, rows and truth (n, 7)."""

    group: str
    rows: Rows
    truth: Array


def _enough(used: Sequence[_Recording], recordings: Sequence[_Recording], *, needed: bool) -> bool:
    """Whether two drives are long enough for a horizon and, unless it is needed, half of all."""
    own, every = ({each.group for each in some} for some in (used, recordings))
    return len(own) > 1 and (needed or 2 * len(own) >= len(every))


def _too_short(what: str, horizon: Horizon, recordings: Sequence[_Recording]) -> UsageError:
    longest = max(_longest_part(horizon, each.rows) for each in recordings)
    return UsageError(
        f"{what} {horizon}: expected at least two drives with {_LEAST_MOTIONS} motions over it "
        "whose truth is known, found fewer; the longest part between gaps, jumps and lost poses is "
        f"{longest:.4g}{horizon.unit}, poses are {_step(horizon, recordings):.3g}{horizon.unit} "
        "apart"
    )


def _longest_part(horizon: Horizon, rows: Rows) -> float:
    along = horizon.along(rows.stamps_ns, rows.path_m)
    begin = np.flatnonzero(np.diff(rows.part, prepend=-1))
    end = np.append(begin[1:], len(along)) - 1
    return float((along[end] - along[begin]).max())


def _step(horizon: Horizon, recordings: Sequence[_Recording]) -> float:
    steps = [np.diff(horizon.along(each.rows.stamps_ns, each.rows.path_m)) for each in recordings]
    return float(np.median(np.concatenate(steps)))


def limits_of(pairs: Sequence[Pair]) -> Limits:
    """Return what breaks trajectories like these: three times what the truth's motions reach."""
    periods, gaps, speeds, turns = [], [], [], []
    for pair in pairs:
        seconds = 1e-9 * np.diff(pair.stamps_ns)
        periods.append(np.median(seconds))
        gaps.append(np.quantile(seconds, _NEARLY_ALL))
        truth = pair.truth
        step = norms(residual(np.tile(_NOTHING, (len(seconds), 1)), motion(truth[:-1], truth[1:])))
        rates = step[np.isfinite(step).all(axis=1)] / np.median(seconds)
        speeds.append(np.quantile(rates[:, 0], _NEARLY_ALL))
        turns.append(np.quantile(rates[:, 1], _NEARLY_ALL))
    period_s = float(np.median(periods))
    gap_s = max(_GAP * period_s, 1.5 * min(float(np.max(gaps)), 10.0 * period_s))
    speed = _FAST * float(np.max(speeds)) + _SLACK_MPS
    turn = _FAST * float(np.max(turns)) + _SLACK_RADPS
    return Limits(*map(_rounded, (period_s, gap_s, speed, turn)))


_NOTHING = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def trace_of(pair: Pair, limits: Limits, columns: Sequence[str]) -> Rows:
    """Return the rows of a pair's estimate."""
    values = np.empty((len(pair.stamps_ns), len(columns)))
    for index, name in enumerate(columns):
        values[:, index] = pair.columns[name]
    return rows_of(pair.stamps_ns, pair.estimate, values, limits)


def _horizon(
    horizon: Horizon, recordings: Sequence[_Recording], learned: bool, *, needed: bool
) -> HorizonSpec | None:
    """Calibrate a horizon; without enough drives for it, return None or, if needed, raise."""
    found = [errors_of(each.rows, each.truth, horizon) for each in recordings]
    used = [index for index, each in enumerate(found) if len(each.end) >= _LEAST_MOTIONS]
    if not _enough([recordings[index] for index in used], recordings, needed=needed):
        if needed:
            raise _too_short("horizon", horizon, recordings)
        return None
    groups = [recordings[index].group for index in used]
    errors = [found[index] for index in used]
    apart = sum(_extent(horizon, recordings[index].rows) / horizon.value for index in used)
    crossed = fit_horizon(errors, groups, learned and apart >= _LEAST_APART)
    unit = Scores([each[:, :6] for each in crossed.scores], groups).thresholds("mean", _JOINT_LEVEL)
    unit = np.maximum(unit, 1e-9)
    scores = Scores([_with_joint(each, unit) for each in crossed.scores], groups)
    bias, scale = crossed.fit
    shape = fit_shape(crossed.scaled, groups).matrix
    return HorizonSpec(
        horizon=str(horizon),
        recordings=len(set(groups)),
        motions=sum(len(each.end) for each in errors),
        bias=None if bias is None else tuple(map(_numbers, bias)),
        scale=None
        if scale is None
        else ScaleSpec(
            coefficients=tuple(map(_numbers, scale.coefficients)),
            lowest=_numbers(scale.lowest),
            highest=_numbers(scale.highest),
        ),
        joint=_numbers(unit),
        # Rounded, a nearly singular matrix might no longer be positive definite.
        shape=tuple(_rounded(value, _EXACT) for value in shape[np.tril_indices(6)].tolist()),
        usual=_numbers(np.mean([crossed.fit.scales(each).mean(axis=0) for each in errors], axis=0)),
        thresholds=tuple(
            ThresholdSpec(
                rule=rule, confidence=level, q=_thresholds(scores.thresholds(rule, level))
            )
            for rule in MOTION_RULES
            for level in LEVELS
        ),
    )


def _familiar(recordings: Sequence[_Recording], period_s: float) -> FamiliarSpec:
    found = fit_familiar([each.rows for each in recordings], period_s)
    # Rounded numbers give slightly other values: the limit must not exclude the drive behind it.
    return FamiliarSpec(
        mean=_numbers(found.mean),
        spread=_numbers(found.spread),
        limit=_rounded(1.01 * found.limit + 1e-6),
    )


def _integrated(
    specs: Sequence[HorizonSpec], recordings: Sequence[_Recording]
) -> tuple[float, float, float, float, float, float] | None:
    """Return the factors of the integrated covariance; None without single steps or 10 s."""
    steps = next((MotionHorizon(spec) for spec in specs if spec.horizon == "1f"), None)
    if steps is None:
        return None
    apart = max(1, sum(len(each.rows.part) for each in recordings) // MOST_ANCHORS)
    sums = [
        sums_of(each.rows, each.truth, steps.step_scales(each.rows), SPANS_S, apart)
        for each in recordings
    ]
    groups = [each.group for each in recordings]
    used = [index for index, each in enumerate(sums) if all(len(one.residuals) for one in each)]
    if len({groups[index] for index in used}) < 2:
        return None
    a, b, c, d, e, f = _numbers(
        fit_factors([sums[index] for index in used], [groups[index] for index in used])
    )
    return a, b, c, d, e, f


def _window(
    window: Horizon, recordings: Sequence[_Recording], *, needed: bool
) -> WindowSpec | None:
    """Calibrate a window; without enough drives for it, return None or, if needed, raise."""
    found = [(each, window_errors(each.rows, each.truth, window)) for each in recordings]
    used = [(each, errors) for each, errors in found if len(errors.anchor)]
    if not _enough([each for each, _ in used], recordings, needed=needed):
        if needed:
            raise _too_short("window", window, recordings)
        return None
    groups, errors = [each.group for each, _ in used], [each for _, each in used]
    knots, profile = knots_of(window), profile_of(window, errors, groups)
    # Scores are those of the profile that is stored.
    position, rotation = map(_numbers, profile.T)
    stored = np.array([position, rotation]).T
    scores = Scores([window_scores(each, knots, stored) for each in errors], groups)
    return WindowSpec(
        window=str(window),
        recordings=len(set(groups)),
        anchors=sum(int(each.anchor[-1]) + 1 for each in errors),
        position=position,
        rotation=rotation,
        thresholds=tuple(
            TubeThresholdSpec(rule=rule, confidence=level, q=(q[0], q[1]))
            for rule in MOTION_RULES
            for level in LEVELS
            for q in [_thresholds(scores.thresholds(rule, level))]
        ),
    )


def _with_joint(scores: Array, unit: Array) -> Array:
    joint = (scores[:, :6] / unit).max(axis=1, keepdims=True)
    return np.concatenate([scores, joint], axis=1)


def _extent(horizon: Horizon, rows: Rows) -> float:
    """Return how long a recording is, in the unit of a horizon."""
    along = horizon.along(rows.stamps_ns, rows.path_m)
    return float(along[-1] - along[0])


def _recording(pair: Pair, recording: _Recording) -> RecordingSpec:
    rows = recording.rows
    known = np.isfinite(np.concatenate([recording.truth, rows.poses], axis=1)).all(axis=1)
    return RecordingSpec(
        name=pair.name,
        group=pair.group,
        poses=int(known.sum()),
        seconds=_rounded(1e-9 * float(rows.stamps_ns[-1] - rows.stamps_ns[0])),
        metres=_rounded(float(rows.path_m[-1])),
    )


def _thresholds(values: Array) -> tuple[float | None, ...]:
    # Rounded up: rounding must not exclude a score.
    return tuple(
        _rounded(q * (1.0 + 10.0 ** (1 - _FINE)) + 1e-12, _FINE) if np.isfinite(q) else None
        for q in values.tolist()
    )


def _numbers(values: Array) -> tuple[float, ...]:
    return tuple(map(_rounded, values.tolist()))


def _rounded(value: float, digits: int = _COARSE) -> float:
    return float(f"{value:.{digits}g}")
