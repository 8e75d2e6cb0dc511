"""Procedural textures of materials and objects, from a random generator."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_export.scene.renderer import Image, as_image

Colour = tuple[int, int, int]  # BGR
Paint = Callable[[np.random.Generator, int, int, Colour], Image]  # height and width in texels

TAG_MODULE_TEXELS = 16
WALL_TEXELS_M = 240  # fixed, because pictures on a wall have a size in metres


def noise(rng: np.random.Generator, height: int, width: int, cell: float) -> NDArray[np.float32]:
    """Return multi-scale noise of about unit variance; ``cell`` is the coarsest feature size."""
    total = np.zeros((height, width), np.float32)
    weight = 0.8
    while cell >= 2:
        rows, columns = math.ceil(height / cell) + 2, math.ceil(width / cell) + 2
        grid = rng.standard_normal((rows, columns), dtype=np.float32)
        total += weight * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        cell, weight = cell / 3, weight * 0.6
    return total


def plain(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint a surface with soft stains and a gradient."""
    paint = np.full((height, width, 3), colour, np.float32)
    cell = max(height, width) / 3
    paint *= 1 + 0.1 * noise(rng, height, width, cell)[..., None]
    corners = rng.uniform(-14, 14, (2, 2, 3)).astype(np.float32)
    paint += cv2.resize(corners, (width, height), interpolation=cv2.INTER_LINEAR)
    return as_image(paint)


def vary(rng: np.random.Generator, colour: Sequence[float], spread: float) -> Colour:
    """Return a random colour near another one, with a different brightness and hue."""
    near = np.array(colour) * rng.normal(1, spread) + rng.normal(0, 60 * spread, 3)
    b, g, r = near.clip(8, 247).astype(int).tolist()
    return b, g, r


def vivid(rng: np.random.Generator) -> Colour:
    """Return a random saturated colour of any hue."""
    hsv = np.array([[[rng.integers(180), rng.integers(110, 220), rng.integers(90, 240)]]], np.uint8)
    b, g, r = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0].tolist()
    return b, g, r


def planks(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint wooden boards along the longer side, with varying colour, grain and length."""
    if height > width:
        return np.ascontiguousarray(planks(rng, width, height, colour).transpose(1, 0, 2))
    boards = max(round(height / 36), 1)
    image = np.zeros((height, width, 3), np.uint8)
    ends = np.linspace(0, height, boards + 1).astype(int).tolist()
    for top, bottom in itertools.pairwise(ends):
        left = -int(rng.integers(0, 200))
        while left < width:
            right = left + int(rng.integers(150, 420))
            cv2.rectangle(image, (left, top), (right, bottom), vary(rng, colour, 0.13), -1)
            cv2.line(image, (right, top), (right, bottom), vary(rng, (25, 35, 45), 0.1), 2)
            left = right
        cv2.line(image, (0, top), (width, top), vary(rng, (25, 35, 45), 0.1), 2)
    grain = cv2.resize(noise(rng, height, width // 12 + 2, 24), (width, height))
    return as_image(image * (1 + 0.09 * grain[..., None]))


def tiles(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint square tiles, some with a motif."""
    image = plain(rng, height, width, (190, 195, 200))
    for top in range(0, height, 48):
        for left in range(0, width, 48):
            tile = (left + 45, top + 45)
            cv2.rectangle(image, (left + 2, top + 2), tile, vary(rng, colour, 0.12), -1)
            if rng.random() < 0.3:
                middle, size = (left + 24, top + 24), int(rng.integers(8, 20))
                cv2.circle(image, middle, size, vivid(rng), int(rng.integers(2, 6)), cv2.LINE_AA)
    return as_image(image * (1 + 0.05 * noise(rng, height, width, 100)[..., None]))


def panels(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint the doors of a cupboard, with bevels and handles."""
    image = plain(rng, height, width, colour)
    columns, rows = max(round(width / 110), 1), max(round(height / 170), 1)
    for row, column in np.ndindex(rows, columns):
        x0, x1 = (np.array([column, column + 1]) * width // columns).tolist()
        y0, y1 = (np.array([row, row + 1]) * height // rows).tolist()
        cv2.rectangle(image, (x0, y0), (x1, y1), (30, 35, 40), 2)
        door = image[y0 + 12 : y1 - 12, x0 + 12 : x1 - 12]
        door[:] = as_image(door * rng.uniform(0.75, 1.2, 3).astype(np.float32))
        cv2.rectangle(image, (x0 + 12, y0 + 12), (x1 - 12, y1 - 12), vary(rng, colour, 0.3), 3)
        x, y = x1 - 20 if column % 2 == 0 else x0 + 20, (y0 + y1) // 2 + int(rng.integers(-20, 20))
        cv2.line(image, (x, y - 12), (x, y + 12), vary(rng, (210, 215, 220), 0.1), 5, cv2.LINE_AA)
    return image


def books(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint shelves filled with books of various sizes and colours."""
    image = plain(rng, height, width, colour)
    shelves = max(round(height / 100), 1)
    bottoms = (np.arange(1, shelves + 1) * height // shelves - 8).tolist()
    room_above = height // shelves - 14
    for bottom in bottoms:
        cv2.rectangle(image, (6, bottom - room_above), (width - 7, bottom), (28, 30, 36), -1)
        left = 8
        while (right := left + int(rng.integers(8, 22))) < width - 8:
            top = bottom - int(room_above * rng.uniform(0.6, 0.97))
            if rng.random() < 0.93:
                cv2.rectangle(image, (left, top), (right - 1, bottom), vivid(rng), -1)
                band = top + int(rng.integers(6, 30))
                cv2.rectangle(image, (left, band), (right - 1, band + 6), vivid(rng), -1)
            left = right
    return image


def crate(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint a wooden crate with a stencilled word."""
    image = planks(rng, height, width, colour)
    beam = vary(rng, [0.75 * value for value in colour], 0.1)
    cv2.line(image, (0, height), (width, 0), beam, 24, cv2.LINE_AA)
    cv2.rectangle(image, (8, 8), (width - 9, height - 9), vary(rng, beam, 0.12), 18)
    for x in (9, width - 10):
        for y in (9, height - 10):
            cv2.circle(image, (x, y), 4, (40, 40, 40), -1, cv2.LINE_AA)
    write(rng, image, (30, 30, 30), 0.45)
    return image


def write(rng: np.random.Generator, image: Image, colour: Colour, at: float) -> None:
    """Write an invented word across the image; ``at`` is the height as a share of the image's."""
    height, width = image.shape[:2]
    syllables = rng.integers((14, 5), size=(2, 2)).tolist()
    word = "".join("BDFGKLMNPRSTVZ"[first] + "AEIOU"[second] for first, second in syllables)
    (extent, _), _ = cv2.getTextSize(word, cv2.FONT_HERSHEY_DUPLEX, 1, 2)
    scale = 0.7 * width / extent
    corner = (int(0.15 * width), int(at * height + 10 * scale))
    weight = max(round(2 * scale), 1)
    cv2.putText(image, word, corner, cv2.FONT_HERSHEY_DUPLEX, scale, colour, weight, cv2.LINE_AA)


def poster(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint an abstract poster: a gradient, shapes and a word."""
    ramp = np.linspace(0.7, 1.25, height, dtype=np.float32)[:, None, None]
    image = as_image(plain(rng, height, width, colour) * ramp)
    for _ in range(9):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        size = max(int(rng.uniform(0.06, 0.24) * min(height, width)), 1)
        kind = rng.integers(3)
        if kind == 0:
            cv2.circle(image, (x, y), size, vivid(rng), -1, cv2.LINE_AA)
        elif kind == 1:
            corners = np.add(rng.integers(-2 * size, 2 * size, (3, 2)), (x, y))
            cv2.fillPoly(image, [corners.astype(np.int32)], vivid(rng), cv2.LINE_AA)
        else:
            end = (int(rng.integers(width)), int(rng.integers(height)))
            cv2.line(image, (x, y), end, vivid(rng), max(size // 3, 2), cv2.LINE_AA)
    write(rng, image, (245, 245, 245), rng.uniform(0.2, 0.85))
    return image


def landscape(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint a landscape: sky, clouds and three ranges of hills."""
    sky = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    image = np.array(colour, np.float32) * (1 - sky) + np.array([225, 235, 240], np.float32) * sky
    clouds = noise(rng, height, width, width / 2.5).clip(0, 1.5)[..., None]
    image = image + (250 - image) * clouds * 0.5
    for share, hill in ((0.5, (150, 140, 110)), (0.65, (90, 140, 90)), (0.82, (50, 100, 110))):
        ridge = share + 0.07 * noise(rng, 1, width, width / 2)
        below = np.arange(height)[:, None] > ridge * height
        grain = 1 + 0.15 * noise(rng, height, width, 40)[..., None]
        image = np.where(below[..., None], np.array(hill, np.float32) * grain, image)
    return as_image(image)


def screen(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint a screen: a landscape in a dark bezel."""
    image = landscape(rng, height, width, colour)
    cv2.rectangle(image, (0, 0), (width, height), (28, 26, 26), 24)
    return image


def fabric(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint cloth with stripes of different widths and a few patches."""
    image = plain(rng, height, width, colour)
    left = 0
    while left < width:
        stripe = int(rng.integers(6, 30))
        if rng.random() < 0.55:
            cv2.rectangle(image, (left, 0), (left + stripe, height), vary(rng, colour, 0.25), -1)
        left += stripe
    for _ in range(max(height * width // 12000, 1)):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        cv2.circle(image, (x, y), int(rng.integers(6, 16)), vivid(rng), -1, cv2.LINE_AA)
    return as_image(image * (1 + 0.08 * noise(rng, height, width, 12)[..., None]))


def leaves(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint foliage."""
    image = plain(rng, height, width, (20, 45, 25))
    for _ in range(height * width // 160):
        middle = (int(rng.integers(width)), int(rng.integers(height)))
        size = (int(rng.integers(8, 20)), int(rng.integers(3, 7)))
        turn = float(rng.uniform(0, 180))
        cv2.ellipse(image, middle, size, turn, 0, 360, vary(rng, colour, 0.3), -1, cv2.LINE_AA)
    return image


def _hang(image: Image, art: Image, left_m: float, top_m: float, frame: Colour) -> None:
    """Add a framed picture with a shadow to a wall, offset from the upper left corner in metres."""
    x, y = round(left_m * WALL_TEXELS_M), round(top_m * WALL_TEXELS_M)
    height, width = art.shape[:2]
    shade = image[y - 4 : y + height + 16, x - 4 : x + width + 14]
    shade[:] = as_image(shade * np.float32(0.7))
    image[y : y + height, x : x + width] = art
    cv2.rectangle(image, (x, y), (x + width, y + height), frame, 8)


def front_wall(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint the wall in front of the camera: striped wallpaper, wainscot, window and pictures."""
    image = plain(rng, height, width, colour)
    left = 0
    while left < width:
        stripe = int(rng.integers(14, 60))
        shade = np.float32(rng.uniform(0.84, 1.1))
        image[:, left : left + stripe] = as_image(image[:, left : left + stripe] * shade)
        left += stripe + int(rng.integers(10, 50))
    top = height - round(0.8 * WALL_TEXELS_M)
    image[top:] = panels(rng, height - top, width, (120, 150, 170))
    cv2.rectangle(image, (0, top - 8), (width, top + 8), (90, 120, 150), -1)
    window = landscape(rng, 264, 288, (230, 170, 90))
    for bar in (100, 190):
        cv2.line(window, (bar, 0), (bar, 264), (235, 240, 240), 8)
    cv2.line(window, (0, 110), (288, 110), (235, 240, 240), 8)
    _hang(image, window, 1.02, 0.38, (235, 240, 240))
    _hang(image, poster(rng, 216, 158, (60, 90, 190)), 2.42, 0.25, (30, 30, 30))
    _hang(image, landscape(rng, 110, 150, (120, 120, 220)), 3.25, 0.3, (40, 80, 130))
    _hang(image, poster(rng, 96, 120, (170, 110, 40)), 3.3, 1.2, (20, 20, 60))
    _hang(image, poster(rng, 170, 110, (60, 150, 90)), 0.3, 0.2, (220, 220, 220))
    return image


def tag() -> Image:
    """Paint AprilTag 36h11 number 0: 8 x 8 modules and a white margin of one module."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    square = cv2.aruco.generateImageMarker(family, 0, 8 * TAG_MODULE_TEXELS)
    margin = np.pad(square, TAG_MODULE_TEXELS, constant_values=255)
    # Paper and ink are neither white nor black.
    return as_image(np.repeat(20 + 0.85 * margin[..., None].astype(np.float32), 3, axis=2))
