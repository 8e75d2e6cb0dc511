"""The picture of an audit: a path with its tube, errors and intervals by horizon, coverage."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import UsageError
from cvo_edge.files import picture_metadata, whole_file
from cvo_edge.motion.audit import Audit, scaled
from cvo_edge.motion.intervals import Level, MotionCalibration, MotionWindow
from cvo_edge.motion.pairs import Pair
from cvo_edge.motion.recordings import trace_of
from cvo_edge.motion.relative import motion, norms, residual, rotated
from cvo_edge.motion.trace import Rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Colours that colour-blind readers can tell apart (Okabe and Ito 2008).
_TRUTH, _ESTIMATE, _INSIDE, _OUTSIDE = "#000000", "#0072B2", "#56B4E9", "#D55E00"
_DPI = 130
# Circles of a tube that are drawn.
_CIRCLES = 400
# Of the extent of a drive: radius of a tube that can be seen.
_VISIBLE = 0.02


def draw_audit(
    path: Path,
    calibration: MotionCalibration,
    level: Level,
    pairs: Sequence[Pair],
    report: Audit,
) -> None:
    """Write a PNG file; the path is that of the first recording, from above.

    Raises UsageError without matplotlib and SinkError if the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise UsageError(
            '--picture: matplotlib is not installed; pip install "cvo-edge[plot]"'
        ) from None
    figure = Figure(figsize=(15.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    above, growth, coverage = figure.subplots(1, 3)
    _draw_path(above, calibration, level, pairs[0])
    _draw_horizons(growth, calibration, level, pairs)
    _draw_coverage(coverage, report)
    figure.suptitle(f"{calibration.file.name}: {level.confidence:g} {level.rule}, {level.scope}")
    with whole_file(path) as stream:
        figure.savefig(stream, format="png", dpi=_DPI, metadata=picture_metadata(".png"))


def _draw_path(axes: Axes, calibration: MotionCalibration, level: Level, pair: Pair) -> None:
    """Draw the truth and, window after window, the tube around the estimate from its anchor on."""
    from matplotlib.patches import Circle

    truth = pair.truth
    spread = np.nanmax(truth[:, :3], axis=0) - np.nanmin(truth[:, :3], axis=0)
    # Of the three axes, the two along which the drive is longest.
    first, second = sorted(np.argsort(spread)[1:].tolist())
    title = f"{pair.name} from above"
    if calibration.windows:
        window = calibration.windows[0]
        title += f": tubes of {window.spec.window}"
        rows = trace_of(scaled(calibration, pair), calibration.limits, calibration.file.columns)
        spans = _windows(rows, truth, window)
        # A tube of a metre is invisible on a drive of a kilometre.
        wide = window.end_radii(level)[0]
        times = max(1, round(_VISIBLE * float(spread.max()) / wide)) if np.isfinite(wide) else 1
        title += f", deviations x {times}" * (times > 1)
        every = max(1, sum(len(ends) for _, ends in spans) // _CIRCLES)
        for anchor, ends in spans:
            moved = motion(rows.poses[anchor], rows.poses[ends])
            start = truth[anchor]
            seen = start[:3] + rotated(np.tile(start[3:], (len(ends), 1)), moved[:, :3])
            centre = truth[ends, :3] + times * (seen - truth[ends, :3])
            radii = window.tube(rows, np.full(len(ends), anchor), ends, level)[6]
            off = norms(residual(moved, motion(truth[anchor], truth[ends])))[:, 0]
            for place in range(0, len(ends), every):
                if np.isfinite(radii[place]):
                    colour = _OUTSIDE if off[place] > radii[place] else _INSIDE
                    middle = (float(centre[place, first]), float(centre[place, second]))
                    size = times * radii[place]
                    circle = Circle(middle, size, color=colour, alpha=0.25, lw=0.0)
                    axes.add_patch(circle)
            axes.plot(centre[:, first], centre[:, second], color=_ESTIMATE, lw=1.0)
    axes.plot(truth[:, first], truth[:, second], color=_TRUTH, lw=0.8)
    axes.set_aspect("equal", "datalim")
    axes.set_title(title)
    axes.set_xlabel(f"{'xyz'[first]} (m)")
    axes.set_ylabel(f"{'xyz'[second]} (m)")


def _windows(rows: Rows, truth: Array, window: MotionWindow) -> list[tuple[int, Integers]]:
    """Return windows that follow each other: the row of the anchor and those up to its end."""
    along = window.window.along(rows.stamps_ns, rows.path_m)
    known = np.flatnonzero(np.isfinite(truth).all(axis=1) & np.isfinite(rows.poses).all(axis=1))
    found, last = [], -1
    for row in known.tolist():
        if row > last:
            last = int(np.searchsorted(along, along[row] + window.window.value, side="right")) - 1
            found.append((row, np.arange(row, last + 1)))
    return found


def _draw_horizons(
    axes: Axes, calibration: MotionCalibration, level: Level, pairs: Sequence[Pair]
) -> None:
    """Draw for each horizon the errors' quantiles against the radius of the position."""
    names = [each.spec.horizon for each in calibration.horizons]
    for place, horizon in enumerate(calibration.horizons):
        errors, radii = [], []
        for pair in pairs:
            own = scaled(calibration, pair)
            rows, truth = trace_of(own, calibration.limits, calibration.file.columns), pair.truth
            found = horizon.intervals(rows, level)
            off = residual(found.moved, motion(truth[found.start], truth[found.end])) - found.bias
            fine = np.isfinite(off).all(axis=1)
            errors.append(norms(off[fine])[:, 0])
            radii.append(found.radii[fine, 0])
        every, radius = np.concatenate(errors), np.concatenate(radii)
        if len(every):
            low, high = np.quantile(every, [0.5, level.confidence])
            axes.vlines(place - 0.1, low, high, color=_TRUTH, lw=5.0)
            axes.plot([place + 0.1], [radius.mean()], "o", color=_ESTIMATE)
    axes.set_yscale("log")
    axes.set_xticks(range(len(names)), names)
    axes.set_title(f"position error: median to {level.confidence:g}; dot: mean radius")
    axes.set_ylabel("m")


def _draw_coverage(axes: Axes, report: Audit) -> None:
    """Draw the coverage of each recording, a mark for each horizon."""
    names = [each.name for each in report.recordings]
    for recording, place in zip(report.recordings, range(len(names)), strict=True):
        shares = [float(np.mean(each.dof)) for each in recording.horizons if each.motions]
        axes.plot([place] * len(shares), shares, "_", color=_ESTIMATE, ms=14.0, mew=2.0)
    axes.axhline(report.confidence, color=_TRUTH, lw=0.8)
    axes.set_ylim(min(0.5, axes.get_ylim()[0]), 1.0)
    axes.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=8)
    axes.set_title("coverage of each recording, one mark a horizon")
