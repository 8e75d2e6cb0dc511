"""Compare one bundle's records from two processors: differences and coverage."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.pose import Chart
from cvo_edge.record import Record, RecordedInterval
from cvo_edge.sets import Bands, ConformalSet

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Records:
    """The records of one run, frame by frame.

    Attributes
    ----------
    sources, statuses
        Name and status of each of the n frames.
    poses
        Shape (n, 7), m and unit quaternion; NaN where invalid.
    sets
        n conformal sets, m and rad, in the bundle's chart.
    """

    sources: tuple[str, ...]
    statuses: tuple[str, ...]
    poses: Array
    sets: tuple[ConformalSet, ...]

    @property
    def lower(self) -> Array:
        """Shape (n, 6), -inf where unbounded."""
        return np.array([each.lower for each in self.sets])

    @property
    def upper(self) -> Array:
        """Shape (n, 6), inf where unbounded."""
        return np.array([each.upper for each in self.sets])

    @property
    def bands(self) -> NDArray[np.int64]:
        """Number of pieces of each set, shape (n, 6)."""
        return np.array([[len(row) for row in each.bands or [()] * 6] for each in self.sets])


def stacked(lines: Iterable[Record]) -> Records:
    """Put the numbers of records into arrays; null bounds become infinite."""
    entries = list(lines)
    poses = np.full((len(entries), 7), math.nan)
    for row, entry in zip(poses, entries, strict=True):
        if entry.pose is not None:
            row[:] = [*entry.pose.t_m, *entry.pose.q_xyzw]
    return Records(
        tuple(entry.source for entry in entries),
        tuple(entry.status for entry in entries),
        poses,
        tuple(_set_of(entry.interval) for entry in entries),
    )


def _set_of(interval: RecordedInterval | None) -> ConformalSet:
    if interval is None:
        return ConformalSet(np.full(6, -math.inf), np.full(6, math.inf))
    bands: Bands | None = None
    if interval.bands is not None:
        bands = tuple(
            tuple((_end(low, -math.inf), _end(high, math.inf)) for low, high in row)
            for row in interval.bands
        )
    return ConformalSet(
        np.array([_end(value, -math.inf) for value in interval.lower]),
        np.array([_end(value, math.inf) for value in interval.upper]),
        bands,
    )


def _end(value: float | None, unbounded: float) -> float:
    return unbounded if value is None else value


@dataclass(frozen=True)
class Tolerance:
    """Largest differences allowed between two processors.

    Attributes
    ----------
    share
        Difference of position, rotation and bounds, in units of the mean interval width.
    moved_share
        Share of a stepwise method's sets that may differ by more, because a class with a
        probability close to the threshold enters or leaves a set as a whole.
    """

    share: float
    moved_share: float


# By precision. fp32: kernels sum in a different order. int8: if that changes a rounding, a feature
# differs by 1/255 of its map's range. This moved the bounds of the demonstration bundles by 6 % of
# a width, and one in a hundred sets of CSP by more.
TOLERANCES = {"fp32": Tolerance(5e-4, 0.002), "int8": Tolerance(0.1, 0.1)}


@dataclass(frozen=True)
class Difference:
    """The largest differences between two runs over the same frames.

    Attributes
    ----------
    frames, statuses
        Number of frames, and number of frames with different statuses.
    position_m, rotation_rad
        Distance between the positions and angle between the rotations.
    position_share, rotation_share
        Both over the mean width of the three intervals.
    bound_m, bound_rad
        Difference of the bounds; infinite if only one of the two is bounded.
    bound_share
        Difference of the bounds over the mean width of their degree of freedom.
    bands
        Number of sets (six per frame) with a different number of bands.
    moved
        Number of sets with a different number of bands, or a bound beyond the tolerance.
    """

    frames: int
    statuses: int
    position_m: float
    rotation_rad: float
    position_share: float
    rotation_share: float
    bound_m: float
    bound_rad: float
    bound_share: float
    bands: int
    moved: int


def difference(first: Records, second: Records, tolerance: Tolerance) -> Difference:
    """Compare two runs, in widths of the first; raises ValueError if their frames differ."""
    if first.sources != second.sources:
        raise ValueError("expected records of the same frames in the same order")
    position = _largest(np.linalg.norm(_gap(first.poses, second.poses)[:, :3], axis=1))
    rotation = _largest(_angles(first.poses, second.poses))
    bounds = np.maximum(_gap(first.lower, second.lower), _gap(first.upper, second.upper))
    width = mean_width(first)
    # Sets that are unbounded in both runs have no width and no difference.
    shares = np.divide(bounds, width, out=np.zeros_like(bounds), where=bounds > 0.0)
    other_bands = first.bands != second.bands
    return Difference(
        frames=len(first.sources),
        statuses=sum(a != b for a, b in zip(first.statuses, second.statuses, strict=True)),
        position_m=position,
        rotation_rad=rotation,
        position_share=position / float(width[:3].mean()),
        rotation_share=rotation / float(width[3:].mean()),
        bound_m=_largest(bounds[:, :3]),
        bound_rad=_largest(bounds[:, 3:]),
        bound_share=_largest(shares),
        bands=int(other_bands.sum()),
        moved=int((other_bands | (shares > tolerance.share)).sum()),
    )


def exceeded(found: Difference, tolerance: Tolerance, *, stepwise: bool) -> list[str]:
    """Return one line per exceeded tolerance; ``stepwise`` for methods whose sets move in steps."""
    shares = {"position": found.position_share, "rotation": found.rotation_share}
    # Steps do not explain a bound that becomes infinite.
    if not stepwise or math.isinf(found.bound_share):
        shares["bounds"] = found.bound_share
    # Written so that NaN exceeds the tolerance.
    complaints = [
        f"{name}: expected at most {tolerance.share:g} of the mean width, found {share:.3g}"
        for name, share in shares.items()
        if not share <= tolerance.share
    ]
    if found.statuses:
        complaints.append(f"status: expected equal statuses, found {found.statuses} that differ")
    allowed = tolerance.moved_share * 6 * found.frames if stepwise else 0
    if found.moved > allowed:
        complaints.append(f"sets: expected at most {allowed:g} moved, found {found.moved}")
    return complaints


def mean_width(records: Records) -> Array:
    """Return the mean width of bounded sets, without gaps, (6,); NaN if all are unbounded."""
    widths = np.array([each.width() for each in records.sets])
    bounded = np.isfinite(widths)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(bounded, widths, 0.0).sum(axis=0) / bounded.sum(axis=0))


def coverage(records: Records, chart: Chart, truth: Mapping[str, Array]) -> dict[str, Any]:
    """Return the share of frames whose set contains the true pose, per DoF and for all six.

    ``truth`` maps sources to true poses (7,). Frames without a true pose or without an estimate do
    not count.
    """
    covered = []
    for source, pose, each in zip(records.sources, records.poses, records.sets, strict=True):
        if source in truth and np.isfinite(pose).all():
            covered.append(each.covers(chart.coordinates(truth[source], pose)))
    found = np.array(covered, dtype=np.bool_).reshape(-1, 6)
    return {
        "frames": len(found),
        "per_dof": found.mean(axis=0).tolist(),
        "all_six": float(found.all(axis=1).mean()),
    }


def _gap(first: Array, second: Array) -> Array:
    """Return the absolute difference: 0 for equal values, infinite if only one is finite."""
    same = (first == second) | (np.isnan(first) & np.isnan(second))
    with np.errstate(invalid="ignore"):
        gap = np.abs(first - second)
    return np.where(same, 0.0, np.where(np.isfinite(gap), gap, math.inf))


def _angles(first: Array, second: Array) -> Array:
    """Return the angles between rotations of poses (n, 7), (n,) rad; infinite if one is missing."""
    angles = np.zeros(len(first))
    for index, (one, other) in enumerate(zip(first[:, 3:], second[:, 3:], strict=True)):
        if np.isnan(one).any() or np.isnan(other).any():
            angles[index] = 0.0 if np.isnan(one).any() and np.isnan(other).any() else math.inf
            continue
        turned = geometry.quaternion_multiply(geometry.quaternion_conjugate(one), other)
        angles[index] = np.linalg.norm(geometry.quaternion_log(turned))
    return angles


def _largest(values: Array) -> float:
    return float(values.max(initial=0.0))


def difference_lines(rows: Iterable[tuple[str, str, Difference]]) -> list[str]:
    """Return a table of differences, in mm and mrad, from rows of bundle, scope and difference."""
    lines = [
        f"{'largest difference':29}{'scope':10}{'frames':>7}{'status':>7}{'position':>12}"
        f"{'rotation':>12}{'bound':>12}{'bound':>12}{'of width':>10}{'bands':>6}{'moved':>6}",
        f"{'':53}{'mm':>12}{'mrad':>12}{'mm':>12}{'mrad':>12}",
    ]
    for name, scope, found in rows:
        lengths = (found.position_m, found.rotation_rad, found.bound_m, found.bound_rad)
        lines.append(
            f"{name:29}{scope:10}{found.frames:7}{found.statuses:7}"
            + "".join(f"{1e3 * value:12.2g}" for value in lengths)
            + f"{found.bound_share:10.2g}{found.bands:6}{found.moved:6}"
        )
    return lines


def coverage_lines(rows: Iterable[tuple[str, str, str, Mapping[str, Any]]]) -> list[str]:
    """Return a table of coverage from rows of bundle, scope, processor and ``coverage``."""
    names = ("tx", "ty", "tz", "r1", "r2", "r3")
    lines = [
        f"{'coverage':29}{'scope':10}{'on':7}" + "".join(f"{n:>7}" for n in names) + " all six"
    ]
    for name, scope, processor, found in rows:
        cells = "".join(f"{share:7.3f}" for share in (*found["per_dof"], found["all_six"]))
        lines.append(f"{name:29}{scope:10}{processor:7}{cells}")
    return lines
