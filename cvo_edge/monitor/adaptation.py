"""Adaptation of thresholds to labels (true poses of single frames) that are sparse and late.

Adaptive conformal inference (Gibbs and Candes 2021, arXiv 2106.00170; quantile tracking:
Angelopoulos, Candes and Tibshirani 2023, arXiv 2307.16895), on the logarithm of a factor, so that
no unit has to be tuned. With each label

    x <- x + eta (1{s > used} - alpha)

where s is the score of the labelled frame, ``used`` the threshold that was used for that frame, and
alpha the miscoverage to reach. The thresholds are the calibrated ones times exp(x), or, for scores
with a sign or within a range (``Head.shifts``), plus x units of 2 (q_.95 - q_.5). In the joint
scope there is one x; in the marginal scope one per threshold.

Labels that come late act late: meanwhile, labels of frames with the same old threshold repeat its
correction. A fixed eta with a delay of more than 1/eta labels therefore runs away. Two limits
prevent that: eta is at most (frames since the label before) / (frames of delay), so that the labels
that are under way together move x by at most 1; and no label moves x further than ``MOST_STALE``
from the x of its own frame. Every regular schedule of labels stays within the second limit.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import index
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import ArrayLike, NDArray

from cvo_edge.bundle.format import Calibration, SixOrUnbounded, Threshold
from cvo_edge.engine.observation import Observation
from cvo_edge.errors import UsageError
from cvo_edge.heads import Head
from cvo_edge.monitor.state import State, StateFile
from cvo_edge.monitor.steps import LARGEST, MOST_STALE, step
from cvo_edge.pose import Chart, Pose, about

Array = NDArray[np.float64]

# Frames that can still be labelled.
KEPT = 1024
# The unit of shifts: from the median to the last level at or below this one.
_HIGH, _LOW = 0.95, 0.5


class Update(NamedTuple):
    """The result of a label.

    Attributes
    ----------
    covered
        Whether the score of the true pose is within the thresholds of its frame: one value in the
        joint scope, six in the marginal one; None for a frame without an interval, whose label
        changes nothing.
    factor
        exp(x) after the label, as in ``PoseInterval.factor``.
    """

    covered: tuple[bool, ...] | None
    factor: tuple[float, ...]


class Adapted(NamedTuple):
    """What the thresholds of the next frames come from.

    ``labels``: how many; ``frozen``: whether labels change nothing; ``factor``: as in ``Update``.
    """

    labels: int
    frozen: bool
    factor: tuple[float, ...]


class Level(NamedTuple):
    """The thresholds for the next frames: as an entry of the bundle, and the x that they come from.

    ``used`` (sides, 6) are the same thresholds, infinite where unbounded; ``x`` is (1, 1) in the
    joint scope and (sides, 6) in the marginal one.
    """

    threshold: Threshold
    used: Array
    x: Array

    @property
    def factor(self) -> tuple[float, ...]:
        """exp(x): 1 as calibrated, more is wider; lower sides before upper ones."""
        return tuple(np.exp(self.x).ravel().tolist())


class _Kept(NamedTuple):
    """The part of an observation that scores need."""

    outputs: Mapping[str, NDArray[Any]]
    point: Array
    pose: Array


@dataclass(slots=True)
class _Frame:
    """What a label of a frame needs; ``kept`` is None for a frame without an interval."""

    kept: _Kept | None
    level: Level
    labelled: bool = False


class Adaptation:
    """The thresholds of one stream, corrected by labels.

    Parameters
    ----------
    head, chart
        The bundle's method and chart.
    calibration
        The bundle's calibration.
    threshold
        Its entry to start from.
    state
        The file that keeps the state, which is read at once and written after each label.

    Raises
    ------
    UsageError
        All thresholds of the entry are unbounded, so that there is nothing to adapt.
    CalibrationFileError, BundleMismatchError, SinkError
        The errors of ``StateFile``.
    """

    def __init__(
        self,
        head: Head,
        chart: Chart,
        calibration: Calibration,
        threshold: Threshold,
        state: str | os.PathLike[str] | None = None,
    ) -> None:
        self._head = head
        self._chart = chart
        self._origin_m = calibration.pose.origin_m
        self._entry = threshold
        self._joint = threshold.scope == "joint"
        self._shifts = head.shifts(threshold.scope)
        self._range = head.score_range()
        self._q = _sides(threshold)
        self._unit = self._q
        if self._shifts:
            self._unit = _unit(self._q, calibration.thresholds, threshold.scope)
        # A threshold of zero has no multiples.
        self._moves = np.isfinite(self._q) & np.isfinite(self._unit) & (self._unit > 0.0)
        if not self._moves.any():
            raise UsageError(
                f"adapt: expected a finite threshold to start from, found none at "
                f"{threshold.confidence:g} {threshold.scope}; choose a lower confidence or "
                "calibrate on more data"
            )
        self._alpha = self._miscoverage()
        self._lowest, self._highest = self._limits()
        self._file = None
        if state is not None:
            self._file = StateFile(state, calibration, threshold.confidence, threshold.scope)
        found = self._file.read(self._alpha.size) if self._file else None
        self._state = found or State((0.0,) * self._alpha.size)
        self._level = self._at(np.array(self._state.x).reshape(self._alpha.shape))
        if found is None:
            # A file that cannot be written is reported before the first label.
            self._keep(self._state)
        self._frames: dict[int, _Frame] = {}
        self._last_label: int | None = None
        self._lock = Lock()
        self._owner, self._closed = os.getpid(), False

    @property
    def level(self) -> Level:
        """The thresholds for the next frame."""
        return self._level

    @property
    def adapted(self) -> Adapted:
        """What the thresholds of the next frames come from."""
        return Adapted(self._state.labels, self._state.frozen, self._level.factor)

    def remember(self, seq: int, level: Level, observation: Observation | None) -> None:
        """Keep a frame for a later label; the oldest of more than ``KEPT`` frames is dropped.

        Parameters
        ----------
        seq, level
            Number of the frame, ascending, and the thresholds that it was given.
        observation
            What the network said; None for a frame without an interval.
        """
        kept = None
        if observation is not None:
            outputs = {name: observation.outputs[name] for name in self._head.scored_outputs()}
            kept = _Kept(outputs, observation.point, observation.pose)
        with self._lock:
            self._frames[seq] = _Frame(kept, level)
            if len(self._frames) > KEPT:
                del self._frames[next(iter(self._frames))]

    def update(self, seq: int, pose: Pose | ArrayLike) -> Update:
        """Take the true pose of a frame; see ``Odometer.update``."""
        truth = pose if isinstance(pose, Pose) else Pose.from_array(pose)
        with self._lock:
            self._check_usable()
            frame = self._frame(seq)
            if frame.kept is None:
                frame.labelled = True
                return Update(None, self._level.factor)
            missed = self._missed(frame.kept, frame.level, truth)
            covered = tuple((~missed.any(axis=0)).ravel().tolist())
            if not self._state.frozen:
                x = self._level.x + self._eta(seq) * (missed - self._alpha)
                own, now = frame.level.x, self._level.x
                x = np.clip(x, np.minimum(now, own - MOST_STALE), np.maximum(now, own + MOST_STALE))
                self._move(x, self._state.labels + 1)
                self._last_label = max(seq, self._last_label or 0)
            frame.labelled = True
            return Update(covered, self._level.factor)

    def freeze(self) -> None:
        """Keep the present thresholds; see ``Odometer.freeze``."""
        with self._lock:
            self._check_usable()
            self._keep(replace(self._state, frozen=True))

    def reset(self) -> None:
        """Return to the calibrated thresholds; see ``Odometer.reset``."""
        with self._lock:
            self._check_usable()
            self._keep(State((0.0,) * self._alpha.size))
            self._level = self._at(np.zeros(self._alpha.shape))

    def close(self) -> None:
        """Let another odometer use the state file; labels are refused from now on."""
        with self._lock:
            self._closed = True
            if self._file:
                self._file.release()

    def _check_usable(self) -> None:
        """Raise UsageError after ``close``, and in a forked process, whose parent has the file."""
        if self._closed:
            raise UsageError("the odometer is closed; load it again")
        if os.getpid() != self._owner:
            raise UsageError(
                "labels: this process was forked after the odometer was loaded; load it again in "
                "this process"
            )

    def _frame(self, seq: int) -> _Frame:
        """Return the frame of this number; raises UsageError if it cannot be labelled."""
        try:
            seq = index(seq)
        except TypeError:
            raise UsageError(f"seq: expected an int, found {seq!r}") from None
        frame = self._frames.get(seq)
        if frame is not None and not frame.labelled:
            return frame
        if not self._frames:
            found = "before the first frame"
        elif frame is not None:
            found = "which has a label already"
        elif seq < (oldest := next(iter(self._frames))):
            found = f"which is too old; the oldest is {oldest}"
        elif seq > (newest := next(reversed(self._frames))):
            found = f"which is still to come; the newest is {newest}"
        else:
            found = "which was dropped"
        raise UsageError(
            f"seq: expected one of the last {KEPT} frames, not yet labelled, found {seq}, {found}"
        )

    def _missed(self, kept: _Kept, level: Level, truth: Pose) -> NDArray[np.bool_]:
        """Whether a frame's scores exceed its thresholds: (1, 1) joint, (sides, 6) marginal."""
        y = self._chart.coordinates(about(truth.to_array(), self._origin_m), kept.pose)
        point = kept.point[np.newaxis]
        scores = self._head.scores(kept.outputs, point, y[np.newaxis], self._entry.scope)[0]
        missed = scores > level.used
        return np.array([[missed.any()]]) if self._joint else np.asarray(missed)

    def _eta(self, seq: int) -> float:
        """Return the step for a label of this frame."""
        before = self._last_label
        # Labels out of order count as if every frame had one.
        gap = 1 if before is None or seq <= before else seq - before
        delay = next(reversed(self._frames)) - seq
        return step(gap, delay)

    def _move(self, x: Array, labels: int) -> None:
        x = np.where(self._free(), np.clip(x, self._lowest, self._highest), 0.0)
        level = self._at(x)
        self._keep(State(tuple(x.ravel().tolist()), labels))
        self._level = level

    def _keep(self, state: State) -> None:
        """Write the state first: if that fails, the label has changed nothing."""
        if self._file:
            self._file.write(state)
        self._state = state

    def _at(self, x: Array) -> Level:
        """Return the thresholds for x."""
        with np.errstate(invalid="ignore"):
            used = self._q + self._unit * x if self._shifts else self._q * np.exp(x)
        used = np.where(self._moves, np.clip(used, *self._range), self._q)
        sides = [_six_or_unbounded(row) for row in used]
        entry = replace(
            self._entry, q_hat=sides[0], q_hat_upper=sides[1] if len(sides) == 2 else None
        )
        return Level(entry, used, x)

    def _free(self) -> NDArray[np.bool_]:
        """Which x move, in the shape of x."""
        return np.array([[True]]) if self._joint else self._moves

    def _miscoverage(self) -> Array:
        """Return alpha of each x, in the shape of x."""
        if self._joint:
            return np.array([[1.0 - self._entry.confidence]])
        # The threshold of an unbounded side does not move.
        levels = self._head.side_confidences(self._entry.confidence)
        alphas = [0.0 if level is None else 1.0 - level for level in levels]
        return np.tile(np.array(alphas)[:, np.newaxis], (1, 6))

    def _limits(self) -> tuple[Array, Array]:
        """Return the range of x: beyond it, thresholds would leave the range of the score."""
        least, most = np.full(self._q.shape, -LARGEST), np.full(self._q.shape, LARGEST)
        if self._shifts:
            lowest, highest = self._range
            with np.errstate(invalid="ignore", divide="ignore"):
                least = np.fmax(least, (lowest - self._q) / self._unit)
                most = np.fmin(most, (highest - self._q) / self._unit)
        if self._joint:
            return least[self._moves].min(keepdims=True), most[self._moves].max(keepdims=True)
        return least, most


def _sides(threshold: Threshold) -> Array:
    """Return the thresholds of an entry, (sides, 6), infinite where unbounded."""
    rows = [row for row in (threshold.q_hat, threshold.q_hat_upper) if row is not None]
    return np.array([[math.inf if q is None else q for q in row] for row in rows])


def _unit(q: Array, thresholds: Sequence[Threshold], scope: str) -> Array:
    """Return 2 (q_.95 - q_.5), (sides, 6), with the last finite level at or below .95; else 0."""
    levels = sorted(
        (entry for entry in thresholds if entry.scope == scope and entry.confidence < _HIGH + 1e-9),
        key=lambda entry: entry.confidence,
    )
    middle = _sides(next(entry for entry in levels if entry.confidence > _LOW - 1e-9))
    unit = np.zeros_like(q)
    for entry in levels:
        with np.errstate(invalid="ignore"):
            step = 2.0 * (_sides(entry) - middle)
        unit = np.where(np.isfinite(step), step, unit)
    return unit


def _six_or_unbounded(values: Array) -> SixOrUnbounded:
    a, b, c, d, e, f = (float(value) if np.isfinite(value) else None for value in values)
    return (a, b, c, d, e, f)
