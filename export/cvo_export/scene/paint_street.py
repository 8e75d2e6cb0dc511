"""Procedural textures of a street: facades, ground, cars and sky."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_export.scene.paint import Colour, fabric, noise, plain, planks, poster, vary, vivid, write
from cvo_export.scene.renderer import Image, as_image

WALL_TEXELS_M = 40  # windows and bricks have a size in metres
_STOREY_M = 3.1


def facade(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint the front of a house: plaster, bricks or boards, windows, and a shop or a door."""
    unit = WALL_TEXELS_M
    image = _wall(rng, height, width, colour)
    trim = vary(rng, (200, 205, 210), 0.15)
    columns = max(round(width / unit / rng.uniform(2.0, 3.2)), 2)
    pane = (int(unit * rng.uniform(0.9, 1.3)), int(unit * rng.uniform(1.3, 1.9)))
    ground = height - int(1.05 * _STOREY_M * unit)
    bottom = ground - int(0.5 * unit)
    while bottom - pane[1] > 0.3 * unit:
        for middle in ((np.arange(columns) + 0.5) * width / columns).astype(int).tolist():
            _window(rng, image, (middle - pane[0] // 2, bottom - pane[1]), pane, trim)
        bottom -= int(_STOREY_M * unit)
    cv2.rectangle(image, (0, 0), (width, int(0.25 * unit)), trim, -1)
    cv2.rectangle(image, (0, ground - 6), (width, ground + 2), vary(rng, trim, 0.1), -1)
    if rng.random() < 0.6:
        _shop(rng, image[ground + 3 :])
    else:
        _entrance(rng, image[ground + 3 :], columns, trim)
    streaks = noise(rng, 1, width, 0.8 * unit) * np.linspace(1, 0.3, height)[:, None]
    return as_image(image * (1 + 0.05 * streaks[..., None]))


def _wall(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    kind = rng.integers(3)
    if kind == 0:
        return plain(rng, height, width, colour)
    if kind == 1:
        return planks(rng, height, width, colour)
    rows, columns = height // 6 + 1, width // 14 + 2
    bricks = np.array(colour) * rng.normal(1, 0.13, (rows, columns, 1))
    bricks += rng.normal(0, 6, (rows, columns, 3))
    row, column = np.arange(height)[:, None], np.arange(width)[None, :]
    column = column + 7 * (row // 6 % 2)
    image = bricks[row // 6, column // 14]
    image[(row % 6 == 0) | (column % 14 == 0)] = vary(rng, (165, 170, 175), 0.1)
    return as_image(image)


def _window(
    rng: np.random.Generator, image: Image, at: tuple[int, int], pane: tuple[int, int], trim: Colour
) -> None:
    """Paint a window with its upper left corner ``at``; it may have shutters, curtains, flowers."""
    (x, y), (width, height) = at, pane
    end = (x + width, y + height)
    if rng.random() < 0.35:
        shutter = vivid(rng)
        for left in (x - width // 2 - 3, x + width + 3):
            cv2.rectangle(image, (left, y), (left + width // 2, end[1]), shutter, -1)
    glass = vary(rng, (120, 95, 70), 0.35)
    cv2.rectangle(image, at, end, glass, -1)
    cv2.line(image, (x, end[1]), (end[0], y), vary(rng, (190, 170, 150), 0.2), width // 5)
    if rng.random() < 0.5:
        curtain, drop = vivid(rng), y + int(height * rng.uniform(0.2, 0.9))
        cv2.rectangle(image, at, (x + width, drop), curtain, -1)
    cv2.rectangle(image, at, end, trim, 3)
    cv2.line(image, (x + width // 2, y), (x + width // 2, end[1]), trim, 2)
    if rng.random() < 0.3:
        cv2.rectangle(image, (x - 3, end[1] - 4), (end[0] + 3, end[1] + 7), vivid(rng), -1)


def _shop(rng: np.random.Generator, image: Image) -> None:
    """Paint a shop over the ground floor, in place: sign, shop windows and a door."""
    height, width = image.shape[:2]
    sign = int(0.24 * height)
    image[:] = plain(rng, height, width, vary(rng, (70, 65, 60), 0.3))
    image[4:sign, 6 : width - 6] = _sign(rng, sign - 4, width - 12)
    parts = max(width // 110, 2)
    door = int(rng.integers(parts))
    for part in range(parts):
        left, right = part * width // parts + 8, (part + 1) * width // parts - 8
        if part == door:
            panel = vivid(rng)
            cv2.rectangle(image, (left + 8, sign + 12), (right - 8, height), panel, -1)
            cv2.rectangle(
                image, (left + 16, sign + 20), (right - 16, height - 40), (90, 75, 60), -1
            )
            continue
        top, low = sign + 10, height - int(0.15 * height)
        draw = fabric if rng.random() < 0.4 else poster
        image[top:low, left:right] = draw(rng, low - top, right - left, vivid(rng))
        cv2.rectangle(image, (left, top), (right, low), (40, 40, 45), 3)


def _sign(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint a board with a word that fits its height."""
    board = plain(rng, height, width, vivid(rng))
    lettering = np.zeros((height, min(3 * height, width), 3), np.uint8)
    write(rng, lettering, (1, 1, 1), 0.5)
    left = int(rng.integers(width - lettering.shape[1] + 1))
    part = board[:, left : left + lettering.shape[1]]
    part[lettering > 0] = 240
    return board


def _entrance(rng: np.random.Generator, image: Image, columns: int, trim: Colour) -> None:
    """Paint a door and windows over the ground floor, in place."""
    height, width = image.shape[:2]
    door = int(rng.integers(columns))
    for column in range(columns):
        middle = int((column + 0.5) * width / columns)
        if column == door:
            cv2.rectangle(image, (middle - 22, height - 90), (middle + 22, height), trim, -1)
            cv2.rectangle(image, (middle - 18, height - 86), (middle + 18, height), vivid(rng), -1)
        else:
            _window(rng, image, (middle - 20, height - 100), (40, 56), trim)
    cv2.rectangle(image, (0, height - 14), (width, height), vary(rng, (90, 95, 100), 0.2), -1)


def ground(
    rng: np.random.Generator, aside: NDArray[np.float32], texels_m: int, colour: Colour
) -> Image:
    """Paint asphalt with dashes, cracks and repairs, and slabs beyond the kerbs.

    ``aside`` (height, width) is the distance of each texel from the middle line of the road, as a
    multiple of that of the kerb.
    """
    height, width = aside.shape
    image = np.full((height, width, 3), colour, np.uint8)
    for _ in range(height * width // 40_000):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        size = rng.integers(20, 100, 2).tolist()
        cv2.rectangle(image, (x, y), (x + size[0], y + size[1]), vary(rng, colour, 0.15), -1)
        cover = int(rng.integers(width)), int(rng.integers(height))
        cv2.circle(image, cover, texels_m // 3, vary(rng, (60, 62, 66), 0.2), -1)
        crack = np.add(rng.integers(-14, 15, (12, 2)).cumsum(axis=0), (x, y))
        cv2.polylines(image, [crack.astype(np.int32)], False, (45, 45, 48), 2)
    rows, columns = np.arange(height)[:, None], np.arange(width)[None, :]
    dashed = (rows + columns) % (5 * texels_m) < 2 * texels_m
    image[dashed & (np.abs(aside) < 0.02)] = (205, 210, 212)
    edge = texels_m // 2
    tones = as_image(rng.normal(165, 14, (height // edge + 1, width // edge + 1)))
    slabs = tones[rows // edge, columns // edge]
    slabs[(rows % edge == 0) | (columns % edge == 0)] = 125
    paved = np.abs(aside) > 1
    image[paved] = slabs[paved][:, None]
    image[np.abs(np.abs(aside) - 1) < 0.03] = (190, 193, 195)
    stains = 1 + 0.08 * noise(rng, height // 3, width // 3, 2 * texels_m)
    return as_image(image * cv2.resize(stains, (width, height))[..., None])


def car_body(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint the side of a car below its windows: doors, lamps, wheels."""
    image = plain(rng, height, width, colour)
    dark = int(0.72 * height)
    cv2.rectangle(image, (0, dark), (width, height), (28, 28, 30), -1)
    for x in (width // 5, 4 * width // 5):
        cv2.circle(image, (x, int(0.68 * height)), int(0.32 * height), (22, 22, 24), -1)
        cv2.circle(image, (x, int(0.68 * height)), int(0.18 * height), (170, 172, 175), -1)
    for x in (width // 3, 3 * width // 5):
        cv2.line(image, (x, 3), (x, dark), vary(rng, (50, 50, 55), 0.2), 1)
    for x, lamp in ((2, (60, 60, 220)), (width - 14, (215, 235, 240))):
        cv2.rectangle(image, (x, height // 6), (x + 12, height // 3), lamp, -1)
    return image


def car_windows(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint the cabin of a car: its windows in a frame of its colour."""
    image = plain(rng, height, width, colour)
    for left, right in ((0.06, 0.48), (0.53, 0.94)):
        corners = (int(left * width), int(0.12 * height)), (int(right * width), int(0.9 * height))
        cv2.rectangle(image, *corners, vary(rng, (75, 65, 50), 0.2), -1)
    return image


def sky(rng: np.random.Generator, height: int, width: int, colour: Colour) -> Image:
    """Paint a horizon with clouds, whose left and right ends fit together."""
    low = np.array([225, 222, 215], np.float32)
    share = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    image = np.array(colour, np.float32) * (1 - share) + low * share
    clouds = noise(rng, height, 2 * width, height / 1.5)
    blend = np.linspace(0, 1, width, dtype=np.float32)
    clouds = clouds[:, :width] * blend + clouds[:, width:] * (1 - blend)
    return as_image(image + (248 - image) * clouds.clip(0, 1.4)[..., None] * 0.6)
