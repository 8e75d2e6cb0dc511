"""Intervals on the motion of an estimator as its poses come."""

from __future__ import annotations

import math
import os
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from typing import NamedTuple, get_args

import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import ArrayLike, NDArray

from cvo_edge.documents import shown
from cvo_edge.errors import UsageError
from cvo_edge.motion.adaptation import MotionAdaptation
from cvo_edge.motion.annotation import status_of
from cvo_edge.motion.covariance import in_fixed_axes
from cvo_edge.motion.drift import Running
from cvo_edge.motion.ending import Ending, Endings
from cvo_edge.motion.fitting import ERRORS, eight
from cvo_edge.motion.intervals import MotionCalibration
from cvo_edge.motion.kept import KEPT, Kept, nanoseconds, seven
from cvo_edge.motion.rate import Rate
from cvo_edge.motion.records import (
    MotionInterval,
    MotionReason,
    MotionRecord,
    SinceAnchor,
    finite,
    nothing_of,
    pointed,
    recorded,
    six,
    with_tube,
)
from cvo_edge.motion.relative import motion, residual
from cvo_edge.motion.trace import column_logarithms, since_numbers
from cvo_edge.pose import Pose
from cvo_edge.record import Status
from cvo_edge.vocabulary import MotionCovariance, MotionRule, Scope

Array = NDArray[np.float64]


class MotionUpdate(NamedTuple):
    """The result of a true pose.

    Attributes
    ----------
    covered
        For each horizon whether the six degrees of freedom, position and rotation were inside at
        the time; None if no motion became known.
    factor
        For each horizon what labels have made of the eight thresholds; 1 as calibrated.
    """

    covered: tuple[tuple[bool, ...] | None, ...]
    factor: tuple[tuple[float, ...], ...]


class MotionTracker:
    """Intervals on an estimator's motion as its poses come.

    The records are those that ``annotate`` gives for the same poses, to the last bit. Not safe for
    use by several threads.

    Parameters
    ----------
    calibration
        A calibration, or the path of ``motion.json``.
    confidence, rule, scope
        What intervals are stated with.
    covariance
        What covariance to add to the records.
    adapt
        Whether thresholds follow the true poses given to ``observe``.

    Raises CalibrationFileError and UsageError.
    """

    def __init__(
        self,
        calibration: MotionCalibration | str | os.PathLike[str],
        confidence: float = 0.9,
        rule: MotionRule = "mean",
        scope: Scope = "marginal",
        covariance: MotionCovariance | None = None,
        *,
        adapt: bool = False,
    ) -> None:
        if not isinstance(calibration, MotionCalibration):
            if not isinstance(calibration, str | os.PathLike):
                raise UsageError(
                    "calibration: expected a MotionCalibration or a path, found "
                    f"{shown(calibration)}"
                )
            calibration = MotionCalibration.load(os.fspath(calibration))
        if covariance not in (None, *get_args(MotionCovariance)):
            raise UsageError(
                f"covariance: expected interval or integrated, found {shown(covariance)}"
            )
        self.calibration = calibration
        self.level = calibration.level(confidence, rule, scope)
        calibration.check_covariance(covariance)
        if adapt and calibration.pointed:
            raise UsageError(
                "adapt: expected a calibration in metres, found one of an estimator without a scale"
            )
        self._steps = calibration.steps if covariance == "integrated" else None
        self._of_motions = covariance == "interval"
        self._adaptations = None
        if adapt:
            self._adaptations = [
                MotionAdaptation(1.0 - confidence, joint=scope == "joint")
                for _ in calibration.horizons
            ]
        columns = len(calibration.file.columns)
        self._factors: Array | None = None
        if adapt:
            self._factors = np.ones((ERRORS, len(calibration.horizons)))
        self._endings = Endings(calibration.horizons, self.level, columns)
        # Where a threshold is infinite, so is the bound, whatever the motion.
        self._bounded = [
            bool(np.isfinite(each.thresholds(self.level)).all()) for each in calibration.horizons
        ]
        self._nothing = nothing_of(calibration)
        self._outside = tuple(SinceAnchor(each.spec.window) for each in calibration.windows)
        self._seq = 0
        # By number, as rows move when old ones are dropped.
        self._anchor_seq = 0
        self._start()

    def _start(self) -> None:
        """Forget what came before."""
        self._kept = Kept(self.calibration.limits, len(self.calibration.file.columns))
        self._running = Running(self.calibration.limits.period_s)
        self._rate = Rate()
        self._truths: dict[int, Array] = {}

    def anchor(self, stamp_ns: int) -> None:
        """Take the pose with this stamp as known from now on: tubes start there.

        The first pose is the first anchor. Raises UsageError for a stamp that is not that of a
        pose, or of one that is no longer kept.
        """
        self._anchor_seq = self._kept.numbers[self._row_at("anchor", stamp_ns)]

    def _row_at(self, what: str, stamp_ns: int) -> int:
        """Return the row of a pose with this stamp; raises UsageError if there is none."""
        stamps = self._kept.stamps_ns
        if not stamps:
            raise UsageError(f"{what}: expected a pose, found none so far")
        row = bisect_left(stamps, nanoseconds(stamp_ns))
        if row == len(stamps) or stamps[row] != stamp_ns:
            raise UsageError(
                f"stamp: expected that of a pose, found {stamp_ns}; poses from {stamps[0]} to "
                f"{stamps[-1]}"
            )
        if math.isnan(self._kept.pose(row)[0]):
            raise UsageError(f"stamp: expected a pose at {stamp_ns}, found none: it is missing")
        return row

    def observe(self, stamp_ns: int, pose: Pose | ArrayLike) -> MotionUpdate:
        """Take the true pose of the body at the stamp of an earlier pose, as late as it comes.

        A motion is compared when the true poses at both of its ends are known; truths come in the
        order of their stamps. Thresholds of later poses follow. Raises UsageError unless the
        tracker adapts, and for a stamp that is not that of a pose that is kept.
        """
        if self._adaptations is None:
            raise UsageError("observe: expected a tracker with adapt=True, found one without")
        end = self._row_at("observe", stamp_ns)
        seq = self._kept.numbers[end]
        if seq in self._truths:
            raise UsageError(f"observe: expected each stamp once, found {stamp_ns} again")
        truth = np.array(seven(pose))
        if not np.isfinite(truth).all():
            raise UsageError(f"observe: expected a true pose, found {shown(pose)}")
        self._truths[seq] = truth
        if len(self._truths) > KEPT:
            del self._truths[next(iter(self._truths))]
        found = self._endings.at(self._kept, end)
        scores, newest = self._scores(found, truth), self._kept.numbers[-1]
        covered: list[tuple[bool, ...] | None] = []
        for place, adaptation in enumerate(self._adaptations):
            inside = None
            if place in scores:
                span = end - found.start[place]
                inside = adaptation.update(seq, newest, span, scores[place])
            covered.append(None if inside is None else tuple(inside.tolist()))
        self._factors = np.exp([each.x for each in self._adaptations]).T
        return MotionUpdate(tuple(covered), tuple(map(tuple, self._factors.T.tolist())))

    def _scores(self, found: Ending, truth: Array) -> dict[int, Array]:
        """Return the scores (8,) of motions by horizon, over calibrated thresholds.

        Horizons without a motion, or without a truth where it starts, are left out.
        """
        numbers = self._kept.numbers
        firsts = {
            place: self._truths[numbers[start]]
            for place, start in enumerate(found.start)
            if start >= 0 and numbers[start] in self._truths
        }
        if not firsts:
            return {}
        places = list(firsts)
        moved = np.array(found.moved)[places]
        off = residual(moved, motion(list(firsts.values()), truth)) - found.bias.T[places]
        return dict(zip(places, eight(off) / found.widths.T[places], strict=True))

    def step(
        self,
        stamp_ns: int,
        pose: Pose | ArrayLike | None,
        columns: Mapping[str, float] | None = None,
    ) -> MotionRecord:
        """Take the next pose of the estimator and return its motions with intervals.

        Parameters
        ----------
        stamp_ns
            Time in integer nanoseconds, later than that of the pose before. One that goes back by
            more than the calibration's gap begins a new trajectory: a clock was set.
        pose
            ``T_world_body``, shape (7,); None if the estimator is lost.
        columns
            Values of the columns that the calibration names.

        Raises UsageError if a column is missing or the pose is malformed, which changes nothing. A
        pose or column that is not finite counts as none; a stamp that is hardly earlier, or the
        same, gives an ``invalid`` record and changes nothing.
        """
        stamp_ns = nanoseconds(stamp_ns)
        values = seven(pose)
        logarithms: Sequence[float] = ()
        if self.calibration.file.columns:
            given = self._given(columns, lost=math.isnan(values[0]))
            values = values if np.isfinite(given).all() else seven(None)
            logarithms = column_logarithms(given).tolist()
        if (scale := self.calibration.file.correction.scale) is not None:
            values = (*(scale * each for each in values[:3]), *values[3:])
        seq, self._seq = self._seq, self._seq + 1
        stamps = self._kept.stamps_ns
        if stamps and 1e-9 * (stamps[-1] - stamp_ns) > self.calibration.limits.gap_s:
            # A clock was set, or one was wrong.
            self._start()
        elif stamps and stamp_ns <= stamps[-1]:
            reasons = (MotionReason.STAMP_NOT_LATER,)
            motion, since = self._nothing, self._outside
            return MotionRecord(seq, stamp_ns, Status.INVALID, reasons, None, motion, since, None)
        self._kept.add(seq, stamp_ns, values, logarithms)
        return self._record(seq, stamp_ns, values)

    def _given(self, columns: Mapping[str, float] | None, *, lost: bool) -> Array:
        """Return the values of the calibration's columns; a lost estimator needs none."""
        names = self.calibration.file.columns
        if lost and columns is None:
            return np.ones(len(names))
        try:
            return np.array([float((columns or {})[name]) for name in names])
        except (KeyError, TypeError, ValueError, AttributeError):
            raise UsageError(
                f"columns: expected numbers for {', '.join(names)}, found {shown(columns)}"
            ) from None

    def _record(self, seq: int, stamp_ns: int, values: Sequence[float]) -> MotionRecord:
        calibration, kept = self.calibration, self._kept
        differs = False
        if len(kept) > 1:
            period_s = self._rate.add(kept.stamps_ns[-1] - kept.stamps_ns[-2])
            differs = not calibration.same_rate(period_s)
        reasons = self._reasons(differs)
        motion, since = self._nothing, self._outside
        step: tuple[float, ...] | UnsetType | None = UNSET if self._steps is None else None
        value = self._running.add(calibration.familiar.latest(kept), kept.part[-1])
        novelty = None if value is None else value / calibration.familiar.limit
        if novelty is not None and novelty > 1.0:
            reasons = (MotionReason.MOTION_UNFAMILIAR, *reasons)
        else:
            found = self._endings.at(kept, len(kept) - 1, frames=not differs, factors=self._factors)
            motion, since = self._motions(found), self._tubes()
            if self._steps is not None and found.start[self._steps] >= 0:
                scales = found.scale[:6, self._steps]
                step = tuple(calibration.step_covariances(scales[np.newaxis]).ravel().tolist())
        pose = recorded(values)
        return MotionRecord(
            seq,
            stamp_ns,
            status_of(pose, motion),
            reasons,
            pose,
            motion,
            since,
            None if novelty is None else round(novelty, 4),
            step,
        )

    def _reasons(self, differs: bool) -> tuple[MotionReason, ...]:
        """Return the remarks on the last row."""
        kept = self._kept
        always = (MotionReason.RATE_DIFFERS,) if differs else ()
        last = len(kept) - 1
        if math.isnan(kept.pose(last)[0]):
            return (MotionReason.POSE_MISSING,)
        if last == 0:
            return (MotionReason.TRAJECTORY_STARTED, *always)
        if kept.part[last] == kept.part[last - 1]:
            return always
        late = 1e-9 * (kept.stamps_ns[last] - kept.stamps_ns[last - 1])
        lost = math.isnan(kept.pose(last - 1)[0])
        gap = late > self.calibration.limits.gap_s or lost
        return (MotionReason.GAP if gap else MotionReason.JUMP, *always)

    def _motions(self, found: Ending) -> tuple[MotionInterval, ...]:
        """Return the motions that end at the last row."""
        half, numbers = found.widths[:6], self._kept.numbers
        lower, upper = (found.bias - half).T.tolist(), (found.bias + half).T.tolist()
        radii = found.widths[6:].T.tolist()
        factors = None if self._factors is None else self._factors.T.tolist()
        covariances: list[tuple[float, ...] | UnsetType] = [UNSET] * len(radii)
        if self._of_motions:
            own = [
                each.shape.covariance(scale[np.newaxis], bias[np.newaxis])[0]
                for each, scale, bias in zip(
                    self.calibration.horizons, found.scale.T, found.bias.T, strict=True
                )
            ]
            fixed = in_fixed_axes(np.array(own), np.array(found.moved)[:, 3:])
            covariances = list(map(tuple, fixed.reshape(-1, 36).tolist()))
        motions = []
        for place, (start, none, bounded) in enumerate(
            zip(found.start, self._nothing, self._bounded, strict=True)
        ):
            if start < 0:
                motions.append(none)
                continue
            x, y, z, a, b, c, d = found.moved[place]
            position, rotation = radii[place]
            motions.append(
                MotionInterval(
                    none.horizon,
                    numbers[start],
                    found.seconds[place],
                    found.metres[place],
                    (x, y, z),
                    (a, b, c, d),
                    tuple(lower[place]) if bounded else six(lower[place]),
                    tuple(upper[place]) if bounded else six(upper[place]),
                    finite(position),
                    finite(rotation),
                    bounded,
                    covariances[place],
                    UNSET if factors is None else tuple(factors[place]),
                )
            )
        return tuple(map(pointed, motions) if self.calibration.pointed else motions)

    def _tubes(self) -> tuple[SinceAnchor, ...]:
        """Return the tubes at the last row."""
        kept, last = self._kept, len(self._kept) - 1
        row = bisect_left(kept.numbers, self._anchor_seq)
        if kept.numbers[row] != self._anchor_seq or kept.part[row] != kept.part[last]:
            return self._outside
        seconds = 1e-9 * (kept.stamps_ns[last] - kept.stamps_ns[row])
        metres = kept.path_m[last] - kept.path_m[row]
        frames, numbers = last - row, None
        tubes = []
        for window in self.calibration.windows:
            tube = SinceAnchor(window.spec.window, self._anchor_seq, seconds, metres)
            since = window.since(frames, seconds, metres)
            if since <= window.window.value:
                if numbers is None:
                    means, extent = np.array([kept.means(row, last)]), [[seconds], [metres]]
                    numbers = since_numbers(means.T, np.array(extent))
                widths = window.after(np.array([float(since)]), numbers, self.level)[:, 0]
                tube = with_tube(tube, widths if frames else np.zeros(8))
            tubes.append(tube)
        return tuple(tubes)
