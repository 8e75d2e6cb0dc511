"""The room: 5 x 4 x 2.6 m, fixed, with most detail in the viewing direction of the flights (+y).

World frame: x right, y forward, z up, in metres; the origin is the centre of the floor.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_export.scene import paint
from cvo_export.scene.boxes import Box, cuboid
from cvo_export.scene.paint import Colour, Paint
from cvo_export.scene.renderer import Face, Floats, Scene, as_image

ROOM_M = np.array([5.0, 4.0, 2.6])
_BOX_TEXELS_M = 300
_LIGHT_TEXELS_M = 40

# A little in front of the wall, right of the window and above the screen.
_TAG_CENTRE_M = (0.45, 1.99, 1.32)


@functools.cache
def room() -> Scene:
    """Return the room with walls, floor, ceiling and furniture; textures are painted only once."""
    faces = _shell()
    for number, box in enumerate(_FURNITURE):
        faces += box.faces(np.random.default_rng((2, number)), _BOX_TEXELS_M)
    return Scene(faces)


@functools.cache
def tagged_room(edge_m: float) -> Scene:
    """Return the room with an AprilTag on the front wall, where every flight sees it.

    The tag is number 0 of the family 36h11; ``edge_m`` is the edge of its black square. A white
    margin of one module surrounds it, without which it could not be found.
    """
    modules = paint.tag().shape[0] // paint.TAG_MODULE_TEXELS
    size = edge_m * modules / (modules - 2)
    corner = np.subtract(_TAG_CENTRE_M, (size / 2, 0, -size / 2))
    edges = np.array([[size, 0, 0], [0, 0, -size]])
    return Scene([*room().faces, Face(corner, edges[0], edges[1], paint.tag())])


def _shell() -> list[Face]:
    """Build walls, floor and ceiling, shaded in corners and near furniture."""
    faces = []
    sides = cuboid(np.array([0, 0, ROOM_M[2] / 2]), ROOM_M, 0, inside=True)
    for number, (view, (corner, u, v)) in enumerate(sides.items()):
        rng = np.random.default_rng((1, number))
        spans = np.array([np.linalg.norm(u), np.linalg.norm(v)])
        width, height = np.rint(spans * paint.WALL_TEXELS_M).astype(int).tolist()
        surface, colour = _SURFACES[view]
        texture = surface(rng, height, width, colour)
        light = _contact_light(corner, u, v)
        light *= 1 + 0.06 * paint.noise(rng, light.shape[0], light.shape[1], 60)
        faces.append(
            Face(corner, u, v, as_image(texture * cv2.resize(light, (width, height))[..., None]))
        )
    return faces


def _contact_light(corner: Floats, edge_u: Floats, edge_v: Floats) -> NDArray[np.float32]:
    """Return the brightness of a side of the room: dark corners, and shadows of near furniture."""
    spans = np.array([np.linalg.norm(edge_u), np.linalg.norm(edge_v)])
    width, height = np.rint(spans * _LIGHT_TEXELS_M).astype(int).tolist()
    axes = np.array([edge_u / spans[0], edge_v / spans[1]])
    light = np.ones((height, width), np.float32)
    for row in _FURNITURE:
        sides = row.sides().values()
        points = np.array(
            [start + a * u + b * v for start, u, v in sides for a, b in np.ndindex(2, 2)]
        )
        gap = float(np.abs((points - corner) @ np.cross(*axes)).min())
        if gap > 0.4:
            continue
        outline = np.rint((points - corner) @ axes.T * _LIGHT_TEXELS_M).astype(np.int32)
        shadow = np.zeros_like(light)
        cv2.fillConvexPoly(shadow, cv2.convexHull(outline), 0.55 * (1 - gap / 0.5))
        light *= 1 - cv2.GaussianBlur(shadow, (0, 0), 2.5 + 12 * gap)
    across, down = (
        np.minimum(np.arange(n), np.arange(n)[::-1]).astype(np.float32) / _LIGHT_TEXELS_M
        for n in (width, height)
    )
    light *= 1 - 0.3 * np.exp(-across / 0.2)
    light *= 1 - 0.3 * np.exp(-down / 0.2)[:, None]
    return light


_SURFACES: dict[str, tuple[Paint, Colour]] = {
    "+y": (paint.front_wall, (176, 186, 150)),
    "-y": (paint.planks, (80, 120, 160)),
    "-x": (paint.tiles, (70, 90, 165)),
    "+x": (paint.tiles, (200, 190, 140)),
    "-z": (paint.planks, (75, 115, 165)),
    "+z": (paint.planks, (205, 215, 220)),
}

_WOOD = (60, 110, 170)

_FURNITURE = (
    # A table with objects on it.
    Box((0.1, 1.05, 0.71), (1.2, 0.6, 0.05), 0, paint.planks, paint.planks, (80, 140, 200)),
    Box((-0.44, 0.81, 0), (0.07, 0.07, 0.71), 0, paint.plain, paint.plain, _WOOD),
    Box((0.64, 0.81, 0), (0.07, 0.07, 0.71), 0, paint.plain, paint.plain, _WOOD),
    Box((-0.44, 1.29, 0), (0.07, 0.07, 0.71), 0, paint.plain, paint.plain, _WOOD),
    Box((0.64, 1.29, 0), (0.07, 0.07, 0.71), 0, paint.plain, paint.plain, _WOOD),
    Box((-0.27, 1.12, 0.76), (0.3, 0.22, 0.2), 24, paint.crate, paint.planks, (90, 150, 190)),
    Box((0.42, 1.08, 0.76), (0.28, 0.2, 0.07), -12, paint.fabric, paint.poster, (60, 60, 190)),
    Box((0.44, 1.08, 0.83), (0.24, 0.18, 0.05), 9, paint.fabric, paint.poster, (190, 120, 50)),
    Box((0.08, 0.95, 0.76), (0.09, 0.09, 0.11), 33, paint.plain, paint.plain, (70, 200, 235)),
    Box((0.1, 1.2, 0.76), (0.13, 0.13, 0.1), 15, paint.tiles, paint.plain, (70, 90, 170)),
    Box((0.1, 1.2, 0.86), (0.2, 0.2, 0.24), 40, paint.leaves, paint.leaves, (60, 140, 70)),
    # Along the front wall: a low cabinet with a screen, and shelves above it.
    Box((-0.05, 1.82, 0), (1.7, 0.34, 0.5), 0, paint.panels, paint.planks, (120, 90, 60)),
    Box((-0.2, 1.88, 0.5), (0.95, 0.06, 0.64), 0, paint.screen, paint.plain, (220, 120, 120)),
    Box((1.15, 1.88, 1.42), (0.8, 0.24, 0.04), 0, paint.planks, paint.planks, _WOOD),
    Box((1.0, 1.89, 1.46), (0.42, 0.18, 0.26), 0, paint.books, paint.plain, _WOOD),
    Box((1.38, 1.88, 1.46), (0.16, 0.16, 0.22), 28, paint.leaves, paint.leaves, (80, 170, 120)),
    Box((1.1, 1.7, 0), (0.36, 0.36, 0.42), 18, paint.fabric, paint.fabric, (60, 160, 220)),
    # In the corners: a cupboard with a crate on top, and a white cupboard with a box on top.
    Box((-1.98, 1.7, 0), (0.85, 0.56, 1.9), 0, paint.panels, paint.plain, (150, 170, 120)),
    Box((-2.0, 1.66, 1.9), (0.55, 0.4, 0.24), 8, paint.crate, paint.plain, (60, 80, 150)),
    Box((2.08, 1.62, 0), (0.66, 0.66, 1.65), 0, paint.panels, paint.plain, (215, 220, 222)),
    Box((2.08, 1.62, 1.65), (0.4, 0.3, 0.28), -20, paint.poster, paint.plain, (60, 130, 220)),
    # On the left: a column and a floor lamp.
    Box((-1.5, 0.85, 0), (0.24, 0.24, 2.6), 0, paint.tiles, paint.plain, (90, 120, 210)),
    Box((-1.1, 1.5, 0), (0.04, 0.04, 1.4), 0, paint.plain, paint.plain, (45, 42, 40)),
    Box((-1.1, 1.5, 1.4), (0.34, 0.34, 0.32), 22, paint.fabric, paint.plain, (150, 215, 245)),
    # A lamp over the table.
    Box((0.25, 1.05, 1.95), (0.36, 0.36, 0.25), 35, paint.tiles, paint.plain, (120, 210, 245)),
)
