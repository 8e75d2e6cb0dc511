"""Render textured rectangles from any pose.

The camera frame is OpenCV's (x right, y down, z forward). A world point ``X`` appears at pixel
``p`` with ``z (p_x, p_y, 1) = K R^T (X - t)``, where ``R`` and ``t`` belong to ``T_world_camera``.
Pixel centres have integer coordinates: the top left pixel covers [-0.5, 0.5] x [-0.5, 0.5].

Images are bit-identical on one machine with the same versions of numpy and OpenCV; other versions
may round differently.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.geometry import quaternion_to_matrix

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Pinhole = tuple[float, float, float, float]  # fx fy cx cy in pixels

_OVERSAMPLING = 2
_NEAR_M = 0.05
_EDGE_ON_M = 1e-6
# Large faces are divided into tiles of this size at least, each with its own texture level.
_TILE_M, _TILE_TEXELS = 1.3, 100


def as_image(values: NDArray[Any]) -> Image:
    """Round grey levels to 8 bits."""
    return np.asarray(np.rint(values.clip(0, 255)).astype(np.uint8))


class Face(NamedTuple):
    """A textured rectangle in the world frame, visible from one side.

    Attributes
    ----------
    corner
        Shape (3,), metres: the outer corner of the texture's first texel.
    edge_u, edge_v
        Shape (3,), metres: along the texture's width and height. ``edge_u x edge_v`` points away
        from the visible side.
    texture
        Shape (rows, columns, 3), uint8, BGR.
    """

    corner: Floats
    edge_u: Floats
    edge_v: Floats
    texture: Image


class Scene:
    """Textured rectangles that can be rendered from any pose.

    Visibility is exact: inverse depth is linear in the image of a plane, and every sample keeps the
    nearest face. Each pixel averages 2 x 2 samples, from a texture level chosen by distance.
    """

    def __init__(self, faces: Iterable[Face]) -> None:
        self.faces = tuple(faces)
        self._corner = np.array([face.corner for face in self.faces], np.float64)
        self._edges = np.array([[face.edge_u, face.edge_v] for face in self.faces], np.float64)
        away = np.cross(self._edges[:, 0], self._edges[:, 1])
        self._away = away / np.linalg.norm(away, axis=1, keepdims=True)
        self._levels = [_pyramid(face.texture) for face in self.faces]
        owners: list[int] = []
        quads: list[Floats] = []
        for number, (corner, edges) in enumerate(zip(self._corner, self._edges, strict=True)):
            spans = np.linalg.norm(edges, axis=1)
            texels = np.array(self.faces[number].texture.shape[1::-1])
            tiles = np.ceil(np.minimum(spans / _TILE_M, texels / _TILE_TEXELS)).astype(int)
            for column, row in np.ndindex(*tiles):
                uv = np.add([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]], (column, row))
                quads.append(corner + uv / tiles @ edges)
                owners.append(number)
        self._owner = np.array(owners)
        self._quads = np.array(quads)  # (tiles, 5, 3): closed, clockwise from the visible side

    def render(self, pose: Floats, intrinsics: Pinhole, size: tuple[int, int]) -> Image:
        """Render the scene without motion blur, vignetting or noise.

        Parameters
        ----------
        pose
            Shape (7,): ``T_world_camera`` as tx ty tz in metres and qx qy qz qw.
        intrinsics
            fx, fy, cx, cy in pixels of the rendered image.
        size
            Width and height in pixels.

        Returns
        -------
        Image
            Shape (height, width, 3), uint8, BGR; black outside all faces.
        """
        width, height = size[0] * _OVERSAMPLING, size[1] * _OVERSAMPLING
        first = (_OVERSAMPLING - 1) / 2  # sample coordinate of the centre of pixel 0
        fx, fy, cx, cy = (value * _OVERSAMPLING for value in intrinsics)
        camera = np.array([[fx, 0, cx + first], [0, fy, cy + first], [0, 0, 1]])
        project = camera @ quaternion_to_matrix(pose[3:]).T
        quads = (self._quads - pose[:3]) @ project.T  # homogeneous sample coordinates (x z, y z, z)
        x, y, z = quads[..., 0], quads[..., 1], quads[..., 2]
        inside = [x + z, width * z - x, y + z, height * z - y, z - _NEAR_M]
        # A face seen edge-on is invisible, and its unprojection would be singular.
        ahead = np.einsum("ij,ij->i", self._corner - pose[:3], self._away)
        seen = ahead[self._owner] > _EDGE_ON_M
        for halfspace in inside:
            seen &= (halfspace > 0).any(axis=1)
        # Draw near tiles first, so that completely hidden tiles are never sampled.
        tiles = np.flatnonzero(seen)
        tiles = tiles[np.argsort(z[tiles].mean(axis=1), kind="stable")]
        owners = self._owner[tiles]
        # Per tile, map a sample's (x, y, 1) to (u, v, 1) / z, with u and v in [0, 1] on the face.
        frames = np.stack([*self._edges.transpose(1, 0, 2), self._corner - pose[:3]], axis=2)
        unproject = np.linalg.inv((project @ frames)[owners])

        image = np.zeros((height, width, 4), np.uint8)
        nearness = np.zeros((height, width), np.float32)
        for tile, owner, to_face in zip(tiles, owners, unproject, strict=True):
            self._draw(image, nearness, _in_front(quads[tile]), to_face, self._levels[owner])
        shrunk = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(shrunk[..., :3], np.uint8)

    @staticmethod
    def _draw(
        image: Image,
        nearness: NDArray[np.float32],
        polygon: Floats,
        unproject: Floats,
        levels: Sequence[Image],
    ) -> None:
        """Draw a closed convex polygon (n, 2), in samples, where it is the nearest so far."""
        height, width = nearness.shape
        left, top = np.ceil(polygon.min(axis=0)).clip(0).astype(int)
        right, bottom = np.minimum(np.ceil(polygon.max(axis=0)), (width, height)).astype(int)
        if left >= right or top >= bottom:
            return
        columns = np.arange(left, right, dtype=np.float32)
        rows = np.arange(top, bottom, dtype=np.float32)
        begin, end = _spans(polygon, np.arange(top, bottom))
        ahead = np.float32(unproject[2, 0]) * columns + np.float32(unproject[2, 2])
        inverse_depth = ahead + (np.float32(unproject[2, 1]) * rows)[:, None]
        region = np.s_[top:bottom, left:right]
        mask = inverse_depth > nearness[region]
        mask &= columns >= begin[:, None]
        mask &= columns < end[:, None]
        if not mask.any():
            return
        texture = _level_for(polygon.mean(axis=0), unproject, levels)
        # Texel i of n covers [i / n, (i + 1) / n] of the face, and its centre has coordinate i.
        scale = np.array([[texture.shape[1], 0, -0.5], [0, texture.shape[0], -0.5], [0, 0, 1]])
        offset = np.array([[1, 0, left], [0, 1, top], [0, 0, 1]])
        patch = cv2.warpPerspective(
            texture,
            scale @ unproject @ offset,
            (int(right - left), int(bottom - top)),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        cv2.copyTo(patch, mask.view(np.uint8), image[region])
        cv2.copyTo(inverse_depth, mask.view(np.uint8), nearness[region])


def _pyramid(texture: Image) -> list[Image]:
    """Return the texture at 1, 1/sqrt(2), 1/2, ... of its size, down to a few texels, BGRA."""
    # With an unused fourth channel, OpenCV samples more than twice as fast.
    levels = [np.asarray(cv2.cvtColor(texture, cv2.COLOR_BGR2BGRA), np.uint8)]
    while min(levels[-1].shape[:2]) > 8:
        # Halve the level before the last, so that sizes halve exactly and errors do not add up.
        shape = np.array(texture.shape[:2]) * 0.5 ** (len(levels) / 2)
        rows, columns = np.rint(shape).astype(int)
        source = levels[max(len(levels) - 2, 0)]
        small = cv2.resize(source, (int(columns), int(rows)), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(small, np.uint8))
    return levels


def _level_for(sample: Floats, unproject: Floats, levels: Sequence[Image]) -> Image:
    """Return the texture level whose texels are about as large as samples near ``sample``."""
    u, v, inverse_depth = (unproject @ (*sample, 1)).tolist()
    rows, columns = levels[0].shape[:2]
    (u_x, u_y, _), (v_x, v_y, _), (d_x, d_y, _) = (unproject / inverse_depth).tolist()
    u, v = u / inverse_depth, v / inverse_depth
    u_x, u_y = columns * (u_x - u * d_x), columns * (u_y - u * d_y)
    v_x, v_y = rows * (v_x - v * d_x), rows * (v_y - v * d_y)
    # The singular values of ((u_x, u_y), (v_x, v_y)) are the texels that a sample spans along its
    # long and its short axis.
    area = abs(u_x * v_y - u_y * v_x)
    norm = u_x**2 + u_y**2 + v_x**2 + v_y**2
    long = math.sqrt((norm + math.sqrt(max(norm**2 - 4 * area**2, 0))) / 2)
    # Compromise between blur along the short axis and aliasing along the long axis.
    span = max(math.sqrt(area), long / 1.6, 1e-9)
    level = round(2 * math.log2(span))
    return levels[min(max(level, 0), len(levels) - 1)]


def _in_front(loop: Floats) -> Floats:
    """Project a closed loop of homogeneous points (n, 3) to (n, 2), clipped at the near plane."""
    depth = loop[:, 2] - _NEAR_M
    if depth.min() < 0:
        kept: list[Floats] = []
        for here, there, a, b in zip(loop[:-1], loop[1:], depth[:-1], depth[1:], strict=True):
            if a >= 0:
                kept.append(here)
            if (a >= 0) != (b >= 0):
                kept.append(here + (there - here) * (a / (a - b)))
        loop = np.array([*kept, kept[0]])
    return np.asarray(loop[:, :2] / loop[:, 2:])


def _spans(polygon: Floats, rows: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return the start and end of a closed clockwise polygon in each row, shape (rows,) each."""
    step = polygon[1:] - polygon[:-1]
    sloped = step[:, 1] != 0
    start, step = polygon[:-1][sloped], step[sloped]
    crossing = start[:, 0] + (rows[:, None] - start[:, 1]) * (step[:, 0] / step[:, 1])
    rising = step[:, 1] < 0
    return crossing[:, rising].max(axis=1), crossing[:, ~rising].min(axis=1)
