"""Learn from pairs of an estimate and a truth what intervals on an estimator's motion hold it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import UsageError
from cvo_edge.motion.covariance import (
    MOST_ANCHORS,
    SPANS_S,
    Sums,
    fit_factors,
    fit_shape,
    sums_of,
)
from cvo_edge.motion.direction import COLUMN as DIRECTION
from cvo_edge.motion.direction import (
    angles,
    check_same,
    check_without_metres,
    directions,
    fit_direction,
    rotations,
)
from cvo_edge.motion.drift import fit_familiar
from cvo_edge.motion.errors import Errors, errors_of
from cvo_edge.motion.format import (
    LEVELS,
    CorrectionSpec,
    FamiliarSpec,
    HorizonSpec,
    LimitsSpec,
    MotionFile,
    RecordingSpec,
    ThresholdSpec,
    TubeThresholdSpec,
    WindowSpec,
)
from cvo_edge.motion.horizon_fit import Fit, fit_horizon
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.intervals import MotionHorizon
from cvo_edge.motion.pairs import Pair
from cvo_edge.motion.recordings import (
    About,
    Recording,
    Size,
    about,
    extent,
    limits_of,
    longest_part,
    recording_of,
    size_of,
)
from cvo_edge.motion.rounding import (
    EXACT,
    coefficients_of,
    numbers_of,
    rounded,
    scale_of,
    thresholds_of,
)
from cvo_edge.motion.thresholds import Scores
from cvo_edge.motion.tube_fit import fit_tube
from cvo_edge.motion.windows import ANCHORS, Window, anchors_of, window_errors
from cvo_edge.spread import Spread
from cvo_edge.vocabulary import MOTION_RULES

Array = NDArray[np.float64]

DEFAULT_HORIZONS = tuple(map(Horizon.parse, ("1f", "1s", "5s", "10m", "100m")))
DEFAULT_WINDOWS = tuple(map(Horizon.parse, ("10s", "100m")))
# A recording with fewer motions over a horizon is left out there.
_LEAST_MOTIONS = 20
# Bias and scale have some twenty numbers each. So many motions that do not overlap fix them.
_LEAST_APART = 200
# The scale of a tube has seven.
_LEAST_WINDOWS = 100
# Anchors of a window's tube, of all recordings, and the least number for each window's length.
_MOST_ANCHORS, _LEAST_ANCHORS = 20_000, 4
_JOINT_LEVEL = 0.9
_MOST_RECORDINGS = 100


def conformalize(
    pairs: Spread[Pair],
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
        Recordings of two or more groups, corrected if they are to be; ``spread.Here(list)``, or
        on a cluster, which gives the same file.
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
    known = pairs.map(about).collect()
    pointed = known[0].unscaled
    for each in known:
        check_same(each.name, each.unscaled, pointed)
    defaults, tubes_wanted = DEFAULT_HORIZONS, DEFAULT_WINDOWS if windows is None else windows
    if pointed:
        check_without_metres(horizons, windows)
        defaults = tuple(each for each in defaults if each.unit != "m")
        tubes_wanted = ()
    # The order of recordings must not change the file: sums of floats depend on it.
    order = sorted(range(len(known)), key=lambda place: (known[place].group, known[place].name))
    known, pairs = [known[place] for place in order], pairs.take(order)
    groups = [each.group for each in known]
    drives = len(set(groups))
    if drives < 2:
        raise UsageError(
            f"conformalize: expected recordings of at least two drives, found {drives}; the "
            "errors of one drive say nothing about the next"
        )
    for each in known:
        if missing := [column for column in columns if column not in each.columns]:
            raise UsageError(
                f"{each.name}: expected the column {missing[0]}, found "
                f"{', '.join(each.columns) or 'none besides the pose'}"
            )
    limits = limits_of(known)
    recordings = pairs.map(partial(recording_of, limits=limits, columns=tuple(columns)))
    del pairs
    sizes = recordings.map(size_of).collect()
    specs = [
        found
        for horizon in (defaults if horizons is None else horizons)
        if (
            found := _horizon(
                horizon, recordings, groups, learned, needed=horizons is not None, pointed=pointed
            )
        )
    ]
    tubes = [
        tube
        for window in tubes_wanted
        if (tube := _window(window, recordings, groups, learned, needed=windows is not None))
    ]
    if not specs:
        raise UsageError(
            "conformalize: expected recordings that are long enough for a horizon of "
            f"{', '.join(map(str, defaults))}, found none; name shorter ones"
        )
    return MotionFile(
        name=name,
        translation="direction" if pointed else "metres",
        limits=LimitsSpec(
            period_s=limits.period_s, gap_s=limits.gap_s, speed=limits.speed, turn=limits.turn
        ),
        correction=correction or CorrectionSpec(offset_s=None, q_xyzw=None, scale=None),
        columns=tuple(columns),
        groups=drives,
        recordings=tuple(map(_recording, known[:_MOST_RECORDINGS], sizes)),
        familiar=_familiar(recordings, limits.period_s),
        integrated=None
        if pointed
        else _integrated(specs, recordings, groups, sum(size.rows for size in sizes)),
        horizons=tuple(specs),
        windows=tuple(tubes),
    )


def _enough(used: Sequence[str], groups: Sequence[str], *, needed: bool) -> bool:
    """Whether two drives are long enough for a horizon and, unless it is needed, half of all."""
    own, every = set(used), set(groups)
    return len(own) > 1 and (needed or 2 * len(own) >= len(every))


def _too_short(what: str, horizon: Horizon, recordings: Spread[Recording]) -> UsageError:
    found = recordings.map(partial(longest_part, horizon=horizon)).collect()
    longest = max(length for length, _ in found)
    step = float(np.median(np.concatenate([steps for _, steps in found])))
    return UsageError(
        f"{what} {horizon}: expected at least two drives with {_LEAST_MOTIONS} motions over it "
        "whose truth is known, found fewer; the longest part between gaps, jumps and lost poses is "
        f"{longest:.4g}{horizon.unit}, poses are {step:.3g}{horizon.unit} apart"
    )


def _horizon(
    horizon: Horizon,
    recordings: Spread[Recording],
    groups: Sequence[str],
    learned: bool,
    *,
    needed: bool,
    pointed: bool,
) -> HorizonSpec | None:
    """Calibrate a horizon; without enough drives for it, return None or, if needed, raise."""
    # Only one horizon's errors are kept at a time.
    translation = angles if pointed else None
    own_errors = partial(_errors, horizon=horizon, translation=translation)
    measured = recordings.map(own_errors, what=f"horizon {horizon}")
    lengths = recordings.map(partial(extent, horizon=horizon)).collect()
    counts = measured.map(_motions, what=f"horizon {horizon}").collect()
    used = [index for index, count in enumerate(counts) if count >= _LEAST_MOTIONS]
    own = [groups[index] for index in used]
    if not _enough(own, groups, needed=needed):
        if needed:
            raise _too_short("horizon", horizon, recordings)
        return None
    errors = measured.take(used)
    apart = sum(lengths[index] for index in used) / horizon.value
    learned = learned and apart >= _LEAST_APART
    both, errors = errors, errors.map(rotations) if pointed else errors
    crossed = fit_horizon(errors, own, learned)
    scores = Scores(crossed.scaled.map(_scores).collect(), own).table(MOTION_RULES, LEVELS)
    unit = scores[MOTION_RULES.index("mean"), LEVELS.index(_JOINT_LEVEL), :6]
    unit = np.maximum(unit, 1e-9)
    joint = Scores(crossed.scaled.map(partial(_joint, unit=unit)).collect(), own)
    q = np.concatenate([scores, joint.table(MOTION_RULES, LEVELS)], axis=2)
    fit = crossed.fit
    shape = fit_shape(crossed.scaled.map(_residuals), own).matrix
    usual = np.mean(errors.map(partial(_usual, fit=fit)).collect(), axis=0)
    if pointed:
        fit, usual[DIRECTION], q[:, :, DIRECTION] = fit_direction(
            both.map(directions),
            own,
            fit,
            MOTION_RULES,
            LEVELS,
            learned=learned,
            least=_LEAST_MOTIONS,
        )
        q[:, :, :3] = np.inf
    bias, scale = fit
    return HorizonSpec(
        horizon=str(horizon),
        recordings=len(set(own)),
        motions=sum(counts[index] for index in used),
        bias=None if bias is None else coefficients_of(bias),
        scale=None if scale is None else scale_of(scale),
        joint=numbers_of(unit),
        # Rounded, a nearly singular matrix might no longer be positive definite.
        shape=tuple(rounded(value, EXACT) for value in shape[np.tril_indices(6)].tolist()),
        usual=numbers_of(usual),
        thresholds=tuple(
            ThresholdSpec(rule=rule, confidence=level, q=thresholds_of(each))
            for rule, row in zip(MOTION_RULES, q, strict=True)
            for level, each in zip(LEVELS, row, strict=True)
        ),
    )


def _errors(
    recording: Recording,
    horizon: Horizon,
    translation: Callable[[Array, Array], Array] | None,
) -> Errors:
    return errors_of(*recording, horizon, translation)


def _motions(errors: Errors) -> int:
    return len(errors.end)


def _residuals(scaled: tuple[Array, Array]) -> Array:
    return scaled[0]


def _scores(scaled: tuple[Array, Array]) -> Array:
    return scaled[1]


def _joint(scaled: tuple[Array, Array], unit: Array) -> Array:
    """Return the scores (m, 1) of all six degrees of freedom at once."""
    return np.asarray((scaled[1][:, :6] / unit).max(axis=1, keepdims=True))


def _usual(errors: Errors, fit: Fit) -> Array:
    return np.asarray(fit.scales(errors).mean(axis=0))


def _familiar(recordings: Spread[Recording], period_s: float) -> FamiliarSpec:
    found = fit_familiar(recordings, period_s)
    # Rounded numbers give slightly other values: the limit must not exclude the drive behind it.
    return FamiliarSpec(
        mean=numbers_of(found.mean),
        spread=numbers_of(found.spread),
        limit=rounded(1.01 * found.limit + 1e-6),
    )


def _integrated(
    specs: Sequence[HorizonSpec],
    recordings: Spread[Recording],
    groups: Sequence[str],
    poses: int,
) -> tuple[float, float, float, float, float, float] | None:
    """Return the factors of the integrated covariance; None without single steps or 10 s."""
    steps = next((MotionHorizon(spec) for spec in specs if spec.horizon == "1f"), None)
    if steps is None:
        return None
    own = partial(_sums, steps=steps, apart=max(1, poses // MOST_ANCHORS))
    sums = recordings.map(own, what="covariance").collect()
    used = [index for index, each in enumerate(sums) if all(len(one.residuals) for one in each)]
    if len({groups[index] for index in used}) < 2:
        return None
    a, b, c, d, e, f = numbers_of(
        fit_factors([sums[index] for index in used], [groups[index] for index in used])
    )
    return a, b, c, d, e, f


def _sums(recording: Recording, steps: MotionHorizon, apart: int) -> list[Sums]:
    rows, truth = recording
    return sums_of(rows, truth, steps.step_scales(rows), SPANS_S, apart)


def _window(
    window: Horizon,
    recordings: Spread[Recording],
    groups: Sequence[str],
    learned: bool,
    *,
    needed: bool,
) -> WindowSpec | None:
    """Calibrate a window; without enough drives for it, return None or, if needed, raise."""
    lengths = recordings.map(partial(extent, horizon=window)).collect()
    # Windows overlap, and hold as many numbers as all horizons together: of a thousand drives,
    # fewer anchors say as much.
    wanted = round(_MOST_ANCHORS * window.value / max(sum(lengths), window.value))
    wanted = min(ANCHORS, max(_LEAST_ANCHORS, wanted))
    measured = partial(_window_errors, window=window, anchors=wanted)
    every = recordings.map(measured, what=f"window {window}")
    anchors = every.map(anchors_of, what=f"window {window}").collect()
    used = [index for index, count in enumerate(anchors) if count]
    own = [groups[index] for index in used]
    if not _enough(own, groups, needed=needed):
        if needed:
            raise _too_short("window", window, recordings)
        return None
    apart = sum(lengths[index] for index in used) / window.value
    tube = fit_tube(window, every.take(used), own, learned and apart >= _LEAST_WINDOWS)
    table = Scores(tube.scores, own).table(MOTION_RULES, LEVELS)
    return WindowSpec(
        window=str(window),
        recordings=len(set(own)),
        anchors=sum(anchors),
        scale=scale_of(tube.scale),
        unit=numbers_of(tube.unit),
        usual=numbers_of(tube.usual),
        thresholds=tuple(
            TubeThresholdSpec(rule=rule, confidence=level, q=(position, rotation, six))
            for rule, row in zip(MOTION_RULES, table, strict=True)
            for level, each in zip(LEVELS, row, strict=True)
            for position, rotation, six in [thresholds_of(each)]
        ),
    )


def _window_errors(recording: Recording, window: Horizon, anchors: int) -> Window:
    return window_errors(*recording, window, anchors)


def _recording(pair: About, size: Size) -> RecordingSpec:
    return RecordingSpec(
        name=pair.name,
        group=pair.group,
        poses=size.poses,
        seconds=rounded(size.seconds),
        metres=rounded(size.metres),
    )
