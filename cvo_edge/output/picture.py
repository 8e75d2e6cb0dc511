"""A picture of a run with ground truth, drawn with OpenCV only."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.output.drawing import (
    BITS,
    SCALE,
    Colour,
    draw_cross,
    draw_dot,
    draw_line,
    draw_ring,
    draw_swatch,
    draw_text,
    fixed,
)

Array = NDArray[np.float64]

WIDTH, HEIGHT = 1200, 800

# Palette of Okabe and Ito (2008), safe for colour-blind readers; BGR.
_TRUTH: Colour = (0, 0, 0)
_ESTIMATE: Colour = (178, 114, 0)
_INTERVAL: Colour = (248, 222, 188)  # their sky blue, lighter: lines are drawn on top of it
_OUTLINE: Colour = (233, 180, 86)
_MISSED: Colour = (0, 94, 213)
_MISSED_INTERVAL: Colour = (150, 205, 248)
_NOTHING: Colour = (225, 225, 225)
_MARKED: Colour = (167, 121, 204)
_GRID: Colour = (232, 232, 232)
_FRAME: Colour = (150, 150, 150)

_UNITS = (100.0,) * 3 + (math.degrees(1.0),) * 3
_OUTLINED = 5
_PADDING = 0.08
_INSET = 140


class Span(NamedTuple):
    """Frames to mark, by their positions in the run: the first, the last, and what they show.

    ``image`` is one of them (height, width, 3), BGR, and ``number`` its position.
    """

    first: int
    last: int
    shows: str
    number: int
    image: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class _Compared:
    """A frame with a pose, finite bounds and a true pose; ``number`` is its position in the run.

    ``truth`` and ``point`` (6,) in the estimate's chart, metres and radians.
    """

    number: int
    estimate: PoseInterval
    truth: Array
    point: Array

    @cached_property
    def covered(self) -> NDArray[np.bool_]:
        """Whether the set holds the truth, per DoF (6,)."""
        return self.estimate.conformal_set.covers(self.truth)

    def bands(self, dof: int) -> Sequence[tuple[float, float]]:
        """Disjoint intervals of one DoF, ascending."""
        if self.estimate.bands:
            return self.estimate.bands[dof]
        return ((float(self.estimate.lower[dof]), float(self.estimate.upper[dof])),)


def draw_run(
    estimates: Sequence[PoseInterval],
    truths: Sequence[ArrayLike | None],
    title: str,
    lines: Sequence[str] = (),
    span: Span | None = None,
) -> NDArray[np.uint8]:
    """Draw a run and its ground truth.

    Left: the path in the x-y plane of the world (the view from above if z points up), with the
    boxes of the tx and ty intervals. Right: each DoF *minus the truth* over the frames, in cm and
    deg, so that the zero line is the truth in every chart. Frames without a pose, finite bounds or
    a true pose are grey columns, and a grey stretch of the path.

    Parameters
    ----------
    estimates
        Estimates in the order of the stream.
    truths
        True ``T_world_camera`` (7,) of each estimate, or None if it is unknown.
    title, lines
        A heading and up to three lines below it; printable ASCII only, as OpenCV 4 requires.
    span
        Frames to mark with a bar; its image is shown where it hides least of the path.

    Returns
    -------
    NDArray
        Shape (``HEIGHT``, ``WIDTH``, 3), uint8, BGR.

    Raises
    ------
    UsageError
        No frame has finite bounds and a true pose, or the lists differ in length.
    """
    if len(estimates) != len(truths):
        raise UsageError(
            f"picture: expected one true pose per estimate, found {len(truths)} for "
            f"{len(estimates)} estimates"
        )
    frames = _compared(estimates, truths)
    if not frames:
        raise UsageError(
            f"picture: none of the {len(estimates)} frames has finite bounds and a true pose"
        )
    canvas = np.full((SCALE * HEIGHT, SCALE * WIDTH, 3), 255, np.uint8)
    draw_text(canvas, title, (24, 28), 10.5, bold=True, colour=_TRUTH)
    for number, line in enumerate(lines):
        draw_text(canvas, line, (24, 47 + 17 * number), 6.5)
    _path_from_above(canvas, frames, truths, span)
    names = estimates[0].chart.dof
    for column, heading in enumerate(("Position minus truth (cm)", "Rotation minus truth (deg)")):
        left = 575 + 320 * column
        draw_text(canvas, heading, (left, 105), 7.5, bold=True)
        for row in range(3):
            top = 128 + 211 * row
            panel = (left, top, left + 285, top + 165)
            _error_over_frames(canvas, panel, frames, 3 * column + row, names, len(estimates))
            if span:
                _bar(canvas, panel, span, len(estimates))
        draw_text(canvas, "frame", (left + 142, 748), 6, align=0.5)
    _legend(canvas, greyed=len(frames) < len(estimates), span=span)
    picture = cv2.resize(canvas, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    # 32 levels per channel look the same and reduce the file by a third.
    return np.asarray(picture // 8 * 8 + picture // 32, np.uint8)


def _compared(
    estimates: Sequence[PoseInterval], truths: Sequence[ArrayLike | None]
) -> list[_Compared]:
    found = []
    for number, (estimate, truth) in enumerate(zip(estimates, truths, strict=True)):
        if truth is not None and estimate.pose is not None and estimate.bounded:
            pose = estimate.pose.to_array()
            seen = estimate.chart.coordinates(truth, pose)
            found.append(_Compared(number, estimate, seen, estimate.chart.point(pose)))
    return found


# -------------------------------------------------------------------------------------- panels


@dataclass(frozen=True, eq=False)
class _Panel:
    """A rectangle of the picture (left, top, right, bottom, pixels) with a scale on each axis."""

    canvas: NDArray[np.uint8]
    area: tuple[int, int, int, int]
    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, points: ArrayLike) -> NDArray[np.int32]:
        """Values (n, 2) -> fixed-point pixels (n, 2) of the enlarged canvas."""
        left, top, right, bottom = self.area
        values = np.asarray(points, np.float64)
        x = left + (values[:, 0] - self.x[0]) / (self.x[1] - self.x[0]) * (right - left)
        y = bottom - (values[:, 1] - self.y[0]) / (self.y[1] - self.y[0]) * (bottom - top)
        return fixed(np.stack([x, y], axis=1))

    def box(self, x: tuple[float, float], y: tuple[float, float]) -> NDArray[np.int32]:
        """Return the corners of a rectangle of values, cut at the panel's edge."""
        x = float(np.clip(x[0], *self.x)), float(np.clip(x[1], *self.x))
        y = float(np.clip(y[0], *self.y)), float(np.clip(y[1], *self.y))
        return self.at([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])])

    def grid(self, x_ticks: Array, y_ticks: Array) -> None:
        """Draw grid lines with their numbers, and the frame."""
        left, top, right, bottom = self.area
        for ticks, across in ((x_ticks, False), (y_ticks, True)):
            step = float(ticks[1] - ticks[0]) if len(ticks) > 1 else 1.0
            for value in ticks.tolist():
                ends = [(self.x[0], value), (self.x[1], value)]
                if not across:
                    ends = [(value, self.y[0]), (value, self.y[1])]
                draw_line(self.canvas, self.at(ends), _GRID, 1.0)
                x, y = (self.at(ends)[0] / (SCALE << BITS)).tolist()
                label = f"{value + 0.0:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}"
                if across:
                    draw_text(self.canvas, label, (x - 6, y + 4), 5.5, align=1.0)
                else:
                    draw_text(self.canvas, label, (x, bottom + 16), 5.5, align=0.5)
        corners = [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)]
        draw_line(self.canvas, fixed(corners), _FRAME, 1.0)


def _path_from_above(
    canvas: NDArray[np.uint8],
    frames: Sequence[_Compared],
    truths: Sequence[ArrayLike | None],
    span: Span | None,
) -> None:
    """Draw truth, estimates and boxes of tx and ty; both axes have the same scale."""
    boxes = [np.unique(frame.estimate.position_boxes()[:, :2], axis=0) for frame in frames]
    known = {n: np.asarray(pose)[:2] for n, pose in enumerate(truths) if pose is not None}
    truth = np.array(list(known.values()))
    points = np.array([frame.point[:2] for frame in frames])
    shown = np.concatenate(
        [truth, points, *(each.transpose(0, 2, 1).reshape(-1, 2) for each in boxes)]
    )
    area = (75, 128, 505, 715)
    low, high = shown.min(axis=0), shown.max(axis=0)
    size = np.array([area[2] - area[0], area[3] - area[1]])
    # The extent is zero if the camera stands still and has exact bounds.
    metres_per_pixel = (1 + 2 * _PADDING) * float(np.max((high - low) / size)) or 1e-6
    half = 0.5 * metres_per_pixel * size
    start, end = 0.5 * (low + high) - half, 0.5 * (low + high) + half
    panel = _Panel(canvas, area, (start[0], end[0]), (start[1], end[1]))
    for each in boxes:
        for x, y in each:
            cv2.fillPoly(canvas, [panel.box(tuple(x), tuple(y))], _INTERVAL, cv2.LINE_8, BITS)
    step = _tick_step(float(np.max(end - start)), 8)
    panel.grid(_ticks(panel.x, step), _ticks(panel.y, step))
    every = max(1, len(boxes) // _OUTLINED)
    for each in boxes[::every]:
        for x, y in each:
            corners = panel.box(tuple(x), tuple(y))
            draw_line(canvas, np.concatenate([corners, corners[:1]]), _OUTLINE, 1.0)
    for number in sorted(known.keys() - {frame.number for frame in frames}):
        draw_line(canvas, panel.at(_stretch(known, number)), _NOTHING, 14.0)
    if span:
        for number in sorted(known.keys() & set(range(span.first, span.last + 1))):
            draw_line(canvas, panel.at(_stretch(known, number)), _MARKED, 6.0)
    for frame in frames:
        colour = _OUTLINE if frame.covered[:2].all() else _MISSED
        draw_line(canvas, panel.at([frame.truth[:2], frame.point[:2]]), colour, 1.0)
    draw_line(canvas, panel.at(truth), _TRUTH, 2.0)
    for place in panel.at(points):
        draw_dot(canvas, place, _ESTIMATE)
    missed = [frame.truth[:2] for frame in frames if not frame.covered[:2].all()]
    for place in panel.at(np.reshape(missed, (-1, 2))):
        draw_cross(canvas, place, _MISSED)
    draw_ring(canvas, panel.at(truth[:1])[0], _TRUTH)
    draw_text(canvas, "Path in the x-y plane of the world", (area[0], 105), 7.5, bold=True)
    note = f"outlined: one box in {every}"
    draw_text(canvas, note, (area[2], 120), 5.5, align=1.0)
    if span:
        _inset(canvas, area, span)
    draw_text(canvas, "x (m)", (0.5 * (area[0] + area[2]), 748), 6, align=0.5)
    draw_text(canvas, "y (m)", (area[0], 120), 6, align=1.0)


def _stretch(known: dict[int, Array], number: int) -> Array:
    """Return the part of the path (3, 2) that belongs to a frame: half the way to either side."""
    here = known[number]
    sides = (known.get(other, here) for other in (number - 1, number + 1))
    before, after = (0.5 * (here + side) for side in sides)
    return np.stack([before, here, after])


def _error_over_frames(
    canvas: NDArray[np.uint8],
    area: tuple[int, int, int, int],
    frames: Sequence[_Compared],
    dof: int,
    names: Sequence[str],
    count: int,
) -> None:
    """Draw the intervals and estimates of one DoF minus the truth; zero is the truth."""
    unit = _UNITS[dof]
    bands = [
        [
            (unit * (low - frame.truth[dof]), unit * (high - frame.truth[dof]))
            for low, high in frame.bands(dof)
        ]
        for frame in frames
    ]
    error = [unit * (frame.point[dof] - frame.truth[dof]) for frame in frames]
    low = min(0.0, *error, *(row[0][0] for row in bands))
    high = max(0.0, *error, *(row[-1][1] for row in bands))
    margin = _PADDING * (high - low) or 1.0
    panel = _Panel(canvas, area, (-0.5, count - 0.5), (low - margin, high + margin))
    drawn = {frame.number for frame in frames}
    for number in set(range(count)) - drawn:
        column = panel.box((number - 0.5, number + 0.5), panel.y)
        cv2.fillPoly(canvas, [column], _NOTHING, cv2.LINE_AA, BITS)
    for frame, row in zip(frames, bands, strict=True):
        colour = _INTERVAL if frame.covered[dof] else _MISSED_INTERVAL
        for band in row:
            corners = panel.box((frame.number - 0.5, frame.number + 0.5), band)
            # No anti-aliasing: it would leave seams between neighbours.
            cv2.fillPoly(canvas, [corners], colour, cv2.LINE_8, BITS)
    panel.grid(
        _ticks(panel.x, _tick_step(count, 6)),
        _ticks(panel.y, _tick_step(panel.y[1] - panel.y[0], 5)),
    )
    draw_line(canvas, panel.at([(panel.x[0], 0.0), (panel.x[1], 0.0)]), _TRUTH, 2.0)
    for place in panel.at([(f.number, y) for f, y in zip(frames, error, strict=True)]):
        draw_dot(canvas, place, _ESTIMATE)
    missed = [(frame.number, 0.0) for frame in frames if not frame.covered[dof]]
    for place in panel.at(np.reshape(missed, (-1, 2))):
        draw_cross(canvas, place, _MISSED)
    covered = len(frames) - len(missed)
    draw_text(canvas, names[dof], (area[0], area[1] - 6), 7, bold=True)
    note = f"truth inside in {covered} of {len(frames)} frames"
    draw_text(canvas, note, (area[2], area[1] - 6), 5.5, align=1.0)


def _bar(
    canvas: NDArray[np.uint8], area: tuple[int, int, int, int], span: Span, count: int
) -> None:
    """Mark frames of a panel at its lower edge."""
    panel = _Panel(canvas, area, (-0.5, count - 0.5), (0.0, 1.0))
    corners = panel.box((span.first - 0.5, span.last + 0.5), (0.0, 0.05))
    cv2.fillPoly(canvas, [corners], _MARKED, cv2.LINE_AA, BITS)


def _inset(canvas: NDArray[np.uint8], area: tuple[int, int, int, int], span: Span) -> None:
    """Show the image of a span in the emptiest corner of a panel."""
    left, top, right, bottom = area
    width = _INSET
    height = round(width * span.image.shape[0] / span.image.shape[1])
    places = [
        (x, y) for x in (right - width - 8, left + 8) for y in (top + 8, bottom - height - 24)
    ]

    def part(place: tuple[int, int], below: int = 0) -> NDArray[np.uint8]:
        x, y = (SCALE * value for value in place)
        return canvas[y : y + SCALE * (height + below), x : x + SCALE * width]

    # Any colour but white and that of the grid.
    x, y = min(places, key=lambda place: int((part(place, 18).min(axis=2) < min(_GRID)).sum()))
    size = (SCALE * width, SCALE * height)
    part((x, y))[:] = cv2.resize(span.image, size, interpolation=cv2.INTER_AREA)
    corners = fixed([(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)])
    draw_line(canvas, corners, _MARKED, 2.0)
    draw_text(canvas, f"frame {span.number}", (x + width / 2, y + height + 14), 5.5, align=0.5)


def _legend(canvas: NDArray[np.uint8], *, greyed: bool, span: Span | None) -> None:
    y = 774
    draw_line(canvas, fixed([(75, y), (105, y)]), _TRUTH, 2.0)
    draw_ring(canvas, fixed([(75, y)])[0], _TRUTH)
    draw_text(canvas, "truth (ring: start)", (113, y + 4), 6)
    draw_dot(canvas, fixed([(255, y)])[0], _ESTIMATE)
    draw_text(canvas, "estimate", (266, y + 4), 6)
    draw_swatch(canvas, 345, y, _INTERVAL)
    draw_text(canvas, "interval that holds the truth", (383, y + 4), 6)
    draw_swatch(canvas, 595, y, _MISSED_INTERVAL)
    draw_cross(canvas, fixed([(610, y)])[0], _MISSED)
    draw_text(canvas, "truth outside the interval", (633, y + 4), 6)
    if greyed:
        draw_swatch(canvas, 830, y, _NOTHING)
        draw_text(canvas, "no interval or no truth", (868, y + 4), 6)
    if span:
        draw_swatch(canvas, 1040, y, _MARKED)
        draw_text(canvas, span.shows, (1078, y + 4), 6)


def _tick_step(extent: float, most: int) -> float:
    """Return the smallest 1, 2 or 5 times a power of ten that gives at most ``most`` steps."""
    power: float = 10.0 ** math.floor(math.log10(extent / most))
    return next(
        power * factor for factor in (1.0, 2.0, 5.0, 10.0) if extent <= most * power * factor
    )


def _ticks(bounds: tuple[float, float], step: float) -> Array:
    first, last = math.ceil(bounds[0] / step), math.floor(bounds[1] / step)
    return step * np.arange(first, last + 1, dtype=np.float64)
