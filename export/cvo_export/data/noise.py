"""Image degradations, to evaluate intervals on images worse than the calibration images.

Each degradation has one strength; 0 leaves the image unchanged. It is applied to the camera image,
before the model's resize, which averages out part of the pixel noise, as on a device. The paper
(section V) adds gaussian, salt-and-pepper and speckle noise and does not state strengths.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import UsageError
from cvo_export.datasets import PoseDataset
from cvo_export.scene.sensor import streak

Image = NDArray[np.uint8]

# Drawn noises have this share of the default strength and more.
_MILDEST = 0.3


@dataclass(frozen=True)
class Noise:
    """One image degradation; ``str`` gives the text that ``parse_noise`` reads.

    Raises UsageError for a name that is not in ``KINDS``, or a strength outside its range.

    Attributes
    ----------
    name
        A key of ``KINDS``.
    strength
        In the unit given in ``KINDS``.
    """

    name: str
    strength: float

    def __post_init__(self) -> None:
        """Raise UsageError for an unknown name or a strength outside its range."""
        if self.name not in KINDS:
            raise _unknown(self.name)
        kind = KINDS[self.name]
        # Written so that NaN is out of range.
        if not kind.lowest <= self.strength <= kind.highest:
            raise _out_of_range(self.name, f"{self.strength:g}")

    def __str__(self) -> str:
        return f"{self.name}:{self.strength}"

    @property
    def unit(self) -> str:
        """Unit of the strength."""
        return KINDS[self.name].unit

    def degrade(self, image: Image, generator: np.random.Generator) -> Image:
        """Return a degraded copy of an image, shape (height, width, 3), uint8, BGR."""
        return KINDS[self.name].degrade(image, self.strength, generator)


def parse_noise(text: str) -> Noise:
    """Read ``NAME``, at its default strength, or ``NAME:STRENGTH``, e.g. ``speckle:0.3``.

    Raises UsageError for any other text.
    """
    name, colon, digits = text.partition(":")
    if name not in KINDS:
        raise _unknown(text)
    if not colon:
        return Noise(name, KINDS[name].default)
    try:
        return Noise(name, float(digits))
    except ValueError:
        raise _out_of_range(name, repr(digits)) from None


def drawn(name: str, generator: np.random.Generator) -> Noise:
    """Draw a strength for a kind of noise: 0.3 to 1 of its default, as mild noise matters, too."""
    return Noise(name, KINDS[name].default * generator.uniform(_MILDEST, 1.0))


def noisy(dataset: PoseDataset, noise: Noise, seed: int) -> PoseDataset:
    """Return the data set with every image degraded, seeded by (seed, frame number).

    The result does not depend on the order of reading. Names and poses stay the same, so splits
    and roles do too.
    """

    def read_image(index: int) -> Image:
        generator = np.random.default_rng((seed, index))
        return dataset.read_changed(index, noise.degrade, generator)

    return replace(dataset, read_image=read_image)


# -- kinds ----------------------------------------------------------------------------------------


def _normal(image: Image, generator: np.random.Generator) -> NDArray[np.float32]:
    """Draw standard normal noise per pixel and channel; a grey image gets the same in all three."""
    if (image == image[..., :1]).all():
        grey = generator.standard_normal((*image.shape[:2], 1), dtype=np.float32)
        return np.repeat(grey, image.shape[2], axis=2)
    return generator.standard_normal(image.shape, dtype=np.float32)


def _gaussian(image: Image, strength: float, generator: np.random.Generator) -> Image:
    """Return I + 255 s n, n standard normal per pixel and channel: sensor noise."""
    noise = _normal(image, generator)
    # OpenCV rounds sums and products and clips them to 0..255.
    noisy = cv2.add(image, np.float32(255.0 * strength) * noise, dtype=cv2.CV_8U)
    return np.asarray(noisy, dtype=np.uint8)


def _salt_and_pepper(image: Image, strength: float, generator: np.random.Generator) -> Image:
    """Turn each pixel white with probability s/2 and black with s/2: hot and dead pixels."""
    drawn = generator.random(image.shape[:2])
    noisy = image.copy()
    noisy[drawn < 0.5 * strength] = 0
    noisy[drawn >= 1.0 - 0.5 * strength] = 255
    return noisy


def _speckle(image: Image, strength: float, generator: np.random.Generator) -> Image:
    """Return I (1 + s n), n standard normal per pixel and channel; affects bright pixels most."""
    noise = _normal(image, generator)
    noisy = cv2.multiply(image, 1.0 + np.float32(strength) * noise, dtype=cv2.CV_8U)
    return np.asarray(noisy, dtype=np.uint8)


def _motion_blur(image: Image, strength: float, generator: np.random.Generator) -> Image:
    """Average along a straight path of s image widths in a random direction.

    The path is centred on the pixel, so that the pose is that of the middle of the exposure.
    """
    length = strength * image.shape[1]
    angle = generator.uniform(0.0, math.pi)
    shift = length * np.array([math.cos(angle), math.sin(angle)])
    # With two samples per pixel, bilinear weights leave no ripple.
    kernel = streak(shift, 2 * math.ceil(length) + 1)
    blurred = cv2.filter2D(image, cv2.CV_8U, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=np.uint8)


def _exposure(image: Image, strength: float, _: np.random.Generator) -> Image:
    """Change the exposure by s stops, a factor of 2^s clipped at white; negative is darker.

    The factor applies in linear light, as with a shutter: values are decoded and encoded with the
    sRGB curves (IEC 61966-2-1). Pixels that the camera clipped at white turn grey in a darker
    image. Not random.
    """
    coded = np.arange(256) / 255.0
    light = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    light = np.minimum(light * 2.0**strength, 1.0)
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return np.asarray(cv2.LUT(image, np.rint(255.0 * coded).astype(np.uint8)), dtype=np.uint8)


def _occlusion(image: Image, strength: float, generator: np.random.Generator) -> Image:
    """Cover a share s of the image by a rectangle of its shape, at random place and colour."""
    height, width = (round(math.sqrt(strength) * side) for side in image.shape[:2])
    top = generator.integers(image.shape[0] - height, endpoint=True)
    left = generator.integers(image.shape[1] - width, endpoint=True)
    covered = image.copy()
    covered[top : top + height, left : left + width] = generator.integers(256, size=3)
    return covered


class Kind(NamedTuple):
    """A kind of degradation, with the default, range and unit of its strength."""

    degrade: Callable[[Image, float, np.random.Generator], Image]
    default: float
    lowest: float
    highest: float
    unit: str


# The first three names and defaults follow MATLAB's imnoise: variances 0.01 and 0.05 (a standard
# deviation of 0.22), density 0.05. The other defaults are about as visible in a picture of a room.
KINDS: dict[str, Kind] = {
    "gaussian": Kind(_gaussian, 0.1, 0.0, 1.0, "deviation, share of the full range"),
    "salt-and-pepper": Kind(_salt_and_pepper, 0.05, 0.0, 1.0, "share of the pixels"),
    "speckle": Kind(_speckle, 0.22, 0.0, 1.0, "deviation, share of the pixel's own level"),
    "motion-blur": Kind(_motion_blur, 0.03, 0.0, 0.5, "length, share of the image's width"),
    "exposure": Kind(_exposure, -2.0, -8.0, 8.0, "stops, negative is darker"),
    "occlusion": Kind(_occlusion, 0.1, 0.0, 1.0, "share of the image's area"),
}


def _unknown(text: str) -> UsageError:
    return UsageError(
        f"noise: expected NAME or NAME:STRENGTH with NAME one of {', '.join(KINDS)}, found {text!r}"
    )


def _out_of_range(name: str, found: str) -> UsageError:
    kind = KINDS[name]
    return UsageError(
        f"noise {name}: expected a strength of {kind.lowest:g} to {kind.highest:g} ({kind.unit}), "
        f"found {found}"
    )
