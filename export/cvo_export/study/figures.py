"""Figures of a study: sets over frames and from above, the tube under noise, and curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cvo_export.plot import (
    BAND,
    BOXES,
    MISSED,
    POINT,
    TRUTH,
    Track,
    draw_bands,
    draw_dof,
    draw_from_above,
    set_title,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

Array = NDArray[np.float64]

# A palette for colour-blind readers (Okabe and Ito 2008).
_LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_COLUMNS = 4
# Characters in a line of the title of a method's panel.
_TITLE_COLUMNS = 42
# More boxes would hide the flight.
_TUBE_BOXES = 25
# Fraction of the flight's extent: smaller boxes are indistinguishable from the line.
_VISIBLE = 0.06
# Limit of the axes, as a multiple of the widest method's 90 % quantile.
_REACH = 1.2


def comparison(tracks: Mapping[str, Track]) -> Figure:
    """Draw each method's sets of x over the frames, and of x and y from above.

    Both are drawn twice: absolute in metres, and relative to the truth in centimetres to show the
    widths.
    """
    figure = _figure(3.8 * len(tracks), 13.0)
    axes = figure.subplots(4, len(tracks), squeeze=False)
    reach = _REACH * max(_usual_reach(track) for track in tracks.values())
    for column, (method, track) in enumerate(tracks.items()):
        draw_dof(axes[0, column], track, 0)
        _draw_about_truth(axes[1, column], track, reach)
        draw_from_above(axes[2, column], track)
        _draw_plane_about_truth(axes[3, column], track, reach)
        notes = axes[0, column].get_title().splitlines()
        set_title(axes[0, column], [method, *notes], _TITLE_COLUMNS)
        axes[2, column].set_title("")
    # Use one scale for all methods so that widths are comparable.
    limits = np.array([panel.get_ylim() for panel in axes[0]])
    for panel in axes[0]:
        panel.set_ylim(limits[:, 0].min(), limits[:, 1].max())
    return figure


def _usual_reach(track: Track) -> float:
    """90 % quantile of the distance from the truth to the ends of the sets of x, centimetres."""
    ends = [(track.estimates[r].lower[0], track.estimates[r].upper[0]) for r in track.rows]
    distance = 100.0 * np.abs(np.array(ends) - track.truth[track.rows, :1])
    bounded = distance[np.isfinite(distance)]
    return float(np.quantile(bounded, 0.9)) if bounded.size else 100.0


def _draw_about_truth(axes: Axes, track: Track, reach: float) -> None:
    """Draw the set of x minus the truth over the frames, in centimetres."""
    places: list[int] = []
    ends: list[Array] = []
    missed = []
    for row in track.rows:
        estimate, truth = track.estimates[row], track.truth[row, 0]
        bands = estimate.bands[0] if estimate.bands else ((estimate.lower[0], estimate.upper[0]),)
        for band in bands:
            places.append(row)
            ends.append(100.0 * (np.array(band) - truth))
        if not estimate.conformal_set.covers(track.truth[row])[0]:
            missed.append(row)
    draw_bands(axes, places, ends, (-reach, reach))
    axes.axhline(0.0, color=TRUTH, linewidth=0.9)
    axes.plot(missed, np.zeros(len(missed)), "x", color=MISSED, markersize=5)
    axes.set_ylim(-reach, reach)
    axes.set_ylabel("set of tx minus truth (cm)")
    axes.set_xlabel("frame")
    axes.margins(x=0.01)


def _draw_plane_about_truth(axes: Axes, track: Track, reach: float) -> None:
    """Draw the sets of x and y minus the truth as boxes, in centimetres."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    boxes = []
    for row in track.rows[:: max(1, len(track.rows) // BOXES)]:
        plane = np.unique(track.estimates[row].position_boxes()[:, :2], axis=0)
        plane = 100.0 * (plane - track.truth[row, :2][np.newaxis, :, np.newaxis])
        if np.isfinite(plane).all():
            boxes += [Rectangle((x[0], y[0]), x[1] - x[0], y[1] - y[0]) for x, y in plane]
    axes.add_collection(PatchCollection(boxes, facecolor=BAND, edgecolor=POINT, alpha=0.2))
    axes.plot(0.0, 0.0, "+", color=TRUTH, markersize=10)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_aspect("equal")
    axes.set_xlabel("tx minus truth (cm)")
    axes.set_ylabel("ty minus truth (cm)")


def tube(tracks: Mapping[str, Track]) -> Figure:
    """Draw the boxes of x, y and z around the flight for each noise, all at the same scale.

    Boxes too small to see are enlarged by a common factor, which the title states.
    """
    rows = -(-len(tracks) // _COLUMNS)
    figure = _figure(4.2 * min(_COLUMNS, len(tracks)), 4.4 * rows)
    first = next(iter(tracks.values()))
    flight = first.truth[first.rows, :3]
    centre = 0.5 * (flight.min(axis=0) + flight.max(axis=0))
    extent = float(np.ptp(flight, axis=0).max())
    width = _widths(first)
    # Unbounded sets have no finite width.
    usual = float(width[np.isfinite(width)].mean()) if np.isfinite(width).any() else extent
    times = max(1, int(_VISIBLE * extent / max(usual, 1e-9)))
    reach = 0.6 * (extent + times * usual)
    for number, (name, track) in enumerate(tracks.items(), 1):
        axes = figure.add_subplot(rows, min(_COLUMNS, len(tracks)), number, projection="3d")
        for row in track.rows[:: max(1, len(track.rows) // _TUBE_BOXES)]:
            low, high = track.estimates[row].lower[:3], track.estimates[row].upper[:3]
            spare = 0.5 * (times - 1) * (high - low)
            _draw_box(axes, low - spare, high + spare)
        axes.plot(*track.truth[track.rows, :3].T, color=TRUTH, linewidth=1.5)
        title = f"{name}: median width {100 * _widths(track).mean():.1f} cm"
        axes.set_title(title + (f", drawn {times} times" if times > 1 else ""), fontsize=10)
        for axis, middle in zip("xyz", centre, strict=True):
            getattr(axes, f"set_{axis}lim")(middle - reach, middle + reach)
            getattr(axes, f"set_{axis}label")(f"{axis} (m)")
            axes.locator_params(axis, nbins=4)
        axes.set_box_aspect(None, zoom=0.85)
    return figure


def curves(
    x_label: str, x: Sequence[object], panels: Mapping[str, Mapping[str, Sequence[float]]]
) -> Figure:
    """Draw panels of lines: panel -> line -> a value for each x; x values are evenly spaced."""
    figure = _figure(3.6 * len(panels), 3.6)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for panel, (name, lines) in zip(axes, panels.items(), strict=True):
        for number, (label, values) in enumerate(lines.items()):
            colour = _LINES[number % len(_LINES)]
            panel.plot(range(len(x)), values, "o-", color=colour, label=label, markersize=4)
        panel.set_xticks(range(len(x)), [str(value) for value in x], rotation=30)
        panel.set_xlabel(x_label)
        panel.set_title(name, fontsize=10)
        if name.startswith("coverage"):
            panel.axhline(0.9, color=TRUTH, linewidth=0.8, linestyle=":")
        else:
            panel.set_ylim(bottom=0.0)
    axes[0].legend(fontsize=8)
    return figure


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _widths(track: Track) -> Array:
    """Median widths of x, y and z, (3,), in metres."""
    widths = [track.estimates[row].upper[:3] - track.estimates[row].lower[:3] for row in track.rows]
    return np.asarray(np.median(widths, axis=0))


def _draw_box(axes: Axes3D, low: Array, high: Array) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    if not np.isfinite((low, high)).all():
        return
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    points = low + corners * (high - low)
    faces = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    sides = [points[list(face)].tolist() for face in faces]
    axes.add_collection3d(
        Poly3DCollection(sides, facecolor=BAND, edgecolor=POINT, linewidth=0.3, alpha=0.06)
    )
