"""Plot a bundle on a data set: truth, point estimate and set over time, and a top view."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration, StillDof
from cvo_edge.engine.loading import read_bundle
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.files import picture_metadata, whole_file
from cvo_edge.guarantee import statement
from cvo_edge.input.frame import Frame
from cvo_edge.odometer import Odometer
from cvo_edge.pose import Chart
from cvo_edge.record import Status
from cvo_edge.vocabulary import Scope
from cvo_export.datasets import PoseDataset
from cvo_export.datasets.picture import check_picture
from cvo_export.evaluate import subset_indices
from cvo_export.vocabulary import Subset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

# Colours that colour-blind readers can tell apart (Okabe and Ito 2008).
TRUTH, POINT, BAND, MISSED = "#000000", "#0072B2", "#56B4E9", "#D55E00"
# More boxes would hide one another.
BOXES = 60
_DPI = 130
# Sets narrower than this share of the motion would be a line: they are drawn about the prediction.
_THIN = 0.05
# A degree of freedom that stands still is drawn over at least this many of its floors, and wide
# sets of it to at most so many from the truth: further away, poses are invalid.
_FLOORS, _MOST_FLOORS = 4.0, 10.0
_TITLE_SIZE, _TITLE_COLUMNS = 9, 56


def plot(
    bundle_dir: Path,
    dataset: PoseDataset,
    out: Path,
    *,
    subset: Subset = "test",
    sequence: str | None = None,
    confidence: float = 0.9,
    scope: Scope = "marginal",
) -> None:
    """Draw each degree of freedom over the frames, and x against y, into one figure.

    The bands of a disjoint set are drawn separately, and frames whose truth lies outside the set
    are marked. Rotations are in degrees; in a chart about the prediction they are offsets from it,
    as are degrees of freedom whose sets are much narrower than the motion. The titles say which
    degrees of freedom stand still and why sets are unbounded; unbounded sets are hatched.
    ``sequence`` names one sequence of the data set; None draws all frames of the subset in order.

    Raises
    ------
    UsageError
        matplotlib is not installed, the file format is not supported, or the data set has no such
        sequence.
    SourceError
        No frame has a pose.
    SinkError
        The figure cannot be written.
    """
    check_picture(out, "out")
    from matplotlib.figure import Figure

    drawn = track(bundle_dir, dataset, subset, sequence, confidence, scope)
    figure = Figure(figsize=(15, 11), layout="constrained")
    grid = figure.add_gridspec(3, 3)
    for dof in range(6):
        axes = figure.add_subplot(grid[dof % 3, dof // 3])
        draw_dof(axes, drawn, dof, relative=_is_thin(drawn, dof))
    draw_from_above(figure.add_subplot(grid[:2, 2]), drawn)
    calibration = drawn.calibration
    figure.suptitle(
        f"{calibration.name}: {calibration.method}, {calibration.calibration.score} score, "
        f"{confidence:g} {scope}, {len(drawn.rows)} frames of {dataset.name}"
        + (f", {sequence}" if sequence else "")
    )
    with whole_file(out) as stream:
        figure.savefig(
            stream, format=out.suffix[1:].lower(), dpi=_DPI, metadata=picture_metadata(out.suffix)
        )


class Track(NamedTuple):
    """A bundle's estimates for n frames, with the truth.

    ``truth`` (n, 6) holds the true poses in the bundle's chart, NaN for frames without an
    estimate; ``rows`` are the positions of the frames whose estimate has a pose; ``parts`` (n,)
    counts the parts in which the frames follow each other in one recording; ``proven`` is the
    statement of ``cvo_edge.guarantee`` about the sets, or why they are unbounded.
    """

    calibration: Calibration
    chart: Chart
    estimates: list[PoseInterval]
    truth: Array
    rows: list[int]
    parts: NDArray[np.int64]
    proven: str


def track(
    bundle_dir: Path,
    dataset: PoseDataset,
    subset: Subset = "test",
    sequence: str | None = None,
    confidence: float = 0.9,
    scope: Scope = "marginal",
) -> Track:
    """Run the frames of a subset, or those of one sequence in it, through a bundle.

    As in ``evaluate``, the stream is not watched: neither the alarm nor the stream checks take an
    interval away.

    Raises UsageError for an unknown sequence and SourceError if no frame has a pose.
    """
    bundle = read_bundle(bundle_dir)
    bundle = replace(bundle, calibration=msgspec.structs.replace(bundle.calibration, alarm=None))
    dataset = dataset.decoded(bundle.calibration.preprocess.decode)
    camera = dataset.camera() if bundle.head.solves else None
    with Odometer(bundle, confidence=confidence, scope=scope, camera=camera) as odometer:
        indices = subset_indices(odometer.calibration, dataset, subset)
        if sequence is not None:
            if sequence not in dataset.sequence_names:
                raise UsageError(
                    f"sequence: expected one of {dataset.sequence_names[0]} to "
                    f"{dataset.sequence_names[-1]}, found {sequence}"
                )
            number = dataset.sequence_names.index(sequence)
            indices = indices[dataset.sequence[indices] == number]
        estimates = [_step(odometer, dataset, index) for index in indices.tolist()]
        rows = [row for row, estimate in enumerate(estimates) if estimate.pose is not None]
        if not rows:
            raise SourceError(f"{dataset.name}: expected frames with a pose, found none")
        truth = _truth(odometer.chart, estimates, dataset.poses[indices])
        apart = np.diff(indices) != 1
        apart |= np.diff(dataset.sequence[indices]) != 0
        parts = np.cumsum(np.concatenate([[False], apart]))
        calibration = odometer.calibration
        proven = statement(calibration.calibration, odometer.head, odometer.threshold)
        return Track(calibration, odometer.chart, estimates, truth, rows, parts, proven)


def _step(odometer: Odometer, dataset: PoseDataset, index: int) -> PoseInterval:
    try:
        image: Any = dataset.read_image(index)
    except SourceError:
        image = None
    # One stream per frame: the frames need not be consecutive.
    frame = Frame(image, None, dataset.frame_names[index], 0.0)
    (estimate,) = odometer.stream([frame])
    return estimate


def _truth(chart: Chart, estimates: list[PoseInterval], poses: Array) -> Array:
    """Return the true poses (n, 6) in the chart at each estimate; NaN for invalid estimates."""
    truth = np.full((len(estimates), 6), np.nan)
    for row, (estimate, pose) in enumerate(zip(estimates, poses, strict=True)):
        if estimate.pose is not None:
            truth[row] = chart.coordinates(pose, estimate.pose.to_array())
    return truth


def _is_thin(drawn: Track, dof: int) -> bool:
    """Whether the sets of one degree of freedom are narrow beside the motion."""
    width = [drawn.estimates[r].upper[dof] - drawn.estimates[r].lower[dof] for r in drawn.rows]
    return bool(np.median(width) < _THIN * np.ptp(drawn.truth[drawn.rows, dof]))


def draw_dof(axes: Axes, drawn: Track, dof: int, *, relative: bool = False) -> None:
    """Draw one degree of freedom over the frames: sets, point, truth and missed frames.

    ``relative`` draws offsets from the point. The title says whether the degree of freedom stands
    still, and why sets are unbounded.
    """
    _, chart, estimates, truth, rows, parts, _ = drawn
    scale, unit = (1.0, "m") if dof < 3 else (float(np.rad2deg(1.0)), "deg")
    point = np.array([chart.point(_array(estimates[row]))[dof] for row in rows])
    about = dof > 2 and chart.rotation == "tangent_predicted"
    origin = np.zeros(len(estimates))
    if relative:
        about, scale, unit = True, *((100.0, "cm") if dof < 3 else (scale, unit))
        origin[rows] = point
    values = scale * (truth[:, dof] - origin)
    shown = values[rows]
    places: list[int] = []
    ends: list[Array] = []
    missed = []
    for row in rows:
        estimate = estimates[row]
        bands = (
            estimate.bands[dof] if estimate.bands else ((estimate.lower[dof], estimate.upper[dof]),)
        )
        for band in bands:
            places.append(row)
            ends.append(scale * (np.array(band) - origin[row]))
        # An ellipsoidal region holds all six degrees of freedom or misses them together.
        whole = estimate.conformal_set.ellipsoids
        if not (
            whole.contains(truth[row]) if whole else estimate.conformal_set.covers(truth[row])[dof]
        ):
            missed.append(row)
    line = scale * (point - origin[rows])
    floor = _floor(drawn.calibration, dof)
    if floor is None:
        spread = max(float(np.ptp(shown)), 1e-6)
        limits = shown.min() - 0.4 * spread, shown.max() + 0.4 * spread
    else:
        limits = _still_limits(shown, np.concatenate([line, *ends]), scale * floor)
        axes.ticklabel_format(axis="y", style="plain", useOffset=False)
    draw_bands(axes, places, ends, limits)
    cuts = np.flatnonzero(np.diff(parts[rows])) + 1
    with_gaps = np.insert(np.array(rows, dtype=np.float64), cuts, np.nan)
    for heights, color, name in ((line, POINT, "point"), (shown, TRUTH, "truth")):
        broken = np.insert(heights, cuts, np.nan)
        axes.plot(with_gaps, broken, color=color, linewidth=0.9, label=name)
    regions = any(estimates[row].conformal_set.ellipsoids for row in rows)
    label = "outside the six-DoF region" if regions else "missed"
    axes.plot(missed, values[missed], "x", color=MISSED, markersize=5, label=label)
    axes.set_ylim(*limits)
    kind = " about the prediction" if about else ""
    axes.set_ylabel(f"{chart.dof[dof]} ({unit}){kind}")
    axes.set_xlabel("frame")
    axes.margins(x=0.01)
    still = "" if floor is None else f"stands still in training (floor {scale * floor:.2g} {unit})"
    set_title(axes, [still, _unbounded_text(drawn, [dof])])
    if dof == 0:
        axes.legend(loc="best", ncols=4, fontsize=8)


def draw_bands(
    axes: Axes, places: Iterable[int], ends: Iterable[Array], limits: tuple[float, float]
) -> None:
    """Draw bands with ends (2,) over their frames; those that are unbounded are hatched.

    ``limits`` are those of the axis, beyond which infinite ends are drawn.
    """
    low, high = limits
    reach = high - low
    groups: tuple[list[tuple[float, ...]], ...] = ([], [])
    for place, band in zip(places, ends, strict=True):
        bottom, top = np.clip(band, low - reach, high + reach).tolist()
        groups[int(not np.isfinite(band).all())].append((place, top - bottom, bottom))
    styles: tuple[dict[str, Any], ...] = (
        {"color": BAND, "alpha": 0.6, "label": "set"},
        {
            "facecolor": "none",
            "edgecolor": BAND,
            "hatch": "///",
            "alpha": 0.6,
            "label": "unbounded set",
        },
    )
    for bars, style in zip(groups, styles, strict=True):
        if bars:
            at, heights, bottoms = zip(*bars, strict=True)
            axes.bar(at, heights, 1.0, bottoms, linewidth=0, **style)


def _floor(calibration: Calibration, dof: int) -> float | None:
    """Return the floor of a degree of freedom that stands still, m or rad; None if it moves."""
    pose = calibration.pose
    return pose.standard_deviation[dof] if get_args(StillDof)[dof] in pose.still else None


def _still_limits(truth: Array, others: Array, floor: float) -> tuple[float, float]:
    """Return limits of at least ``_FLOORS`` floors about the truth, the points and the sets."""
    reach = _MOST_FLOORS * floor
    near = np.clip(others[np.isfinite(others)], truth.min() - reach, truth.max() + reach)
    every = np.concatenate([truth, near])
    middle = 0.5 * float(every.min() + every.max())
    half = max(0.6 * float(np.ptp(every)), 0.5 * _FLOORS * floor)
    return middle - half, middle + half


def _unbounded_text(drawn: Track, dofs: list[int]) -> str:
    """Say whether the sets of any of these degrees of freedom are unbounded, and why; else ""."""
    estimates = [drawn.estimates[row] for row in drawn.rows]
    found = [e for e in estimates if not np.isfinite([e.lower[dofs], e.upper[dofs]]).all()]
    if not found:
        return ""
    if drawn.proven.startswith("unbounded"):
        return drawn.proven
    text = "unbounded"
    if len(found) < len(estimates):
        text += f" in {len(found)} of {len(estimates)} frames"
    if any(estimate.status is Status.OK for estimate in found):
        text += drawn.proven.partition("; unbounded")[2]
    doubts = {reason for e in found if e.status is not Status.OK for reason in e.reasons}
    return "; ".join([text, *sorted(doubts)])


def set_title(axes: Axes, lines: Iterable[str], columns: int = _TITLE_COLUMNS) -> None:
    """Set a panel's title to these lines, wrapped to columns; empty ones are left out."""
    wrapped = "\n".join(fill(line, columns) for line in lines if line)
    axes.set_title(wrapped, fontsize=_TITLE_SIZE)


def draw_from_above(axes: Axes, drawn: Track) -> None:
    """Draw x against y: the product of both sets as boxes, for at most about ``BOXES`` frames."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    calibration, _, estimates, truth, rows, _, _ = drawn
    boxes = []
    for row in rows[:: max(1, len(rows) // BOXES)]:
        plane = np.unique(estimates[row].position_boxes()[:, :2], axis=0)
        if np.isfinite(plane).all():
            boxes += [Rectangle((x[0], y[0]), x[1] - x[0], y[1] - y[0]) for x, y in plane]
    axes.add_collection(PatchCollection(boxes, facecolor=BAND, edgecolor=POINT, alpha=0.25))
    points = np.array([_array(estimates[row])[:2] for row in rows])
    axes.plot(*points.T, ".", color=POINT, markersize=3, label="point")
    axes.plot(*truth[rows, :2].T, ".", color=TRUTH, markersize=3, label="truth")
    for dof in range(2):
        floor = _floor(calibration, dof)
        if floor is not None:
            corners = np.repeat(truth[rows[:1], :2], 2, axis=0)
            corners[:, dof] = _still_limits(truth[rows, dof], points[:, dof], floor)
            axes.update_datalim(corners)
            # Ticks so close to each other need many digits, for which there is little room.
            axes.ticklabel_format(style="plain", useOffset=False)
            axes.locator_params(nbins=4)
    axes.set_xlabel("tx (m)")
    axes.set_ylabel("ty (m)")
    axes.set_aspect("equal", "datalim")
    with_sets = ", with the sets of evenly spaced frames" if boxes else ", without sets"
    set_title(axes, [f"x and y{with_sets}", _unbounded_text(drawn, [0, 1])])
    axes.legend(loc="best", fontsize=8)


def _array(estimate: PoseInterval) -> Array:
    """Return the pose (7,) of an estimate; raises UsageError if it has none."""
    if estimate.pose is None:
        raise UsageError(f"frame {estimate.seq} is invalid: it has no pose")
    return estimate.pose.to_array()
