"""Pictures of a study: sets over one and two dimensions, the tube under noise, and curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cvo_export.plot import BAND, POINT, TRUTH, Track, draw_dof, draw_from_above

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

Array = NDArray[np.float64]

# Colours that differ for colour-blind readers, too (Okabe and Ito 2008).
_LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_COLUMNS = 4
# More hide one another and the flight.
_TUBE_BOXES = 25


def comparison(tracks: Mapping[str, Track]) -> Figure:
    """Draw for each method the sets of x over the frames, and of x and y from above."""
    figure = _figure(3.8 * len(tracks), 7.0)
    axes = figure.subplots(2, len(tracks), squeeze=False)
    for column, (method, track) in enumerate(tracks.items()):
        draw_dof(axes[0, column], track, 0)
        draw_from_above(axes[1, column], track)
        axes[0, column].set_title(method)
        # All in the scale of the first, so that widths can be compared.
        axes[0, column].set_ylim(axes[0, 0].get_ylim())
        axes[1, column].set_title("")
    return figure


def tube(tracks: Mapping[str, Track]) -> Figure:
    """Draw for each noise the boxes of x, y and z around the flight, all in one scale."""
    rows = -(-len(tracks) // _COLUMNS)
    figure = _figure(4.2 * min(_COLUMNS, len(tracks)), 4.4 * rows)
    first = next(iter(tracks.values()))
    flight = first.truth[first.rows, :3]
    centre = 0.5 * (flight.min(axis=0) + flight.max(axis=0))
    reach = 0.6 * (np.ptp(flight, axis=0) + _widths(first)).max()
    for number, (name, track) in enumerate(tracks.items(), 1):
        axes = figure.add_subplot(rows, min(_COLUMNS, len(tracks)), number, projection="3d")
        for row in track.rows[:: max(1, len(track.rows) // _TUBE_BOXES)]:
            _draw_box(axes, track.estimates[row].lower[:3], track.estimates[row].upper[:3])
        axes.plot(*track.truth[track.rows, :3].T, color=TRUTH, linewidth=1.5)
        width = 100 * _widths(track).mean()
        axes.set_title(f"{name}: median width {width:.1f} cm", fontsize=10)
        for axis, middle in zip("xyz", centre, strict=True):
            getattr(axes, f"set_{axis}lim")(middle - reach, middle + reach)
            getattr(axes, f"set_{axis}label")(f"{axis} (m)")
    return figure


def curves(
    x_label: str, x: Sequence[object], panels: Mapping[str, Mapping[str, Sequence[float]]]
) -> Figure:
    """Draw panels of lines: panel -> line -> a value for each x; values of x evenly spaced."""
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
