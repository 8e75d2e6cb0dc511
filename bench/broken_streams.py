"""Streams that freeze, stutter or tear: kinds of wrong frames that need earlier images."""

from __future__ import annotations

import cv2
import numpy as np
from altered import Image, Random, shown
from moments import LEAD, Change, Kind, Moment, as_jpeg, each, light_noise

# -- frozen ---------------------------------------------------------------------------------------


def ring(buffers: int) -> Kind:
    """The last images before the fault come again and again."""
    start = max(buffers, LEAD)

    def change(moment: Moment) -> Image:
        return moment.past[start - buffers + moment.number % buffers]

    name = "frozen" if buffers == 1 else f"ring of {buffers} buffers"
    return Kind("frozen", name, change, start, still=buffers == 1)


def _still(moment: Moment) -> Image:
    return moment.past[LEAD - 1]


def _rows_frozen(top: float, bottom: float) -> Change:
    def change(moment: Moment) -> Image:
        rows = slice(*(round(share * len(moment.image)) for share in (top, bottom)))
        found = moment.image.copy()
        found[rows] = _still(moment)[rows]
        return found

    return change


def _clock(moment: Moment) -> Image:
    found = _still(moment).copy()
    width = found.shape[1]
    text = f"12:{moment.number // 60 % 60:02d}:{moment.number % 60:02d}.{moment.number * 37 % 100}"
    place = round(0.6 * width), round(0.06 * width)
    cv2.putText(found, text, place, cv2.FONT_HERSHEY_SIMPLEX, width / 640, (255,) * 3, 2)
    return found


def _loop_with_noise(moment: Moment) -> Image:
    start = 2 * LEAD
    return light_noise(moment.past[moment.number % start], moment.fresh)


def _stillas_jpeg(moment: Moment) -> Image:
    return as_jpeg(_still(moment), int(moment.fresh.integers(60, 95)))


def _stutter(moment: Moment) -> Image:
    return [*moment.past, moment.image][len(moment.past) - moment.number % 5]


FROZEN = (
    *(ring(buffers) for buffers in (1, 2, 9, 40)),
    Kind("frozen", "lower half frozen", _rows_frozen(0.5, 1.0), LEAD),
    Kind("frozen", "middle third frozen", _rows_frozen(1 / 3, 2 / 3), LEAD),
    Kind("frozen", "clock over a still", _clock, LEAD),
    Kind("frozen", "loop with fresh noise", _loop_with_noise, 2 * LEAD),
    Kind(
        "frozen",
        "frozen with fresh noise",
        lambda m: light_noise(_still(m), m.fresh),
        LEAD,
        still=True,
    ),
    Kind("frozen", "frozen, coded as JPEG again", _stillas_jpeg, LEAD, still=True),
    Kind("frozen", "each image five times", _stutter, LEAD),
)

# -- torn -----------------------------------------------------------------------------------------


def _torn(moment: Moment) -> Image:
    """Above a random row the new image, below it one from five frames ago."""
    row = int(len(moment.image) * moment.fresh.uniform(0.3, 0.7))
    return np.vstack([moment.image[:row], moment.past[-5][row:]])


def _two_halves(moment: Moment) -> Image:
    """Left the new image, right one from another time."""
    middle = moment.image.shape[1] // 2
    return np.hstack([moment.image[:, :middle], moment.other[:, middle:]])


def _fields(moment: Moment) -> Image:
    """Every second row comes from five frames ago."""
    found = moment.image.copy()
    found[1::2] = moment.past[-5][1::2]
    return found


def _blocks_lost(moment: Moment) -> Image:
    """A third of the macroblocks, in runs, show another part of an earlier image."""
    found, source = moment.image.copy(), np.roll(moment.past[-5], (24, 40), (0, 1))
    rows, columns = -(-found.shape[0] // 16), -(-found.shape[1] // 16)
    lost = np.repeat(moment.fresh.random((rows, -(-columns // 8))) < 1 / 3, 8, axis=1)
    mask = np.kron(lost[:, :columns], np.ones((16, 16), bool))[: found.shape[0], : found.shape[1]]
    found[mask] = source[mask]
    return found


def _smeared(image: Image, random: Random) -> Image:
    """Below a row, a decoder repeats the last row it has."""
    row = int(image.shape[0] * random.uniform(0.3, 0.6))
    found = image.copy()
    found[row:] = found[row]
    return found


def _cut_short(image: Image, random: Random) -> Image:
    """A JPEG whose second part is missing: grey below a row."""
    found = image.copy()
    found[int(len(image) * random.uniform(0.4, 0.7)) :] = 128
    return found


def _row_noise(image: Image, random: Random) -> Image:
    """Add an offset to each row, deviation 15 % of the range."""
    return shown(image + 38.0 * random.standard_normal((len(image), 1, 1)))


def _stripes(image: Image, _: Random) -> Image:
    """Black out every other band of eight rows."""
    found = image.copy()
    found[np.arange(len(image)) // 8 % 2 == 1] = 0
    return found


def _rows_jump(image: Image, random: Random) -> Image:
    """Shift each row by up to 5 % of the width: lost synchronisation."""
    most = max(1, image.shape[1] // 20)
    shifts = random.integers(-most, most + 1, len(image))
    rows = zip(image, shifts, strict=True)
    return np.stack([np.roll(row, int(shift), axis=0) for row, shift in rows])


TORN = (
    Kind("torn", "two frames, torn", _torn, LEAD),
    Kind("torn", "halves of two frames", _two_halves, LEAD),
    Kind("torn", "fields of two frames", _fields, LEAD),
    Kind("torn", "blocks lost", _blocks_lost, LEAD),
    Kind("torn", "smeared below a row", each(_smeared)),
    Kind("torn", "grey below a row", each(_cut_short)),
    Kind("torn", "row noise", each(_row_noise)),
    Kind("torn", "stripes", each(_stripes)),
    Kind("torn", "rows jump", each(_rows_jump)),
)
