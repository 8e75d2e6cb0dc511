"""Wrong images made from one right image: geometry, format, sensor, optics and no picture at all.

Each function maps an image (height, width, 3), uint8, BGR, and a random generator to a new image of
the same size. ``wrong_kinds`` gives the functions their names, strengths and generators. Lengths
are shares of the image's width or height, so that an effect looks alike at every resolution.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]
Random = np.random.Generator
Alteration = Callable[[Image, Random], Image]

SKIN_BGR = (105, 135, 190)


def shown(values: NDArray[np.floating] | NDArray[np.integer]) -> Image:
    """Round values of any type to 0..255."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def resized(image: Image, like: Image) -> Image:
    """Scale an image to the size of another one."""
    return np.asarray(cv2.resize(image, like.shape[1::-1], interpolation=cv2.INTER_LINEAR))


def _grid(image: Image) -> tuple[Floats, Floats]:
    """Return x and y of each pixel, as shares of width and height."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return x / width, y / height


def _warped(image: Image, x: Floats, y: Floats) -> Image:
    """Sample an image at shares of its width and height, with its edge continued."""
    height, width = image.shape[:2]
    places = (x * width).astype(np.float32), (y * height).astype(np.float32)
    warped = cv2.remap(image, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.uint8)


def _blurred(image: NDArray[np.generic], share: float) -> NDArray[np.generic]:
    """Blur with a Gaussian whose deviation is a share of the width."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), share * image.shape[1]))


def _mixed(image: Image, other: NDArray[np.generic] | float, weight: Floats) -> Image:
    """Blend with another image or level; ``weight`` (height, width) is the other one's share."""
    share = weight[..., np.newaxis]
    return shown(image * (1.0 - share) + np.asarray(other, np.float32) * share)


# -- geometry -------------------------------------------------------------------------------------


def turned_90(image: Image, _: Random) -> Image:
    """Turn by a right angle, and stretch to the shape it had."""
    return resized(np.ascontiguousarray(np.rot90(image)), image)


def zoomed(factor: float) -> Alteration:
    """Enlarge about the middle; below 1, black surrounds the image."""

    def alter(image: Image, _: Random) -> Image:
        height, width = image.shape[:2]
        matrix = np.array(
            [[factor, 0, (1 - factor) * width / 2], [0, factor, (1 - factor) * height / 2]]
        )
        return np.asarray(cv2.warpAffine(image, matrix, (width, height)), np.uint8)

    return alter


def cut(top: float, bottom: float, left: float, right: float) -> Alteration:
    """Keep a part, given as shares of height and width, and stretch it to the full size."""

    def alter(image: Image, _: Random) -> Image:
        height, width = image.shape[:2]
        rows = slice(round(top * height), round(bottom * height))
        return resized(image[rows, round(left * width) : round(right * width)], image)

    return alter


def rolled(share: float, axis: int) -> Alteration:
    """Shift cyclically by a share of the height (axis 0) or the width (axis 1)."""
    return lambda image, _: np.roll(image, round(share * image.shape[axis]), axis)


def sheared(image: Image, _: Random) -> Image:
    """Shift rows sideways, by 15 % of the width from top to bottom: a rolling shutter in a turn."""
    x, y = _grid(image)
    return _warped(image, x + 0.15 * (y - 0.5), y)


def wobbling(image: Image, random: Random) -> Image:
    """Shift rows sideways in waves of 3 % of the width: a rolling shutter beside a motor."""
    x, y = _grid(image)
    phase = random.uniform(0.0, 2 * np.pi)
    return _warped(image, x + 0.03 * np.sin(6 * np.pi * y + phase).astype(np.float32), y)


def barrel(image: Image, _: Random) -> Image:
    """Add the distortion of a wide lens: r becomes r (1 + r^2), r in half widths."""
    x, y = _grid(image)
    aspect = image.shape[0] / image.shape[1]
    squared = (x - 0.5) ** 2 + ((y - 0.5) * aspect) ** 2
    return _warped(image, 0.5 + (x - 0.5) * (1 + squared), 0.5 + (y - 0.5) * (1 + squared))


# -- colour and format ----------------------------------------------------------------------------


def yuv_as_bgr(image: Image, _: Random) -> Image:
    """Show Y, U and V as blue, green and red."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2YUV), np.uint8)


def nv12_as_grey(image: Image, _: Random) -> Image:
    """Show the memory of an NV12 image, luma above interleaved chroma, as one grey image."""
    even = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
    planar = cv2.cvtColor(np.ascontiguousarray(even), cv2.COLOR_BGR2YUV_I420)
    height, width = even.shape[:2]
    chroma = planar[height:].reshape(2, -1).T.reshape(-1, width)
    return np.repeat(resized(np.vstack([planar[:height], chroma]), image)[..., None], 3, axis=2)


def yuyv_as_grey(image: Image, _: Random) -> Image:
    """Show the memory of a YUYV image, every second byte chroma, as one grey image."""
    yuv = cv2.cvtColor(image, cv2.COLOR_BGR2YUV)
    packed = np.empty((image.shape[0], 2 * image.shape[1]), np.uint8)
    packed[:, ::2] = yuv[..., 0]
    packed[:, 1::4], packed[:, 3::4] = yuv[:, ::2, 1], yuv[:, ::2, 2][:, : packed.shape[1] // 4]
    return np.repeat(packed[:, : image.shape[1], None], 3, axis=2)


def grey(image: Image, _: Random) -> Image:
    """Show the luma only."""
    return np.repeat(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)[..., None], 3, axis=2)


def without(channel: int) -> Alteration:
    """Set one of blue, green and red (0, 1, 2) to zero."""

    def alter(image: Image, _: Random) -> Image:
        left = image.copy()
        left[..., channel] = 0
        return left

    return alter


def bayer(image: Image, _: Random) -> Image:
    """Show the raw mosaic (RGGB) of a sensor as a grey image."""
    mosaic = image[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = image[::2, ::2, 2], image[1::2, 1::2, 0]
    return np.repeat(mosaic[..., None], 3, axis=2)


def wrong_stride(image: Image, _: Random) -> Image:
    """Read rows that are 1 % longer in memory than assumed: the image leans over and wraps."""
    width = image.shape[1]
    padded = np.zeros((image.shape[0], width + max(1, width // 100), 3), np.uint8)
    padded[:, :width] = image
    return padded.reshape(-1, 3)[: image.shape[0] * width].reshape(image.shape)


def linear_light(image: Image, _: Random) -> Image:
    """Leave out the gamma curve (2.2): linear light shown as it is."""
    return np.asarray(cv2.LUT(image, shown(255 * (np.arange(256) / 255) ** 2.2)), np.uint8)


# -- sensor ---------------------------------------------------------------------------------------


def dead_columns(image: Image, random: Random) -> Image:
    """Set 5 % of the columns to black or white."""
    dead = random.random(image.shape[1])
    found = image.copy()
    found[:, dead < 0.025], found[:, dead > 0.975] = 0, 255
    return found


def column_pattern(image: Image, random: Random) -> Image:
    """Add an offset to each column, deviation 10 % of the range: uncorrected amplifiers."""
    return shown(image + 25.5 * random.standard_normal((1, image.shape[1], 1)))


def vignette(image: Image, _: Random) -> Image:
    """Darken towards the corners to 5 %, as with a wrong lens hood."""
    x, y = _grid(image)
    radius = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2) / np.sqrt(0.5)
    return shown(image * np.maximum(1 - 1.3 * radius**2, 0.05)[..., None])


def flicker(image: Image, random: Random) -> Image:
    """Dark bands of lamps at mains frequency, at a new place in each image; brightness .4 to 1."""
    _, y = _grid(image)
    phase = random.uniform(0.0, 2 * np.pi)
    return shown(image * (0.7 + 0.3 * np.sin(4 * np.pi * y + phase))[..., None])


def bloom(image: Image, _: Random) -> Image:
    """Saturated charge flows over columns: what is brighter than nine tenths runs down."""
    luma = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    bright = (luma >= np.quantile(luma, 0.9)).astype(np.float32)
    smear = cv2.blur(bright, (1, 2 * (image.shape[0] // 3) + 1), borderType=cv2.BORDER_CONSTANT)
    return shown(image + 600.0 * np.asarray(_blurred(np.maximum(smear, bright), 0.005))[..., None])


# -- optics ---------------------------------------------------------------------------------------


def defocused(image: Image, _: Random) -> Image:
    """Average over a disc of 2 % of the width: far out of focus."""
    radius = max(2, round(0.02 * image.shape[1]))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    blurred = cv2.filter2D(image, -1, disc / disc.sum(), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, np.uint8)


def _blotches(image: Image, random: Random, count: int, least: float, most: float) -> Floats:
    """Draw discs of a share of the width as radius at random places: 1 inside, 0 outside."""
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.float32)
    for _ in range(count):
        x, y = random.uniform(0, width), random.uniform(0, height)
        radius = width * random.uniform(least, most)
        cv2.circle(mask, (round(x), round(y)), max(1, round(radius)), 1.0, -1)
    return mask


def dirt(image: Image, random: Random) -> Image:
    """Brown blots on the lens, far out of focus."""
    weight = 0.9 * np.asarray(_blurred(_blotches(image, random, 14, 0.02, 0.08), 0.012))
    return _mixed(image, np.array([20, 35, 50]), weight.astype(np.float32))


def drops(image: Image, random: Random) -> Image:
    """Water drops on the lens: each shows the scene upside down, small and blurred."""
    height, width = image.shape[:2]
    soft = np.asarray(_blurred(image, 0.01), np.uint8)
    inverted = resized(soft[::-1, ::-1], image)
    found, y, x = image.copy(), *np.mgrid[:height, :width]
    for _ in range(16):
        cx, cy = random.uniform(0, width), random.uniform(0, height)
        radius = width * random.uniform(0.02, 0.07)
        inside = (x - cx) ** 2 + (y - cy) ** 2 < radius**2
        # A drop shows about six times its own size.
        rows = np.clip(height - 1 - (cy + 6 * (y[inside] - cy)), 0, height - 1).astype(int)
        columns = np.clip(width - 1 - (cx + 6 * (x[inside] - cx)), 0, width - 1).astype(int)
        found[inside] = inverted[rows, columns]
    return found


def rain(image: Image, random: Random) -> Image:
    """Draw 250 bright, slanted streaks of 4 to 10 % of the height."""
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.float32)
    for _ in range(250):
        x, y = random.uniform(0, width), random.uniform(0, height)
        length = height * random.uniform(0.04, 0.1)
        end = round(x + 0.2 * length), round(y + length)
        cv2.line(mask, (round(x), round(y)), end, random.uniform(0.3, 0.7), max(1, width // 300))
    return _mixed(image, 220.0, np.asarray(_blurred(mask, 0.001), np.float32))


def fog(image: Image, _: Random) -> Image:
    """Blend to 75 % with light grey, and blur: a breath on the lens."""
    weight = np.full(image.shape[:2], 0.75, np.float32)
    return _mixed(np.asarray(_blurred(image, 0.004), np.uint8), 200.0, weight)


def hand(image: Image, random: Random) -> Image:
    """A hand before the lens: a palm and four fingers, blurred, over a third of the image."""
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.float32)
    x, y = width * random.uniform(0.35, 0.65), height * random.uniform(0.8, 0.95)
    palm = round(0.2 * width), round(0.3 * height)
    cv2.ellipse(mask, (round(x), round(y)), palm, 0, 0, 360, 1.0, -1)
    for finger in (-1.5, -0.5, 0.5, 1.5):
        tip = round(x + 0.13 * finger * width), round(y - (0.75 - 0.06 * abs(finger)) * height)
        cv2.line(mask, (round(x + 0.1 * finger * width), round(y)), tip, 1.0, round(0.075 * width))
    return _mixed(image, np.array(SKIN_BGR), np.asarray(_blurred(mask, 0.01), np.float32))


def half_covered(image: Image, _: Random) -> Image:
    """The left half is behind something dark and near."""
    x, _y = _grid(image)
    weight = 1.0 / (1.0 + np.exp((x - 0.5) / 0.02))
    return _mixed(image, np.array([30.0, 35.0, 40.0]), weight.astype(np.float32))


def cracked(image: Image, random: Random) -> Image:
    """A star of cracks: bright lines, and the scene is displaced between them."""
    x, y = _grid(image)
    cx, cy = random.uniform(0.3, 0.7, 2)
    angle = np.arctan2(y - cy, x - cx)
    edges = np.sort(random.uniform(-np.pi, np.pi, 11))
    sector = np.searchsorted(edges, angle) % 11
    shift = random.uniform(-0.03, 0.03, (11, 2)).astype(np.float32)
    found = _warped(image, x + shift[sector, 0], y + shift[sector, 1])
    height, width = image.shape[:2]
    for edge in edges:
        end = round((cx + 2 * np.cos(edge)) * width), round((cy + 2 * np.sin(edge)) * height)
        cv2.line(found, (round(cx * width), round(cy * height)), end, (235,) * 3, 1 + width // 250)
    return found


def flare(image: Image, random: Random) -> Image:
    """A lamp shines into the lens: a glow, and its ghosts through the middle of the image."""
    x, y = _grid(image)
    sun = random.uniform(0.15, 0.35, 2)
    light = 350 * np.exp(-20 * ((x - sun[0]) ** 2 + (y - sun[1]) ** 2)) + 40
    for along, radius in ((0.6, 0.03), (1.3, 0.05), (1.7, 0.1)):
        cx, cy = sun + along * (0.5 - sun)
        light += 60 * ((x - cx) ** 2 + (y - cy) ** 2 < radius**2)
    return shown(image + light[..., None] * np.array([0.85, 0.95, 1.0]))


# -- no picture -----------------------------------------------------------------------------------


def white_noise(image: Image, random: Random) -> Image:
    """Uniform noise in each pixel and channel."""
    return random.integers(256, size=image.shape, dtype=np.uint8)


def colour_bars(image: Image, _: Random) -> Image:
    """Eight vertical bars: white, yellow, cyan, green, magenta, red, blue, black."""
    bars = np.array([[c & 1, c >> 2 & 1, c >> 1 & 1] for c in range(7, -1, -1)], np.uint8) * 191
    number = np.arange(image.shape[1]) * 8 // image.shape[1]
    return np.repeat(bars[number][np.newaxis], image.shape[0], axis=0)


def text_on(colour: tuple[int, int, int], text: str) -> Alteration:
    """Show a text in white on one colour, BGR, instead of the picture."""

    def alter(image: Image, _: Random) -> Image:
        height, width = image.shape[:2]
        found = np.full_like(image, colour)
        size = width / (22.0 * len(text))
        place = round(0.1 * width), round(0.55 * height)
        cv2.putText(
            found, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, (255,) * 3, 1 + width // 200
        )
        return found

    return alter


def checkerboard(image: Image, _: Random) -> Image:
    """Black and white squares of a tenth of the width."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width] // max(1, width // 10)
    return np.repeat((255 * ((x + y) % 2)).astype(np.uint8)[..., None], 3, axis=2)


def gradient(image: Image, _: Random) -> Image:
    """Grey from black at the left to white at the right."""
    x, _y = _grid(image)
    return np.repeat(shown(255 * x)[..., None], 3, axis=2)
