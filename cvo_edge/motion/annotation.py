"""The records of a whole trajectory, as ``MotionTracker`` gives them pose by pose."""

from __future__ import annotations

import gc
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import repeat

import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import ArrayLike, NDArray

from cvo_edge.errors import UsageError
from cvo_edge.motion.covariance import in_fixed_axes
from cvo_edge.motion.drift import Running
from cvo_edge.motion.intervals import Level, MotionCalibration, MotionHorizon, MotionWindow
from cvo_edge.motion.records import (
    MotionInterval,
    MotionReason,
    MotionRecord,
    SinceAnchor,
    nothing_of,
    pointed,
    with_tube,
)
from cvo_edge.motion.trace import Rows, rows_of
from cvo_edge.record import RecordedPose, Status
from cvo_edge.vocabulary import MotionCovariance

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Poses whose records are made together, so that memory does not grow with the trajectory.
_AT_ONCE = 1024


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
    calibration.check_covariance(covariance)
    values = np.empty((len(stamps_ns), len(calibration.file.columns)))
    for place, name in enumerate(calibration.file.columns):
        if name not in columns:
            raise UsageError(f"columns: expected {name}, found {', '.join(columns) or 'none'}")
        values[:, place] = columns[name]
    steps = calibration.steps if covariance == "integrated" else None
    rows = rows_of(stamps_ns, calibration.scaled(poses), values, calibration.limits)
    known = np.zeros(len(stamps_ns), np.int64)
    for stamp_ns in np.asarray(anchors_ns, np.int64).tolist():
        row = _row_at(rows, stamp_ns)
        known[row] = row
    anchors = np.maximum.accumulate(known)
    return _records(calibration, level, rows, anchors, steps, covariance == "interval")


def _row_at(rows: Rows, stamp_ns: int) -> int:
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


def _records(
    calibration: MotionCalibration,
    level: Level,
    rows: Rows,
    anchors: Integers,
    steps: int | None,
    of_motions: bool,
) -> Iterator[MotionRecord]:
    """Yield the records of all rows.

    ``steps``: the horizon of covariances of steps; ``of_motions``: whether to add those of motions.
    """
    differs = calibration.other_rate(rows.stamps_ns)
    reasons = _reasons(calibration, rows, differs)
    running = Running(calibration.limits.period_s)
    limit = calibration.familiar.limit
    nothing = nothing_of(calibration)
    outside = tuple(SinceAnchor(each.spec.window) for each in calibration.windows)
    for begin in range(0, len(rows.part), _AT_ONCE):
        ends = np.arange(begin, min(begin + _AT_ONCE, len(rows.part)))
        with _uncollected():
            novelty = running.all(calibration.familiar.novelty(rows, ends), rows.part[ends])
            shares = [None if value is None else value / limit for value in novelty]
            by_horizon = [
                _motions(rows, ends, differs[ends], each, level, none, of_motions)
                for each, none in zip(calibration.horizons, nothing, strict=True)
            ]
            if calibration.pointed:
                by_horizon = [list(map(pointed, each)) for each in by_horizon]
            by_window = [
                _tube(rows, each, anchors[ends], ends, level, none)
                for each, none in zip(calibration.windows, outside, strict=True)
            ]
            motions = list(zip(*by_horizon, strict=True))
            tubes = list(zip(*by_window, strict=True)) or [()] * len(ends)
            covariances: list[tuple[float, ...] | UnsetType | None] = [UNSET] * len(ends)
            if steps is not None:
                covariances = _steps(calibration, steps, rows, ends, differs[ends])
            for place, share in enumerate(shares):
                if share is not None and share > 1.0:
                    motions[place], tubes[place] = nothing, outside
                    reasons[begin + place] = (
                        MotionReason.MOTION_UNFAMILIAR,
                        *reasons[begin + place],
                    )
                    if steps is not None:
                        covariances[place] = None
            x, y, z, *q = rows.poses[ends].T.tolist()
            given = map(RecordedPose, zip(x, y, z, strict=True), zip(*q, strict=True))
            poses = [
                None if math.isnan(first) else pose for first, pose in zip(x, given, strict=True)
            ]
        yield from map(
            MotionRecord,
            ends.tolist(),
            rows.stamps_ns[ends].tolist(),
            map(status_of, poses, motions),
            reasons[begin : begin + len(ends)],
            poses,
            motions,
            tubes,
            [None if share is None else round(share, 4) for share in shares],
            covariances,
        )


_UNSET: Iterable[UnsetType] = repeat(UNSET)


@contextmanager
def _uncollected() -> Iterator[None]:
    """Look for no cycles while records are made, which have none: a tenth of the time."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def _reasons(
    calibration: MotionCalibration, rows: Rows, differs: Mask
) -> list[tuple[MotionReason, ...]]:
    """Return the remarks on all rows."""
    missing = ~np.asarray(np.isfinite(rows.poses).all(axis=1))
    late = np.append(False, 1e-9 * np.diff(rows.stamps_ns) > calibration.limits.gap_s)
    late[1:] |= missing[:-1]
    reasons: list[tuple[MotionReason, ...]] = [()] * len(rows.part)
    for row in np.flatnonzero(differs).tolist():
        reasons[row] = (MotionReason.RATE_DIFFERS,)
    reasons[0] = (MotionReason.TRAJECTORY_STARTED,)
    for row in (np.flatnonzero(np.diff(rows.part)) + 1).tolist():
        reasons[row] = (MotionReason.GAP if late[row] else MotionReason.JUMP, *reasons[row])
    for row in np.flatnonzero(missing).tolist():
        reasons[row] = (MotionReason.POSE_MISSING,)
    return reasons


def _motions(
    rows: Rows,
    ends: Integers,
    differs: Mask,
    horizon: MotionHorizon,
    level: Level,
    none: MotionInterval,
    covariance: bool,
) -> list[MotionInterval]:
    """Return the motions over one horizon that end at each of successive rows."""
    applies = ends if horizon.horizon.unit != "f" else ends[~differs]
    found = horizon.intervals(rows, level, applies)
    bounded = np.isfinite(horizon.thresholds(level)).tolist()
    seconds = 1e-9 * (rows.stamps_ns[found.end] - rows.stamps_ns[found.start])
    metres = rows.path_m[found.end] - rows.path_m[found.start]
    covariances: Iterable[tuple[float, ...] | UnsetType] = _UNSET
    if covariance:
        own = horizon.shape.covariance(found.scale, found.bias)
        fixed = in_fixed_axes(own, found.moved[:, 3:])
        covariances = map(tuple, fixed.reshape(-1, 36).tolist())
    x, y, z, *q = found.moved.T.tolist()
    position, rotation = (
        _finite(values, known) for values, known in zip(found.radii.T, bounded[6:], strict=True)
    )
    motions = map(
        MotionInterval,
        repeat(none.horizon),
        found.start.tolist(),
        seconds.tolist(),
        metres.tolist(),
        zip(x, y, z, strict=True),
        zip(*q, strict=True),
        _sixes(found.lower, bounded),
        _sixes(found.upper, bounded),
        position,
        rotation,
        repeat(all(bounded)),
        covariances,
    )
    every = [none] * len(ends)
    for place, each in zip((found.end - ends[0]).tolist(), motions, strict=True):
        every[place] = each
    return every


def _sixes(bounds: Array, bounded: Sequence[bool]) -> Iterator[tuple[float | None, ...]]:
    """Yield bounds (m, 6); None for those that are infinite."""
    return zip(*map(_finite, bounds.T, bounded), strict=True)


def _finite(values: Array, bounded: bool) -> Iterable[float | None]:
    return values.tolist() if bounded else [None] * len(values)


def _tube(
    rows: Rows,
    window: MotionWindow,
    anchors: Integers,
    ends: Integers,
    level: Level,
    none: SinceAnchor,
) -> list[SinceAnchor]:
    """Return the tube of one window at each row."""
    seconds = 1e-9 * (rows.stamps_ns[ends] - rows.stamps_ns[anchors])
    metres = rows.path_m[ends] - rows.path_m[anchors]
    same = rows.part[anchors] == rows.part[ends]
    tubes = [
        SinceAnchor(none.window, anchor, time_s, path_m) if known else none
        for known, anchor, time_s, path_m in zip(
            *(column.tolist() for column in (same, anchors, seconds, metres)), strict=True
        )
    ]
    # Most poses of a drive with few anchors are beyond the window.
    widths = window.tube(rows, anchors, ends, level)
    for place in np.flatnonzero((widths < np.inf).any(axis=0)).tolist():
        tubes[place] = with_tube(tubes[place], widths[:, place])
    return tubes


def _steps(
    calibration: MotionCalibration, steps: int, rows: Rows, ends: Integers, differs: Mask
) -> list[tuple[float, ...] | UnsetType | None]:
    """Return the integrated covariance of the step that ends at each row; None without one."""
    every: list[tuple[float, ...] | UnsetType | None] = [None] * len(ends)
    found = calibration.horizons[steps].intervals(rows, Level(), ends[~differs])
    covariances = map(
        tuple, calibration.step_covariances(found.scale[:, :6]).reshape(-1, 36).tolist()
    )
    for place, each in zip((found.end - ends[0]).tolist(), covariances, strict=True):
        every[place] = each
    return every


def status_of(pose: object, motion: Iterable[MotionInterval]) -> Status:
    """Return the status of a record."""
    if pose is None:
        return Status.INVALID
    for each in motion:
        if each.bounded:
            return Status.OK
    return Status.DEGRADED
