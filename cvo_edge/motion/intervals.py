"""From the thresholds of ``motion.json`` to intervals on motions."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.documents import shown
from cvo_edge.errors import UsageError
from cvo_edge.motion.covariance import SPANS_S, Shape
from cvo_edge.motion.drift import Familiar
from cvo_edge.motion.errors import motions
from cvo_edge.motion.fitting import ERRORS, Scale, predict_bias, predict_scale
from cvo_edge.motion.format import (
    COLUMNS,
    LEVELS,
    HorizonSpec,
    MotionFile,
    WindowSpec,
    read_motion_file,
    symmetric,
)
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.trace import Limits, Rows, motion_numbers, scale_numbers
from cvo_edge.motion.windows import Window, knots_of, radii, window_scores
from cvo_edge.vocabulary import MOTION_RULES, SCOPES, MotionRule, Scope

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# A robot at another rate needs a calibration of its own for horizons in frames.
SAME_RATE = 0.2


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
    """One calibrated horizon."""

    def __init__(self, spec: HorizonSpec) -> None:
        self.spec = spec
        self.horizon = Horizon.parse(spec.horizon)
        self._bias = None if spec.bias is None else np.array(spec.bias)
        self._scale = None
        if (scale := spec.scale) is not None:
            self._scale = Scale(
                np.array(scale.coefficients), np.array(scale.lowest), np.array(scale.highest)
            )
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

    def intervals(
        self,
        rows: Rows,
        level: Level,
        ends: Integers | None = None,
        factor: Array | None = None,
    ) -> Intervals:
        """Return the intervals of all motions over this horizon, or of those with these ends.

        ``factor`` (8,) is what labels have made of the thresholds.
        """
        start, end, recent = motions(rows, self.horizon, ends)
        moved, numbers = motion_numbers(rows, start, end)
        bias = np.zeros((len(end), 6))
        if self._bias is not None:
            bias = predict_bias(self._bias, numbers)
        scale = np.ones((len(end), ERRORS))
        if self._scale is not None:
            scale = predict_scale(self._scale, scale_numbers(rows, start, end, recent))
        widths = scale * self.thresholds(level)
        if factor is not None:
            widths *= factor
        half = widths[:, :6]
        return Intervals(start, end, moved, bias, scale, bias - half, bias + half, widths[:, 6:])


class MotionWindow:
    """The tube of one calibrated window."""

    def __init__(self, spec: WindowSpec) -> None:
        self.spec = spec
        self.window = Horizon.parse(spec.window)
        self._knots = knots_of(self.window)
        self._profile = np.array([spec.position, spec.rotation]).T
        self._thresholds = {
            (each.rule, each.confidence): np.array([np.inf if q is None else q for q in each.q])
            for each in spec.thresholds
        }

    def scored(self, window: Window, level: Level) -> Mask:
        """Return whether all of each window is inside, (anchors, 2)."""
        q = self._thresholds[level.rule, level.confidence]
        return np.asarray(window_scores(window, self._knots, self._profile) <= q)

    def mean_radii(self, level: Level) -> Array:
        """Return the mean radii (2,) over the window."""
        along = np.linspace(0.04, 1.0, 25) * self.window.value
        tube = radii(self._knots, self._profile, along).mean(axis=0)
        return np.asarray(self._thresholds[level.rule, level.confidence] * tube)

    def end_radii(self, level: Level) -> Array:
        """Return the radii (2,) at the end of the window."""
        return np.asarray(self._thresholds[level.rule, level.confidence] * self._profile[-1])

    def radii(self, rows: Rows, anchor: Integers, ends: Integers, level: Level) -> Array:
        """Return the radii (m, 2) at rows ``ends`` (m,) of position (m) and rotation (rad).

        They are infinite beyond the window, over a break, and where ``anchor`` (m,) is -1.
        """
        along = self.window.along(rows.stamps_ns, rows.path_m)
        since = along[ends] - along[anchor]
        reaches = (anchor >= 0) & (since <= self.window.value)
        reaches &= rows.part[anchor] == rows.part[ends]
        q = self._thresholds[level.rule, level.confidence]
        tube = q * radii(self._knots, self._profile, since)
        # At the anchor itself, nothing has moved yet.
        tube[ends == anchor] = 0.0
        return np.where(reaches[:, np.newaxis], tube, np.inf)


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
    def load(cls, path: str | Path) -> MotionCalibration:
        """Read a file; raises CalibrationFileError."""
        return cls(read_motion_file(Path(path)))

    def level(
        self, confidence: float = 0.9, rule: MotionRule = "mean", scope: Scope = "marginal"
    ) -> Level:
        """Return a level of the file; raises UsageError for others."""
        if isinstance(confidence, bool) or confidence not in LEVELS:
            raise UsageError(
                f"confidence: expected one of {', '.join(f'{c:g}' for c in LEVELS)}, found "
                f"{shown(confidence)}"
            )
        for name, value, known in (("rule", rule, MOTION_RULES), ("scope", scope, SCOPES)):
            if value not in known:
                raise UsageError(
                    f"{name}: expected one of {', '.join(known)}, found {shown(value)}"
                )
        return Level(float(confidence), rule, scope)

    def scaled(self, poses: Array) -> Array:
        """Return poses (n, 7) with the correction of the scale."""
        if self.file.correction.scale is None:
            return poses
        return np.concatenate([self.file.correction.scale * poses[:, :3], poses[:, 3:]], axis=1)

    def step_covariances(self, rows: Rows, ends: Integers) -> Array:
        """Return the integrated covariance (m, 6, 6) of the steps that end at rows (m,).

        It is in the body frame at the end of the step; NaN where no step ends. Raises UsageError if
        the calibration has none.
        """
        factors = self.file.integrated
        steps = next((each for each in self.horizons if each.spec.horizon == "1f"), None)
        if factors is None or steps is None:
            raise UsageError(
                "covariance: expected a calibration with the horizon 1f on drives of more than "
                f"{SPANS_S[-1]:g} s for integrated, found none; use interval"
            )
        found = steps.intervals(rows, Level(), ends)
        covariances = np.full((len(ends), 6, 6), np.nan)
        diagonal = np.array(factors) * found.scale[:, :6] ** 2
        covariances[np.searchsorted(ends, found.end)] = diagonal[:, :, np.newaxis] * np.eye(6)
        return covariances

    def same_rate(self, period_s: float) -> bool:
        """Whether poses come at the calibration's rate, which horizons in frames rely on."""
        return abs(period_s / self.limits.period_s - 1.0) <= SAME_RATE

    def statement(self, level: Level) -> str:
        """Return in one sentence what intervals at a level promise."""
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
