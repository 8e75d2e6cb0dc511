"""Plot a bundle on a data set: truth, point estimate and set over time, and a top view."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration
from cvo_edge.engine.loading import read_bundle
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.files import whole_file
from cvo_edge.input.frame import Frame
from cvo_edge.odometer import Odometer
from cvo_edge.pose import Chart
from cvo_edge.vocabulary import Scope
from cvo_export.datasets import PoseDataset
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
    as are degrees of freedom whose sets are much narrower than the motion.
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
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise UsageError(
            'plot: matplotlib is not installed; pip install "cvo-export[plot]"'
        ) from None
    known = FigureCanvasAgg(Figure()).get_supported_filetypes()
    if out.suffix[1:].lower() not in known or out.is_dir():
        raise UsageError(
            f"out: expected a file name ending in .{', .'.join(sorted(known))}, found {out}"
        )
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
        figure.savefig(stream, format=out.suffix[1:], dpi=_DPI)


class Track(NamedTuple):
    """A bundle's estimates for n frames, with the truth.

    ``truth`` (n, 6) holds the true poses in the bundle's chart, NaN for frames without an
    estimate; ``rows`` are the positions of the frames whose estimate has a pose; ``parts`` (n,)
    counts the parts in which the frames follow each other in one recording.
    """

    calibration: Calibration
    chart: Chart
    estimates: list[PoseInterval]
    truth: Array
    rows: list[int]
    parts: NDArray[np.int64]


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
        return Track(odometer.calibration, odometer.chart, estimates, truth, rows, parts)


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

    ``relative`` draws offsets from the point.
    """
    _, chart, estimates, truth, rows, parts = drawn
    scale, unit = (1.0, "m") if dof < 3 else (float(np.rad2deg(1.0)), "deg")
    point = np.array([chart.point(_array(estimates[row]))[dof] for row in rows])
    about = dof > 2 and chart.rotation == "tangent_predicted"
    origin = np.zeros(len(estimates))
    if relative:
        about, scale, unit = True, *((100.0, "cm") if dof < 3 else (scale, unit))
        origin[rows] = point
    values = scale * (truth[:, dof] - origin)
    shown = values[rows]
    spread = max(float(np.ptp(shown)), 1e-6)
    low, high = shown.min() - spread, shown.max() + spread
    bottoms, heights, places, missed = [], [], [], []
    for row in rows:
        estimate = estimates[row]
        bands = (
            estimate.bands[dof] if estimate.bands else ((estimate.lower[dof], estimate.upper[dof]),)
        )
        for start, end in bands:
            bottom, top = np.clip(scale * (np.array([start, end]) - origin[row]), low, high)
            bottoms.append(bottom)
            heights.append(top - bottom)
            places.append(row)
        # An ellipsoidal region holds all six degrees of freedom or misses them together.
        whole = estimate.conformal_set.ellipsoids
        if not (
            whole.contains(truth[row]) if whole else estimate.conformal_set.covers(truth[row])[dof]
        ):
            missed.append(row)
    axes.bar(places, heights, 1.0, bottoms, color=BAND, alpha=0.6, linewidth=0, label="set")
    cuts = np.flatnonzero(np.diff(parts[rows])) + 1
    with_gaps = np.insert(np.array(rows, dtype=np.float64), cuts, np.nan)
    for line, color, name in (
        (scale * (point - origin[rows]), POINT, "point"),
        (shown, TRUTH, "truth"),
    ):
        axes.plot(with_gaps, np.insert(line, cuts, np.nan), color=color, linewidth=0.9, label=name)
    regions = any(estimates[row].conformal_set.ellipsoids for row in rows)
    label = "outside the six-DoF region" if regions else "missed"
    axes.plot(missed, values[missed], "x", color=MISSED, markersize=5, label=label)
    axes.set_ylim(shown.min() - 0.4 * spread, shown.max() + 0.4 * spread)
    kind = " about the prediction" if about else ""
    axes.set_ylabel(f"{chart.dof[dof]} ({unit}){kind}")
    axes.set_xlabel("frame")
    axes.margins(x=0.01)
    if dof == 0:
        axes.legend(loc="best", ncols=4, fontsize=8)


def draw_from_above(axes: Axes, drawn: Track) -> None:
    """Draw x against y: the product of both sets as boxes, for at most about ``BOXES`` frames."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    _, _, estimates, truth, rows, _ = drawn
    boxes = []
    for row in rows[:: max(1, len(rows) // BOXES)]:
        plane = np.unique(estimates[row].position_boxes()[:, :2], axis=0)
        if np.isfinite(plane).all():
            boxes += [Rectangle((x[0], y[0]), x[1] - x[0], y[1] - y[0]) for x, y in plane]
    axes.add_collection(PatchCollection(boxes, facecolor=BAND, edgecolor=POINT, alpha=0.25))
    points = np.array([_array(estimates[row])[:2] for row in rows])
    axes.plot(*points.T, ".", color=POINT, markersize=3, label="point")
    axes.plot(*truth[rows, :2].T, ".", color=TRUTH, markersize=3, label="truth")
    axes.set_xlabel("tx (m)")
    axes.set_ylabel("ty (m)")
    axes.set_aspect("equal", "datalim")
    axes.set_title("x and y, with the sets of evenly spaced frames", fontsize=10)
    axes.legend(loc="best", fontsize=8)


def _array(estimate: PoseInterval) -> Array:
    """Return the pose (7,) of an estimate; raises UsageError if it has none."""
    if estimate.pose is None:
        raise UsageError(f"frame {estimate.seq} is invalid: it has no pose")
    return estimate.pose.to_array()
