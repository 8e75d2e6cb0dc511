"""Boxes: furniture of the room, and cars, trees and posts in the street."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cvo_export.scene.paint import Colour, Paint
from cvo_export.scene.renderer import Face, Floats, as_image

# Texture axes u and v for each of the six viewing directions (u x v = direction).
VIEWS = {
    "+y": ((1, 0, 0), (0, 0, -1)),
    "-y": ((-1, 0, 0), (0, 0, -1)),
    "+x": ((0, -1, 0), (0, 0, -1)),
    "-x": ((0, 1, 0), (0, 0, -1)),
    "-z": ((1, 0, 0), (0, -1, 0)),
    "+z": ((1, 0, 0), (0, 1, 0)),
}
# Light on a surface, by the viewing direction from which it is seen.
LIGHT = {"+y": 0.97, "-y": 0.8, "+x": 0.8, "-x": 0.9, "-z": 1.06, "+z": 0.6}

Sides = dict[str, tuple[Floats, Floats, Floats]]  # view -> corner, edge_u and edge_v of a face


class Box(NamedTuple):
    """A box: centre of its base and size in metres, yaw in degrees."""

    base: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float
    paint: Paint  # on large vertical sides
    trim: Paint  # on all other sides
    colour: Colour

    def sides(self) -> Sides:
        """Return the sides, seen from outside."""
        centre = np.add(self.base, (0, 0, self.size[2] / 2))
        return cuboid(centre, np.array(self.size), math.radians(self.yaw), inside=False)

    def faces(self, rng: np.random.Generator, texels_m: float) -> list[Face]:
        """Paint the visible sides."""
        faces = []
        for view, (corner, u, v) in self.sides().items():
            if view == "+z" and self.base[2] == 0:
                continue
            width, height = (
                max(round(float(np.linalg.norm(edge)) * texels_m), 4) for edge in (u, v)
            )
            upright = view not in ("-z", "+z")
            large = upright and min(width, height) > 0.15 * texels_m
            texture = (self.paint if large else self.trim)(rng, height, width, self.colour)
            shade = np.linspace(1.05, 0.8 if upright else 1.05, height, dtype=np.float32)
            lit = texture * (LIGHT[view] * shade[:, None, None])
            faces.append(Face(corner, u, v, as_image(lit)))
        return faces


def cuboid(centre: Floats, size: Floats, yaw: float, inside: bool) -> Sides:
    """Return the sides of a box, seen from inside or outside."""
    turn = np.array(
        [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]
    )
    sides = {}
    for view, (u, v) in VIEWS.items():
        edge_u, edge_v = u * size, v * size
        depth = np.cross(u, v) * size * (1 if inside else -1)
        corner = centre + turn @ (depth - edge_u - edge_v) / 2
        sides[view] = (corner, turn @ edge_u, turn @ edge_v)
    return sides
