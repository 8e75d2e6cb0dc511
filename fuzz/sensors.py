"""A camera that fails in every way it can, frame by frame, among clean frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.images import decode_image
from cvo_edge.odometer import Odometer
from cvo_edge.pose import PoseInterval, Status
from cvo_edge.preprocess import to_bgr8
from cvo_edge.sources import Frame, open_source
from fuzz.bundles import ARTIFACTS
from fuzz.mutate import Generator
from fuzz.trials import Tally

Image = NDArray[Any]

_CLIP = ARTIFACTS / "synthetic-room-clip"
# Every frame differs from all others by a sensor's noise.
_NOISE = 2.0
_STEP_NS = 33_000_000


def _noisy(image: Image, generator: Generator, deviation: float = _NOISE) -> NDArray[np.uint8]:
    noise = generator.normal(0.0, deviation, image.shape).round()
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def _one_colour(image: Image, generator: Generator) -> Image:
    colour = generator.integers(0, 256, 3)
    return _noisy(np.zeros_like(image) + colour.astype(np.uint8), generator, 1.0)


def _cut_jpeg(image: Image, generator: Generator) -> Image | None:
    content = cv2.imencode(".jpg", image)[1].tobytes()
    return decode_image(content[: int(generator.integers(len(content) - 1))])


def _other_size(image: Image, generator: Generator) -> Image:
    height, width = image.shape[:2]
    return image[: int(generator.integers(16, height)), : int(generator.integers(16, width))]


def _with_nan(image: Image, generator: Generator) -> Image:
    broken = image.astype(np.float32)
    broken[int(generator.integers(len(broken)))] = np.nan
    return broken


# Kind -> (image, the one before, generator) -> image or None.
_IMAGES: dict[str, Callable[[Image, Image, Generator], Image | None]] = {
    "black": lambda image, _, __: np.zeros_like(image),
    "black with noise": lambda image, _, g: _noisy(np.zeros_like(image), g, g.uniform(1.0, 6.0)),
    "white": lambda image, _, __: np.full_like(image, 255),
    "blown out": lambda image, _, g: np.clip(image * g.uniform(6.0, 20.0), 0, 255).astype(np.uint8),
    "one colour": lambda image, _, g: _one_colour(image, g),
    "frozen": lambda _, before, __: before,
    "frozen, another buffer": lambda _, before, __: before.copy(),
    "cut JPEG": lambda image, _, g: _cut_jpeg(image, g),
    "another size": lambda image, _, g: _other_size(image, g),
    "NaN": lambda image, _, g: _with_nan(image, g),
    "no image": lambda _, __, ___: None,
    "a few pixels": lambda image, _, g: image[: g.integers(0, 16)],
    "no colours": lambda image, _, __: image[:, :, :2],
}
_STAMPS = {"same stamp": 0, "an older stamp": -_STEP_NS}
_KINDS = (*_IMAGES, *_STAMPS, "stale")


def sensors(count: int) -> Tally:
    """Half of the frames are faulted; those have no finite interval, and hardly a clean one does.

    Findings are faulted frames with a finite interval; a clean frame without one is counted.
    """
    tally = Tally()
    generator = np.random.default_rng(2028)
    with Odometer.load(ARTIFACTS / "synthetic-room-cjp-int8") as odometer:
        for kind, estimate in _estimates(odometer, count, generator):
            if kind is None:
                good = estimate.status is Status.OK and estimate.bounded
                tally.add("clean, ok" if good else f"clean, {', '.join(estimate.reasons)}")
                continue
            finite = bool(np.isfinite([*estimate.lower, *estimate.upper]).any())
            finding = f"{kind}, frame {estimate.seq}: a finite interval" if finite else None
            tally.add(f"{kind}, {estimate.status}", finding)
    return tally


def _estimates(
    odometer: Odometer, count: int, generator: Generator
) -> Iterator[tuple[str | None, PoseInterval]]:
    """Yield the kind of fault, None for a clean frame, with its estimate."""
    images = [frame.image for frame in open_source(str(_CLIP)) if frame.image is not None]
    before, now_ns = images[0], 0
    kinds: list[str | None] = []

    def frames() -> Iterator[Frame]:
        nonlocal before, now_ns
        for number in range(2 * count):
            image = _noisy(images[(number // 4) % len(images)], generator)
            now_ns += _STEP_NS
            frame = Frame(image, now_ns, "", 0.0)
            # Clean and faulted ones in any order.
            kind = (
                _KINDS[int(generator.integers(len(_KINDS)))] if generator.random() < 0.5 else None
            )
            if number == 0:
                kind = None
            if kind in _IMAGES:
                frame = replace(frame, image=_IMAGES[kind](image, before, generator))
            elif kind in _STAMPS:
                now_ns += _STAMPS[kind] - _STEP_NS
                frame = replace(frame, stamp_ns=now_ns)
            elif kind == "stale":
                frame = replace(frame, waited_ms=float(generator.uniform(1001.0, 1e5)))
            kinds.append(kind)
            if frame.image is not None and to_bgr8(frame.image) is not None:
                before = frame.image
            yield frame

    for estimate in odometer.stream(frames()):
        yield kinds[estimate.seq], estimate
