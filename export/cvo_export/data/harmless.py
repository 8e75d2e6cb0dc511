"""Changes of an image that an interval survives: the alarm is fitted not to mind them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_export.data.noise import Noise
from cvo_export.datasets import PoseDataset

Image = NDArray[np.uint8]

_QUALITY, _NOISE, _STOPS, _BALANCE = 50, 0.01, 0.3, 0.05


def _compressed(image: Image, _: np.random.Generator) -> Image:
    written = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    return np.asarray(cv2.imdecode(written, cv2.IMREAD_COLOR), dtype=np.uint8)


def _grainy(image: Image, generator: np.random.Generator) -> Image:
    return Noise("gaussian", _NOISE).degrade(image, generator)


def _small(image: Image, _: np.random.Generator) -> Image:
    height, width = image.shape[:2]
    half = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(half, (width, height)), dtype=np.uint8)


def _exposed(image: Image, generator: np.random.Generator) -> Image:
    return Noise("exposure", generator.uniform(-_STOPS, _STOPS)).degrade(image, generator)


def _balanced(image: Image, generator: np.random.Generator) -> Image:
    gain = 1.0 + generator.uniform(-_BALANCE, _BALANCE, 3)
    return np.clip(np.rint(image * gain), 0.0, 255.0).astype(np.uint8)


# Stronger JPEG compression, sensor noise, half the resolution, other exposure, other white balance.
HARMLESS: tuple[Callable[[Image, np.random.Generator], Image], ...] = (
    _compressed,
    _grainy,
    _small,
    _exposed,
    _balanced,
)


def harmlessly_changed(dataset: PoseDataset, seed: int, unit: NDArray[np.int64]) -> PoseDataset:
    """Return the data set with one harmless change a unit, the kinds in turn.

    ``unit`` (n,) says which frames change alike, such as those of one recording: one exposure and
    one white balance each, not a flicker, seeded by (seed, unit). Noise is seeded by (seed, frame
    number).
    """

    def read_image(index: int) -> Image:
        change = HARMLESS[int(unit[index]) % len(HARMLESS)]
        drawn_once = index if change is _grainy else int(unit[index])
        generator = np.random.default_rng((seed, drawn_once))
        return dataset.read_changed(index, change, generator)

    return replace(dataset, read_image=read_image)
