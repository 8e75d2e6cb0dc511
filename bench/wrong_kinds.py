"""Kinds of wrong frames, and of harmless changes, for programs that measure what a bundle does.

A kind changes the right images of a stream, one ``Moment`` at a time, from frame ``start`` on; the
frames before are right. Every kind is seeded: the same stream gives the same images.

Where the parameters come from:

- ``fitted`` kinds are the six noises of the study (``cvo_export.data.noise``: names, defaults and
  their sources there) and stronger settings of the same six. An exporter may fit an alarm to these,
  so results mark them. No other kind comes from there: all others are left out of any fit.
- Formats are memory layouts of video drivers (V4L2: BGR3, RGB3, NV12, YUYV, raw RGGB) read as
  another one; colour bars, black-and-white boards and "no signal" are what capture cards show.
- Rings of 2, 9 and 40 buffers test repetition at three distances, all within the 256 frames that
  ``cvo_edge.input.repetition`` remembers: 2 and 9 are usual driver queues, 40 is a short recording
  that is played in a loop.
- All other strengths were chosen by eye on a contact sheet (``wrong_frames.py --sheet``), so that a
  person notices the fault at once, and not by what a bundle says to them.
- Harmless changes are what ordinary cameras and encoders differ by.
"""

from __future__ import annotations

import altered
import cv2
import numpy as np
from altered import Alteration, Image, Random, resized, shown
from broken_streams import FROZEN, TORN
from moments import Change, Kind, Moment, as_jpeg, each, frame, light_noise, steady

from cvo_export.data.noise import KINDS as NOISES
from cvo_export.data.noise import Noise

__all__ = ["HARMLESS", "KINDS", "WRONG", "Kind", "frame"]

# -- kinds of one image ---------------------------------------------------------------------------


def _family(family: str, changes: dict[str, Change]) -> tuple[Kind, ...]:
    return tuple(Kind(family, name, change) for name, change in changes.items())


def noise_of_the_study(name: str, strength: float | None = None) -> Change:
    """One of the six noises of ``cvo_export.data.noise``, by default at its strength there."""
    noise = Noise(name, NOISES[name].default if strength is None else strength)
    return each(noise.degrade)


STUDY = tuple(
    Kind(family, name, noise_of_the_study(noise, strength), fitted=True)
    for family, name, noise, strength in (
        ("sensor", "exposure, -2 stops", "exposure", None),
        ("sensor", "exposure, +2 stops", "exposure", 2.0),
        ("sensor", "gaussian noise .1", "gaussian", None),
        ("sensor", "gaussian noise .2", "gaussian", 0.2),
        ("sensor", "speckle .22", "speckle", None),
        ("sensor", "salt and pepper .05", "salt-and-pepper", None),
        ("optics", "motion blur, 3 %", "motion-blur", None),
        ("optics", "motion blur, 8 %", "motion-blur", 0.08),
        ("optics", "a tenth covered", "occlusion", None),
    )
)

GEOMETRY = _family(
    "geometry",
    {
        "mirrored": each(lambda image, _: image[:, ::-1]),
        "upside down": each(lambda image, _: image[::-1]),
        "turned by 90 degrees": each(altered.turned_90),
        "turned by 180 degrees": each(lambda image, _: image[::-1, ::-1]),
        "zoom 1.2": each(altered.zoomed(1.2)),
        "zoom 1.5": each(altered.zoomed(1.5)),
        "zoom .8 with a border": each(altered.zoomed(0.8)),
        "aspect squeezed": each(altered.cut(0.0, 1.0, 0.125, 0.875)),
        "cropped to a corner": each(altered.cut(0.25, 1.0, 0.25, 1.0)),
        "columns rolled": each(altered.rolled(0.25, 1)),
        "halves swapped": each(altered.rolled(0.5, 1)),
        "rows rolled": each(altered.rolled(0.5, 0)),
        "sheared": each(altered.sheared),
        "rolling shutter wobbles": each(altered.wobbling),
        "barrel distortion": each(altered.barrel),
    },
)
FORMAT = _family(
    "colour and format",
    {
        "red and blue swapped": each(lambda image, _: image[..., ::-1]),
        "YUV shown as BGR": each(altered.yuv_as_bgr),
        "NV12 read as grey": each(altered.nv12_as_grey),
        "YUYV read as grey": each(altered.yuyv_as_grey),
        "negative": each(lambda image, _: 255 - image),
        "grey": each(altered.grey),
        "blue lost": each(altered.without(0)),
        "red lost": each(altered.without(2)),
        "4 bits a channel": each(lambda image, _: image & 0xF0),
        "2 bits a channel": each(lambda image, _: image & 0xC0),
        "the lower 4 bits": each(lambda image, _: image << 4),
        "Bayer mosaic": each(altered.bayer),
        "wrong stride": each(altered.wrong_stride),
        "without gamma": each(altered.linear_light),
    },
)
SENSOR = _family(
    "sensor",
    {
        "dead columns": steady(altered.dead_columns),
        "column pattern": steady(altered.column_pattern),
        "vignette": each(altered.vignette),
        "flicker": each(altered.flicker),
        "bloom": each(altered.bloom),
    },
)
OPTICS = _family(
    "optics",
    {
        "defocus": each(altered.defocused),
        "dirt on the lens": steady(altered.dirt),
        "water drops": steady(altered.drops),
        "rain": each(altered.rain),
        "fog": each(altered.fog),
        "a hand": each(altered.hand),
        "half covered": each(altered.half_covered),
        "cracked lens": steady(altered.cracked),
        "lens flare": steady(altered.flare),
    },
)


def _received(alteration: Alteration) -> Change:
    """A test picture with the light noise of an analogue line: no two frames are equal."""
    return lambda moment: light_noise(alteration(moment.image, moment.fresh), moment.fresh)


def _picture_in_picture(moment: Moment) -> Image:
    """Paste a frame from another time over the middle, half as wide and high."""
    height, width = moment.image.shape[:2]
    small = cv2.resize(moment.other, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    found = moment.image.copy()
    found[height // 4 : height // 4 + height // 2, width // 4 : width // 4 + width // 2] = small
    return found


NO_PICTURE = _family(
    "no picture",
    {
        "noise only": each(altered.white_noise),
        "colour bars": _received(altered.colour_bars),
        '"no signal"': _received(altered.text_on((160, 40, 20), "NO SIGNAL")),
        "black with text": _received(altered.text_on((0, 0, 0), "2026-01-01 00:00:00")),
        "checkerboard": _received(altered.checkerboard),
        "grey gradient": _received(altered.gradient),
        "picture in picture": _picture_in_picture,
    },
)

WRONG: tuple[Kind, ...] = (
    *(*FROZEN, *GEOMETRY, *TORN, *FORMAT),
    *(*SENSOR, *(kind for kind in STUDY if kind.family == "sensor")),
    *(*OPTICS, *(kind for kind in STUDY if kind.family == "optics")),
    *NO_PICTURE,
)


# -- harmless -------------------------------------------------------------------------------------


def _half_resolution(image: Image, _: Random) -> Image:
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return resized(np.asarray(half, np.uint8), image)


def white_balance(share: float) -> Alteration:
    """Make red stronger by a share, and blue weaker by it."""
    return lambda image, _: shown(image * np.array([1 - share, 1.0, 1 + share]))


HARMLESS = _family(
    "harmless",
    {
        "clean": each(lambda image, _: image),
        "JPEG, quality 50": each(lambda image, _: as_jpeg(image, 50)),
        "noise .01": each(light_noise),
        "half the resolution": each(_half_resolution),
        "exposure, -.3 stops": noise_of_the_study("exposure", -0.3),
        "exposure, +.3 stops": noise_of_the_study("exposure", 0.3),
        "white balance, 5 % warmer": each(white_balance(0.05)),
        "white balance, 5 % colder": each(white_balance(-0.05)),
    },
)
KINDS: dict[str, Kind] = {kind.name: kind for kind in (*WRONG, *HARMLESS)}
