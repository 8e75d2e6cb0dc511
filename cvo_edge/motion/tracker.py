"""Intervals on the motion of an estimator, pose by pose or for a whole trajectory."""

from __future__ import annotations

import os
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvo_edge.documents import shown
from cvo_edge.errors import UsageError
from cvo_edge.estimate import Status
from cvo_edge.motion.adaptation import MotionAdaptation
from cvo_edge.motion.drift import Running
from cvo_edge.motion.fitting import eight
from cvo_edge.motion.intervals import Level, MotionCalibration, MotionHorizon
from cvo_edge.motion.kept import KEPT, Kept, nanoseconds, seven
from cvo_edge.motion.records import (
    MotionInterval,
    MotionReason,
    MotionRecord,
    SinceAnchor,
    records_of,
)
from cvo_edge.motion.relative import motion, residual
from cvo_edge.motion.trace import Rows, cut, first_row, next_rows, rows_of
from cvo_edge.pose import Pose
from cvo_edge.vocabulary import MotionCovariance, MotionRule, Scope

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# The rate is the median of so many steps.
_RATE_OF = 15


def annotate(
    calibration: MotionCalibration,
    level: Level,
    stamps_ns: Integers,
    poses: Array,
    columns: Mapping[str, Array],
    anchors_ns: ArrayLike = (),
    covariance: MotionCovariance | None = None,
) -> Iterator[MotionRecord]:
    """Yield the records of a whole trajectory.

    Parameters
    ----------
    calibration, level
        What to state.
    stamps_ns, poses
        Shape (n,), ascending, and (n, 7): ``T_world_body``, NaN where there is no pose.
    columns
        Shape (n,) each; those that the calibration names are needed.
    anchors_ns
        Stamps of poses that are taken as known, besides the first one.
    covariance
        What covariance to add to the records.

    Raises UsageError if a column is missing, an anchor is no pose of the trajectory, or the
    calibration does not have the covariance.
    """
    values = np.empty((len(stamps_ns), len(calibration.file.columns)))
    for place, name in enumerate(calibration.file.columns):
        if name not in columns:
            raise UsageError(f"columns: expected {name}, found {', '.join(columns) or 'none'}")
        values[:, place] = columns[name]
    rows = rows_of(stamps_ns, calibration.scaled(poses), values, calibration.limits)
    steps = 1e-9 * np.diff(stamps_ns)
    differs = len(steps) > 0 and not calibration.same_rate(float(np.median(steps)))
    ends = np.arange(len(stamps_ns))
    known = np.zeros_like(ends)
    for stamp_ns in np.asarray(anchors_ns, np.int64).tolist():
        row = row_at(rows, stamp_ns)
        known[row] = row
    return records_of(
        calibration,
        level,
        rows,
        range(len(stamps_ns)),
        _reasons(calibration, rows, 0, differs),
        np.maximum.accumulate(known),
        _novelties(calibration, Running(calibration.limits.period_s), rows, ends),
        ends,
        frames=not differs,
        covariance=covariance,
    )


def _novelties(
    calibration: MotionCalibration, running: Running, rows: Rows, ends: Integers
) -> list[float | None]:
    """Return D over its limit at rows; see ``drift``."""
    found = running.all(calibration.familiar.novelty(rows, ends), rows.part[ends])
    limit = calibration.familiar.limit
    return [None if value is None else value / limit for value in found]


def row_at(rows: Rows, stamp_ns: int) -> int:
    """Return the row of a pose with this stamp; raises UsageError if there is none."""
    row = int(np.searchsorted(rows.stamps_ns, stamp_ns))
    if row == len(rows.stamps_ns) or rows.stamps_ns[row] != stamp_ns:
        raise UsageError(
            f"stamp: expected that of a pose, found {stamp_ns}; poses from "
            f"{rows.stamps_ns[0]} to {rows.stamps_ns[-1]}"
        )
    if not np.isfinite(rows.poses[row]).all():
        raise UsageError(f"stamp: expected a pose at {stamp_ns}, found none: it is missing")
    return row


def _reasons(
    calibration: MotionCalibration, rows: Rows, first: int, differs: bool
) -> list[tuple[MotionReason, ...]]:
    """Return the remarks on rows from ``first`` on; row 0 has nothing before it."""
    # Of a stream, only the last rows are asked for.
    before = max(first - 1, 0)
    rows = cut(rows, slice(before, None))
    missing: Mask = ~np.asarray(np.isfinite(rows.poses).all(axis=1))
    broken: Mask = np.concatenate([[True], rows.part[1:] != rows.part[:-1]])
    seconds = np.concatenate([[0.0], 1e-9 * np.diff(rows.stamps_ns)])
    late: Mask = (seconds > calibration.limits.gap_s) | np.concatenate([[False], missing[:-1]])
    always = (MotionReason.RATE_DIFFERS,) if differs else ()
    found: list[tuple[MotionReason, ...]] = []
    for place in range(first - before, len(rows.part)):
        if missing[place]:
            found.append((MotionReason.POSE_MISSING,))
        elif not broken[place]:
            found.append(always)
        elif before + place == 0:
            found.append((MotionReason.TRAJECTORY_STARTED, *always))
        else:
            found.append((MotionReason.GAP if late[place] else MotionReason.JUMP, *always))
    return found


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

    The records are those that ``annotate`` gives for the same poses, up to rounding, but for the
    rate, which is not known before some poses have come. Not safe for use by several threads.

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
        self._covariance = covariance
        self._adaptations = None
        if adapt:
            self._adaptations = [
                MotionAdaptation(1.0 - confidence, joint=scope == "joint")
                for _ in calibration.horizons
            ]
        self._truths: dict[int, Array] = {}
        self._running = Running(calibration.limits.period_s)
        self._kept = Kept()
        self._seq = 0
        # By number, as rows move when old ones are dropped.
        self._anchor_seq = 0

    def anchor(self, stamp_ns: int) -> None:
        """Take the pose with this stamp as known from now on: tubes start there.

        The first pose is the first anchor. Raises UsageError for a stamp that is not that of a
        pose, or of one that is no longer kept.
        """
        rows = self._kept.rows
        if rows is None:
            raise UsageError("anchor: expected a pose, found none so far")
        self._anchor_seq = self._kept.numbers[row_at(rows, nanoseconds(stamp_ns))]

    def observe(self, stamp_ns: int, pose: Pose | ArrayLike) -> MotionUpdate:
        """Take the true pose of the body at the stamp of an earlier pose, as late as it comes.

        A motion is compared when the true poses at both of its ends are known; truths come in the
        order of their stamps. Thresholds of later poses follow. Raises UsageError unless the
        tracker adapts, and for a stamp that is not that of a pose that is kept.
        """
        if self._adaptations is None:
            raise UsageError("observe: expected a tracker with adapt=True, found one without")
        rows = self._kept.rows
        if rows is None:
            raise UsageError("observe: expected a pose, found none so far")
        end = row_at(rows, nanoseconds(stamp_ns))
        seq = self._kept.numbers[end]
        if seq in self._truths:
            raise UsageError(f"observe: expected each stamp once, found {stamp_ns} again")
        truth = seven(pose)
        if not np.isfinite(truth).all():
            raise UsageError(f"observe: expected a true pose, found {shown(pose)}")
        self._truths[seq] = truth
        if len(self._truths) > KEPT:
            del self._truths[next(iter(self._truths))]
        covered = []
        for horizon, adaptation in zip(self.calibration.horizons, self._adaptations, strict=True):
            found = self._scores(rows, horizon, end)
            inside = None
            if found is not None:
                inside = adaptation.update(seq, self._kept.numbers[-1], *found)
            covered.append(None if inside is None else tuple(inside.tolist()))
        return MotionUpdate(tuple(covered), tuple(tuple(each.tolist()) for each in self._factors()))

    def _scores(self, rows: Rows, horizon: MotionHorizon, end: int) -> tuple[int, Array] | None:
        """Return the rows of a motion and its scores (8,) over calibrated thresholds.

        None if the truth is not known at both ends.
        """
        found = horizon.intervals(rows, self.level, np.array([end]))
        if not len(found.end):
            return None
        numbers = self._kept.numbers
        first, last = (self._truths.get(numbers[row]) for row in (found.start[0], end))
        if first is None or last is None:
            return None
        off = residual(found.moved, motion(first, last)[np.newaxis]) - found.bias
        widths = np.concatenate([0.5 * (found.upper - found.lower), found.radii], axis=1)
        scores = eight(off)[0] / widths[0]
        return (end - int(found.start[0]), scores) if np.isfinite(off).all() else None

    def _factors(self) -> list[Array]:
        return [np.exp(each.x) for each in self._adaptations or ()]

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
        whole = self.calibration.scaled(seven(pose)[np.newaxis])
        given = self._given(columns, lost=not np.isfinite(whole).all())
        seq, self._seq = self._seq, self._seq + 1
        self._restart_before(stamp_ns)
        rows = self._kept.rows
        if rows is not None and stamp_ns <= rows.stamps_ns[-1]:
            return MotionRecord(
                seq,
                stamp_ns,
                Status.INVALID,
                (MotionReason.STAMP_NOT_LATER,),
                None,
                tuple(MotionInterval(each.spec.horizon) for each in self.calibration.horizons),
                tuple(SinceAnchor(each.spec.window) for each in self.calibration.windows),
                None,
            )
        if rows is None:
            row = first_row(stamp_ns, whole[0], given)
        else:
            stamp = np.array([stamp_ns], np.int64)
            row = next_rows(rows, stamp, whole, given[np.newaxis], self.calibration.limits)
        return self._record(self._kept.add(seq, row))

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

    def _restart_before(self, stamp_ns: int) -> None:
        """Forget what came before if a stamp goes far back: a clock was set, or one was wrong."""
        rows = self._kept.rows
        if rows is None:
            return
        if 1e-9 * float(rows.stamps_ns[-1] - stamp_ns) > self.calibration.limits.gap_s:
            self._kept = Kept()
            self._truths = {}
            self._running = Running(self.calibration.limits.period_s)

    def _record(self, rows: Rows) -> MotionRecord:
        end = np.array([len(rows.part) - 1])
        steps = np.diff(rows.stamps_ns[-_RATE_OF - 1 :])
        differs = len(steps) == _RATE_OF and not self.calibration.same_rate(
            1e-9 * float(np.median(steps))
        )
        numbers = self._kept.numbers
        anchor = bisect_left(numbers, self._anchor_seq)
        known = numbers[anchor] == self._anchor_seq
        (record,) = records_of(
            self.calibration,
            self.level,
            rows,
            numbers,
            _reasons(self.calibration, rows, int(end[0]), differs),
            np.array([anchor if known else -1]),
            _novelties(self.calibration, self._running, rows, end),
            end,
            frames=not differs,
            covariance=self._covariance,
            factors=self._factors() if self._adaptations is not None else None,
        )
        return record
