"""The street: one way round a block of houses, 84 x 56 m between its corners, fixed.

World frame: x right, y forward, z up, in metres; the origin is the middle of the block, on the
ground. Houses stand on both sides; cars, trees and posts stand along the kerbs.
"""

from __future__ import annotations

import functools
import itertools
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_export.scene import paint, paint_street
from cvo_export.scene.boxes import LIGHT, VIEWS, Box
from cvo_export.scene.paint import Colour
from cvo_export.scene.renderer import Face, Floats, Scene, as_image

HALF_M = np.array([42.0, 28.0])  # from the origin to the middle of the streets
ASIDE_M = 6.5  # from the middle of a street to the houses
_KERB_M = 4.3
_PARKED_M = 3.35  # from the middle of a street to the middle of parked cars
_FREE_M = 13.0  # of each corner, without anything at the kerb
_SKY_M, _SKY_TEXELS = 400.0, 512
_GROUND_TEXELS_M = 30
_SHADOW_TEXELS_M = 9
_BOX_TEXELS_M = 60
_ASPHALT: Colour = (112, 110, 108)


@functools.cache
def street() -> Scene:
    """Return the street; textures are painted only once."""
    boxes = list(_boxes(np.random.default_rng(7)))
    faces = [*_sky(), *_ground(boxes), *_houses()]
    for number, box in enumerate(boxes):
        faces += box.faces(np.random.default_rng((8, number)), _BOX_TEXELS_M)
    return Scene(faces)


def _sky() -> list[Face]:
    """Build a horizon that is far away, and the zenith."""
    size = np.array([2 * _SKY_M, 2 * _SKY_M, _SKY_M])
    colour = (235, 180, 130)
    painted = paint_street.sky(np.random.default_rng(5), 300, 4 * _SKY_TEXELS, colour)
    faces = []
    # In the order in which they follow one another from left to right.
    for number, view in enumerate(("+y", "+x", "-y", "-x")):
        u, v = np.array(VIEWS[view]) * size
        middle = np.cross(*VIEWS[view]) * _SKY_M + (0, 0, _SKY_M / 2 - 20)
        part = painted[:, number * _SKY_TEXELS : (number + 1) * _SKY_TEXELS]
        faces.append(Face(middle - (u + v) / 2, u, v, np.ascontiguousarray(part)))
    u, v = np.array(VIEWS["+z"]) * size
    zenith = np.full((16, 16, 3), colour, np.uint8)
    faces.append(Face((0, 0, _SKY_M - 20) - (u + v) / 2, u, v, zenith))
    return faces


def _houses() -> list[Face]:
    """Build the fronts of the block in the middle and of the houses around it."""
    faces = []
    for number, (view, outer) in enumerate(itertools.product(("+y", "-y", "+x", "-x"), (1, -1))):
        rng = np.random.default_rng((6, number))
        u, v = np.array(VIEWS[view], float)
        ahead = np.cross(u, v)
        half = HALF_M + outer * ASIDE_M
        along, away = (half[0], half[1]) if view in ("+y", "-y") else (half[1], half[0])
        ends = _lots(rng, 2 * along)
        for left, right in itertools.pairwise(ends):
            height_m = rng.uniform(7.0, 13.5)
            rows, columns = np.rint(
                np.array([height_m, right - left]) * paint_street.WALL_TEXELS_M
            ).astype(int)
            colour = paint.vary(rng, paint.vivid(rng), 0.1)
            painted = paint_street.facade(rng, int(rows), int(columns), _faded(colour))
            corner = outer * away * ahead + (left - along) * u - height_m * v
            lit = as_image(painted * np.float32(LIGHT[view]))
            faces.append(Face(corner, (right - left) * u, height_m * v, lit))
    return faces


def _faded(colour: Colour) -> Colour:
    """Return a colour as paint on a wall has it."""
    b, g, r = (round(0.33 * value + 118) for value in colour)
    return b, g, r


def _lots(rng: np.random.Generator, length_m: float) -> list[float]:
    """Return where houses begin and end along a side, in metres from its left end."""
    widths = rng.uniform(8.0, 15.0, math.ceil(length_m / 11.5))
    ends = np.concatenate([[0.0], np.cumsum(widths)])
    return [float(end) for end in ends * length_m / ends[-1]]


def _ground(boxes: list[Box]) -> list[Face]:
    """Build the ground of the four streets, with the shadows of what stands on it."""
    half = HALF_M + ASIDE_M
    columns, rows = np.rint(2 * half * _GROUND_TEXELS_M).astype(int).tolist()
    x = np.linspace(-half[0], half[0], columns, dtype=np.float32)
    y = np.linspace(half[1], -half[1], rows, dtype=np.float32)
    outside = np.maximum(np.abs(x)[None, :] - HALF_M[0], np.abs(y)[:, None] - HALF_M[1])
    rng = np.random.default_rng(4)
    aside = outside / np.float32(_KERB_M)
    painted = paint_street.ground(rng, aside, _GROUND_TEXELS_M, _ASPHALT)
    light = cv2.resize(_shadows(boxes), (columns, rows))
    light *= 1 - 0.35 * np.exp((np.abs(outside) - np.float32(ASIDE_M)) / 0.7)
    painted = as_image(painted * light[..., None])
    inner = HALF_M - ASIDE_M
    strips = (
        (-half[0], half[0], inner[1], half[1]),
        (-half[0], half[0], -half[1], -inner[1]),
        (-half[0], -inner[0], -inner[1], inner[1]),
        (inner[0], half[0], -inner[1], inner[1]),
    )
    faces = []
    for left, right, near, far in strips:
        left_texel, right_texel = np.rint((np.array([left, right]) + half[0]) * _GROUND_TEXELS_M)
        top_texel, low_texel = np.rint((half[1] - np.array([far, near])) * _GROUND_TEXELS_M)
        part = painted[int(top_texel) : int(low_texel), int(left_texel) : int(right_texel)]
        u, v = np.array([right - left, 0.0, 0.0]), np.array([0.0, near - far, 0.0])
        faces.append(Face(np.array([left, far, 0.0]), u, v, np.ascontiguousarray(part)))
    return faces


def _shadows(boxes: list[Box]) -> NDArray[np.float32]:
    """Return the brightness of the ground around what stands on it."""
    half = HALF_M + ASIDE_M
    width, height = np.rint(2 * half * _SHADOW_TEXELS_M).astype(int).tolist()
    shadow = np.zeros((height, width), np.float32)
    for box in boxes:
        if box.base[2] > 0:
            continue
        corner, u, v = box.sides()["-z"]
        outline = corner[:2] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) @ np.array([u, v])[:, :2]
        texels = (outline - (-half[0], half[1])) * (_SHADOW_TEXELS_M, -_SHADOW_TEXELS_M)
        cv2.fillConvexPoly(shadow, np.rint(texels).astype(np.int32), 0.7)
    return np.asarray(1 - cv2.GaussianBlur(shadow, (0, 0), 3.5), np.float32)


# --------------------------------------------------------------------------- along the kerbs


def _boxes(rng: np.random.Generator) -> list[Box]:
    """Return cars, trees, posts, pillars and boards along the kerbs of the four streets."""
    boxes = []
    for turn in range(4):
        along = HALF_M[turn % 2] - _FREE_M
        for side in (-1, 1):
            at = -along
            while (at := at + rng.uniform(3.0, 5.5)) < along:
                boxes += _thing(rng, _place(turn, at, side), 90.0 * turn)
    return boxes


def _place(turn: int, at: float, side: int) -> Floats:
    """Return the point on the middle line of a street, and the unit vector towards the houses."""
    ahead = np.array([math.cos(turn * math.pi / 2), math.sin(turn * math.pi / 2)])
    right = np.array([ahead[1], -ahead[0]])
    return np.array([right * HALF_M[1 - turn % 2] + ahead * at, side * right])


def _thing(rng: np.random.Generator, place: Floats, yaw: float) -> list[Box]:
    middle, aside = place

    def base(distance_m: float, height_m: float = 0.0) -> tuple[float, float, float]:
        x, y = (middle + distance_m * aside).tolist()
        return x, y, height_m

    colour = paint.vivid(rng)
    kind = rng.random()
    if kind < 0.45:
        body, glass = paint_street.car_body, paint_street.car_windows
        length = rng.uniform(3.7, 4.6)
        return [
            Box(base(_PARKED_M), (length, 1.7, 0.9), yaw, body, paint.plain, colour),
            Box(base(_PARKED_M, 0.9), (0.55 * length, 1.5, 0.5), yaw, glass, paint.plain, colour),
        ]
    if kind < 0.7:
        crown, size, spin = (70, 140, 80), rng.uniform(1.7, 2.3), rng.uniform(10, 80)
        bark = (60, 80, 100)
        return [
            Box(base(5.0), (0.3, 0.3, 2.6), yaw, paint.plain, paint.plain, bark),
            Box(base(5.0, 2.4), (size, size, size), spin, paint.leaves, paint.leaves, crown),
            Box(base(5.0, 3.6), (1.5, 1.5, size), spin + 45, paint.leaves, paint.leaves, crown),
        ]
    if kind < 0.82:
        grey = (75, 80, 75)
        return [
            Box(base(4.6), (0.14, 0.14, 5.2), yaw, paint.plain, paint.plain, grey),
            Box(base(4.3, 5.2), (0.35, 0.8, 0.16), yaw, paint.plain, paint.plain, (225, 235, 235)),
        ]
    if kind < 0.92:
        return [Box(base(5.2), (1.0, 1.0, 2.7), 45.0, paint.poster, paint.plain, colour)]
    return [Box(base(5.1), (0.9, 0.5, 1.2), yaw, paint.crate, paint.planks, colour)]
