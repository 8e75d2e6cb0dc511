"""What an estimate says, drawn on its image: for a robot's screen, or a video of a run.

A frame that is vouched for shows its position, the axes of the world and one bar for each degree of
freedom. Any other frame shows its status and reasons alone, on a darkened grey image, so that it
cannot be mistaken for one with an interval.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import UsageError
from cvo_edge.record import Record, Status

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

# BGR, as OpenCV draws.
_GREEN, _ORANGE, _RED, _WHITE = (90, 210, 90), (0, 165, 255), (70, 70, 240), (235, 235, 235)
_DIM = (150, 150, 150)
_AXES: tuple[tuple[str, Colour], ...] = (("x", _RED), ("y", _GREEN), ("z", (255, 150, 60)))
_FONT = cv2.FONT_HERSHEY_SIMPLEX
TO_CM_OR_DEG = (100.0,) * 3 + (math.degrees(1.0),) * 3
# Lines of text are this share of the image's height, but never too small to read.
_LINE_SHARE, _LEAST_LINE_PX = 1 / 24, 13
_LEAST_SIDE = 16


class Vouched(NamedTuple):
    """What only a frame with a bounded interval shows.

    ``dof``: six names; ``pieces``: for each of them the set relative to the pose, m and rad;
    ``R_camera_world`` (3, 3).
    """

    dof: Sequence[str]
    pieces: Sequence[Sequence[tuple[float, float]]]
    R_camera_world: NDArray[np.float64]


def draw(image: NDArray[Any], record: Record, vouched: Vouched | None) -> Image:
    """Return a BGR copy of an image with what the record of its frame says.

    ``image`` is grey, BGR or BGRA of 8 or 16 bits and at least 16 pixels a side; bars need
    160 x 120. Raises UsageError for another one.
    """
    canvas = _as_bgr(image)
    if vouched is None:
        grey = cv2.cvtColor(canvas, cv2.COLOR_BGR2GRAY) // 2
        canvas = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
    pen = _Pen(canvas)
    colour = {Status.INVALID: _RED, Status.DEGRADED: _ORANGE}.get(
        record.status, _ORANGE if vouched is None else _GREEN
    )
    pen.frame(colour)
    if vouched is None:
        pen.lines([_title(record), *record.reasons], colour)
    else:
        pen.lines([_title(record), _position(record), *record.reasons], colour)
        pen.bars(vouched)
        pen.axes(vouched.R_camera_world)
    return canvas


def _as_bgr(image: NDArray[Any]) -> Image:
    shape: tuple[int, ...] = getattr(image, "shape", ())
    kind = getattr(image, "dtype", None)
    if (
        len(shape) not in (2, 3)
        or (len(shape) == 3 and shape[2] not in (1, 3, 4))
        or min(shape[:2]) < _LEAST_SIDE
        or kind not in (np.uint8, np.uint16)
    ):
        found = f"shape {tuple(shape)}, {kind}" if kind is not None else type(image).__name__
        raise UsageError(
            f"image: expected a grey or BGR image of 8 or 16 bits, at least {_LEAST_SIDE} pixels a "
            f"side, found {found}"
        )
    values = np.ascontiguousarray(image >> 8 if kind == np.uint16 else image).astype(np.uint8)
    if values.ndim == 2 or values.shape[2] == 1:
        return np.asarray(cv2.cvtColor(values.reshape(shape[:2]), cv2.COLOR_GRAY2BGR), np.uint8)
    return np.array(values[..., :3], order="C")


def _title(record: Record) -> str:
    interval, unbounded = record.interval, ""
    if record.status is Status.OK and interval is not None:
        unbounded = "" if interval.bounded else " unbounded"
        return f"ok {interval.confidence:g} {interval.scope}{unbounded}  #{record.seq}"
    return f"{record.status.upper()}  #{record.seq}"


def _position(record: Record) -> str:
    return "" if record.pose is None else " ".join(f"{v:.2f}" for v in record.pose.t_m) + " m"


class _Pen:
    """Draws on a canvas, in sizes that follow from it."""

    def __init__(self, canvas: Image) -> None:
        self._canvas = canvas
        self._height, self._width = canvas.shape[:2]
        self._line = max(_LEAST_LINE_PX, round(_LINE_SHARE * self._height))
        self._edge = max(2, self._line // 5)
        # The fonts of OpenCV 4 and 5 differ in both.
        (wide, tall), _ = cv2.getTextSize("0", _FONT, 1.0, 1)
        self._scale = self._line * min(0.66 / tall, 0.48 / wide)
        self._stroke = max(1, self._line // 16)

    def frame(self, colour: Colour) -> None:
        """Draw a frame in the colour of the status."""
        corner = (self._width - 1, self._height - 1)
        cv2.rectangle(self._canvas, (0, 0), corner, colour, 2 * self._edge)

    def lines(self, texts: Sequence[str], colour: Colour) -> None:
        """Write lines from the top, the first in the colour of the status."""
        room = max(1, (self._height // 2 - self._edge) // self._line)
        shown = [text for text in texts if text]
        if len(shown) > room:
            shown = [*shown[: room - 1], f"+{len(shown) - room + 1}"] if room > 1 else shown[:1]
        self._darken(self._edge, len(shown) * self._line)
        for row, text in enumerate(shown):
            base = self._edge + (row + 1) * self._line - self._line // 5
            room_px = self._width - 4 * self._edge
            self._write(text, 2 * self._edge, base, colour if row == 0 else _WHITE, room_px)

    def bars(self, vouched: Vouched) -> None:
        """Draw two columns of three bars at the bottom: translation and rotation."""
        top = self._height - self._edge - 4 * self._line
        if self._height < 9 * self._line or self._width < 12 * self._line:
            return
        self._darken(top, 4 * self._line)
        for column, unit in enumerate(("cm", "deg")):
            rows = range(3 * column, 3 * column + 3)
            scaled = [
                [TO_CM_OR_DEG[row] * np.array(p) for p in vouched.pieces[row]] for row in rows
            ]
            reach = max(float(np.abs(piece).max()) for row in scaled for piece in row)
            full = round_up(reach)
            left = 2 * self._edge + column * (self._width // 2)
            base = top + self._line - self._line // 5
            right = left + self._width // 2 - 3 * self._edge
            self._write(f"bar: +-{full:g} {unit}", left, base, _DIM, right - left)
            for row, (dof, pieces) in enumerate(zip(rows, scaled, strict=True)):
                base = top + (row + 2) * self._line - self._line // 5
                self._bar(vouched.dof[dof], pieces, full, (left, right), base)

    def _bar(
        self,
        name: str,
        pieces: Sequence[NDArray[np.float64]],
        full: float,
        sides: tuple[int, int],
        base: int,
    ) -> None:
        half = 0.5 * (pieces[-1][1] - pieces[0][0])
        mark = "*" if len(pieces) > 1 else ""
        figure = f"{half:.{2 if half < 1.0 else 1 if half < 100.0 else 0}f}{mark}"
        letter = cv2.getTextSize("0", _FONT, self._scale, self._stroke)[0][0]
        self._write(name, sides[0], base, _WHITE, 5 * letter)
        self._write(figure, sides[1] - 5 * letter, base, _WHITE, 5 * letter)
        begin, end = sides[0] + round(letter * (len(name) + 0.7)), sides[1] - round(5.7 * letter)
        middle, reach, y = (begin + end) // 2, (end - begin) // 2, base - self._line // 4
        if reach < 4:
            return
        cv2.line(self._canvas, (begin, y), (end, y), _DIM, 1)
        thick = max(1, self._line // 6)
        for low, high in pieces:
            a, b = (middle + round(reach * float(value) / full) for value in (low, high))
            cv2.rectangle(self._canvas, (a, y - thick), (max(a, b), y + thick), _GREEN, -1)
        cv2.line(self._canvas, (middle, y - 2 * thick), (middle, y + 2 * thick), _WHITE, 1)

    def axes(self, R_camera_world: NDArray[np.float64]) -> None:
        """Draw the axes of the world as the camera sees their directions, at the right edge."""
        reach = 2 * self._line
        if self._height < 14 * self._line or self._width < 14 * self._line:
            return
        centre = np.array([self._width - self._edge - 1.6 * reach, self._height / 2.0])
        # The nearest axis is drawn last.
        for axis in np.argsort(-R_camera_world[2]):
            name, colour = _AXES[axis]
            tip = centre + reach * R_camera_world[:2, axis]
            begin, end = (tuple(np.round(p).astype(int).tolist()) for p in (centre, tip))
            cv2.arrowedLine(
                self._canvas, begin, end, colour, 1 + self._stroke, cv2.LINE_AA, 0, 0.15
            )
            place = np.round(centre + 1.25 * reach * R_camera_world[:2, axis]).astype(int)
            self._write(name, place[0] - self._line // 3, place[1] + self._line // 3, colour)

    def _write(self, text: str, x: int, base: int, colour: Colour, room: int | None = None) -> None:
        scale = self._scale
        width = cv2.getTextSize(text, _FONT, scale, self._stroke)[0][0]
        if room is not None and width > room:
            scale *= room / width
        place = (int(x), int(base))
        cv2.putText(self._canvas, text, place, _FONT, scale, colour, self._stroke, cv2.LINE_AA)

    def _darken(self, top: int, height: int) -> None:
        part = self._canvas[top : top + height, self._edge : self._width - self._edge]
        part[:] = part // 4


def round_up(value: float) -> float:
    """Return the next of 1, 2, 5, 10, ... times a power of ten."""
    if not 0.0 < value < 1e12:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if value <= 1.0000001 * step * power)
