"""From the thresholds of ``motion.json`` to intervals on motions."""

from __future__ import annotations

import os
from numbers import Real
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cvo_edge.documents import shown
from cvo_edge.errors import UsageError
from cvo_edge.given import given_path
from cvo_edge.motion.covariance import FLOOR, SPANS_S, Shape
from cvo_edge.motion.drift import Familiar
from cvo_edge.motion.errors import motions
from cvo_edge.motion.fitting import ERRORS, Scale, predicted_bias, predicted_scale
from cvo_edge.motion.format import (
    COLUMNS,
    LEVELS,
    HorizonSpec,
    MotionFile,
    ScaleSpec,
    WindowSpec,
    read_motion_file,
    symmetric,
)
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.rate import periods_s
from cvo_edge.motion.trace import Limits, Rows, motion_numbers, scale_numbers, tube_numbers
from cvo_edge.motion.windows import Window, raised, window_scores, with_six
from cvo_edge.vocabulary import MOTION_RULES, SCOPES, MotionRule, Scope

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Measure = TypeVar("Measure")

# A robot at another rate needs a calibration of its own for horizons in frames.
SAME_RATE = 0.2
_SAME_LEVEL = 1e-6


class Intervals(NamedTuple):
    """Motions over one horizon and their intervals; m motions.

    Attributes
    ----------
    start, end
        Shape (m,): rows of the poses.
    moved
        Shape (m, 7): the estimated motions dE.
    bias, scale
        Shape (m, 6) and (m, 8): see ``fitting``.
    lower, upper
        Shape (m, 6): of x in dG = dE Exp(x), m and rad; infinite where unbounded.
    radii
        Shape (m, 2): of a ball around the bias that holds the position error (m), and of one that
        holds the rotation error (rad).
    """

    start: Integers
    end: Integers
    moved: Array
    bias: Array
    scale: Array
    lower: Array
    upper: Array
    radii: Array


class Level(NamedTuple):
    """What intervals are stated with."""

    confidence: float = 0.9
    rule: MotionRule = "mean"
    scope: Scope = "marginal"


class MotionHorizon:
    """One calibrated horizon.

    Attributes
    ----------
    spec, horizon
        What the file says, and how far back motions reach.
    bias, scale
        Coefficients as ``fitting.predicted_bias`` and ``predicted_scale`` take them, or None.
    shape
        Of the covariance ``interval``.
    """

    def __init__(self, spec: HorizonSpec) -> None:
        self.spec = spec
        self.horizon = Horizon.parse(spec.horizon)
        self.bias = None if spec.bias is None else np.array(spec.bias)[..., np.newaxis]
        self.scale = None if spec.scale is None else _scale(spec.scale)
        self._joint = np.array(spec.joint)
        self.shape = Shape(symmetric(spec.shape))
        self._thresholds = {
            (each.rule, each.confidence): np.array([np.inf if q is None else q for q in each.q])
            for each in spec.thresholds
        }

    def thresholds(self, level: Level) -> Array:
        """Return the thresholds (8,) of the six degrees of freedom, of position and of rotation.

        In the joint scope, those of the degrees of freedom hold all at once.
        """
        q = self._thresholds[level.rule, level.confidence]
        if level.scope == "joint":
            return np.concatenate([q[COLUMNS.index("joint")] * self._joint, q[6:ERRORS]])
        return q[:ERRORS]

    def step_scales(self, rows: Rows) -> Array:
        """Return the scales (n, 6) of the motions that end at each row.

        Rows at which none ends get the median.
        """
        found = self.intervals(rows, Level())
        usual = np.median(found.scale[:, :6], axis=0) if len(found.end) else np.ones(6)
        scales = np.tile(usual, (len(rows.part), 1))
        scales[found.end] = found.scale[:, :6]
        return scales

    def intervals(self, rows: Rows, level: Level, ends: Integers | None = None) -> Intervals:
        """Return the intervals of all motions over this horizon, or of those with these ends."""
        start, end, recent = motions(rows, self.horizon, ends)
        moved, numbers = motion_numbers(rows, start, end)
        bias = np.zeros((6, len(end)))
        if self.bias is not None:
            bias = predicted_bias(self.bias, numbers.T)
        scale = np.ones((ERRORS, len(end)))
        if self.scale is not None:
            sizes = scale_numbers(rows, start, end, recent)
            scale = predicted_scale(self.scale, sizes.T)
        widths = scale * self.thresholds(level)[:, np.newaxis]
        half = widths[:6]
        lower, upper = bias - half, bias + half
        return Intervals(start, end, moved, bias.T, scale.T, lower.T, upper.T, widths[6:].T)


class MotionWindow:
    """The tube of one calibrated window."""

    def __init__(self, spec: WindowSpec) -> None:
        self.spec = spec
        self.window = Horizon.parse(spec.window)
        self._scale = _scale(spec.scale)
        self._unit = np.array(spec.unit)
        self._thresholds = {
            (each.rule, each.confidence): np.array([np.inf if q is None else q for q in each.q])
            for each in spec.thresholds
        }

    def thresholds(self, level: Level) -> Array:
        """Return the thresholds (8,) of the six degrees of freedom, all at once, and of the norms.

        They are the same in both scopes.
        """
        position, rotation, six = self._thresholds[level.rule, level.confidence]
        return np.concatenate([six * self._unit, [position, rotation]])

    def scored(self, window: Window, level: Level) -> Mask:
        """Return whether all of each window is inside, (anchors, 3).

        The columns are position, rotation, and all six degrees of freedom at once.
        """
        scores = window_scores(window, self._scales(window.along, window.numbers).T)
        q = self._thresholds[level.rule, level.confidence]
        return np.asarray(with_six(scores, self._unit) <= q)

    def end_radii(self, level: Level) -> Array:
        """Return the usual radii (2,) at the end of the window."""
        return np.asarray(self.thresholds(level)[6:] * np.array(self.spec.usual)[6:])

    def tube(self, rows: Rows, anchor: Integers, ends: Integers, level: Level) -> Array:
        """Return the half-widths and the two radii (8, m) at rows ``ends`` (m,), m and rad.

        They are infinite beyond the window and over a break since ``anchor`` (m,).
        """
        frames = ends - anchor
        seconds = 1e-9 * (rows.stamps_ns[ends] - rows.stamps_ns[anchor])
        metres = rows.path_m[ends] - rows.path_m[anchor]
        since = np.asarray(self.since(frames, seconds, metres), np.float64)
        tube = self.after(since, tube_numbers(rows, anchor, ends), level)
        # At the anchor itself, nothing has moved yet.
        tube[:, frames == 0] = 0.0
        return np.where(rows.part[anchor] == rows.part[ends], tube, np.inf)

    def since(self, frames: Measure, seconds: Measure, metres: Measure) -> Measure:
        """Return what the window is measured along."""
        if self.window.unit == "f":
            return frames
        return seconds if self.window.unit == "s" else metres

    def after(self, since: Array, numbers: Array, level: Level) -> Array:
        """Return the same (8, m) so far (m,) after an anchor, with ``tube_numbers`` (k, m)."""
        tube = self._scales(since, numbers) * self.thresholds(level)[:, np.newaxis]
        return np.where(since <= self.window.value, tube, np.inf)

    def _scales(self, along: Array, numbers: Array) -> Array:
        return predicted_scale(self._scale, numbers) * raised(self.window, along)


def _scale(spec: ScaleSpec) -> Scale:
    """Return coefficients and ranges as ``fitting.predicted_scale`` takes them."""
    fields = spec.coefficients, spec.lowest, spec.highest
    return Scale(*(np.array(each)[..., np.newaxis] for each in fields))


class MotionCalibration:
    """The calibration of an estimator, from ``motion.json``.

    Attributes
    ----------
    file
        The contents of the file.
    limits
        What breaks a trajectory.
    horizons, windows
        The calibrated horizons and windows, in the order of the file.
    """

    def __init__(self, file: MotionFile) -> None:
        self.file = file
        self.limits = Limits(
            file.limits.period_s, file.limits.gap_s, file.limits.speed, file.limits.turn
        )
        self.horizons = tuple(map(MotionHorizon, file.horizons))
        self.windows = tuple(map(MotionWindow, file.windows))
        known = file.familiar
        self.familiar = Familiar(np.array(known.mean), np.array(known.spread), known.limit)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> MotionCalibration:
        """Read a file; raises CalibrationFileError."""
        return cls(read_motion_file(given_path(path, "calibration")))

    def level(
        self, confidence: float = 0.9, rule: MotionRule = "mean", scope: Scope = "marginal"
    ) -> Level:
        """Return a level of the file; raises UsageError for others."""
        stored = None
        if isinstance(confidence, Real) and not isinstance(confidence, bool):
            # Of float32, 0.9 is 0.8999999761581421.
            stored = next((each for each in LEVELS if abs(each - confidence) < _SAME_LEVEL), None)
        if stored is None:
            raise UsageError(
                f"confidence: expected one of {', '.join(f'{c:g}' for c in LEVELS)}, found "
                f"{shown(confidence)}"
            )
        for name, value, known in (("rule", rule, MOTION_RULES), ("scope", scope, SCOPES)):
            if value not in known:
                raise UsageError(
                    f"{name}: expected one of {', '.join(known)}, found {shown(value)}"
                )
        return Level(stored, rule, scope)

    def scaled(self, poses: Array) -> Array:
        """Return poses (n, 7) with the correction of the scale."""
        if self.file.correction.scale is None:
            return poses
        return np.concatenate([self.file.correction.scale * poses[:, :3], poses[:, 3:]], axis=1)

    def check_covariance(self, covariance: str | None) -> None:
        """Raise UsageError for a covariance of an estimator without a scale."""
        if covariance is not None and self.pointed:
            raise UsageError(
                "covariance: expected a calibration in metres, found one of an estimator without "
                "a scale"
            )

    @property
    def pointed(self) -> bool:
        """Whether the estimator has no scale, see ``direction``."""
        return self.file.translation == "direction"

    @property
    def steps(self) -> int:
        """The place of the horizon that covariances ``integrated`` need.

        Raises UsageError if the calibration has none.
        """
        names = [each.spec.horizon for each in self.horizons]
        if self.file.integrated is None or "1f" not in names:
            raise UsageError(
                "covariance: expected a calibration with the horizon 1f on drives of more than "
                f"{SPANS_S[-1]:g} s for integrated, found none; use interval"
            )
        return names.index("1f")

    def step_covariances(self, scales: Array) -> Array:
        """Return the covariances ``integrated`` (m, 6, 6) of steps with scales (m, 6).

        They are in the body frame at the end of the step.
        """
        diagonal = np.array(self.file.integrated) * scales**2
        return np.asarray(diagonal[:, :, np.newaxis] * np.eye(6) + FLOOR)

    def same_rate(self, period_s: float) -> bool:
        """Whether poses come at the calibration's rate, which horizons in frames rely on."""
        return abs(period_s / self.limits.period_s - 1.0) <= SAME_RATE

    def other_rate(self, stamps_ns: Integers) -> Mask:
        """Return at which poses (n,) the rate is another one."""
        off = np.abs(periods_s(stamps_ns) / self.limits.period_s - 1.0)
        return np.concatenate([[False], off > SAME_RATE])

    def statement(self, level: Level) -> str:
        """Return in one sentence what intervals at a level promise."""
        stated = self._of_motions(level)
        if self.pointed:
            return f"{stated}; directions count where there is one"
        return stated

    def _of_motions(self, level: Level) -> str:
        percent, groups = f"{100.0 * level.confidence:g} %", self.file.groups
        missed = f"{100.0 * (1.0 - level.confidence):.3g} %"
        if level.rule == "tolerance":
            return (
                f"with probability {groups / (groups + 1):.2f}, at least {percent} of the motions "
                f"of the next drive like the {groups} calibrated ones are inside"
            )
        if level.rule == "mean":
            return (
                f"on average over drives like the {groups} calibrated ones, {percent} of "
                "motions are inside; a single drive may be far off"
            )
        counted = ", where one that misses more than half counts as half"
        return (
            f"over new drives like the {groups} calibrated ones, on average at most {missed} "
            f"of motions are missed{counted if level.rule == 'capped' else ''}"
        )
