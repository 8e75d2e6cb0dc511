"""Camera streams that mix faulty frames of every kind with clean frames."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.estimate import PoseInterval
from cvo_edge.input.decoding import decode_image
from cvo_edge.input.frame import Frame
from cvo_edge.input.frame_checks import Look, StreamChecks, image_doubt
from cvo_edge.input.preprocess import model_input, to_bgr8
from cvo_edge.input.sources import open_source
from cvo_edge.odometer import Odometer
from cvo_edge.record import Reason, Status
from fuzz.bundles import ARTIFACTS
from fuzz.mutate import Generator
from fuzz.trials import Tally

Image = NDArray[Any]

_CLIP = ARTIFACTS / "synthetic-room-clip"
_BUNDLES = tuple(
    ARTIFACTS / f"synthetic-room-{method}-int8" for method in ("cjp", "cqr", "csp", "mcqr", "scr")
)
# Height and width of the bundles' model input.
_MODEL_SIZE = (192, 256)
# Largest accepted fraction of flagged clean frames.
_FALSE_ALARMS = 0.01
# Sensor noise, in grey levels, that makes all frames different.
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


# Name -> function of (image, earlier images, generator) that returns a faulty image, or None.
_IMAGES: dict[str, Callable[[Image, Sequence[Image], Generator], Image | None]] = {
    "black": lambda image, _, __: np.zeros_like(image),
    "black with noise": lambda image, _, g: _noisy(np.zeros_like(image), g, g.uniform(1.0, 6.0)),
    "white": lambda image, _, __: np.full_like(image, 255),
    "blown out": lambda image, _, g: np.clip(image * g.uniform(6.0, 20.0), 0, 255).astype(np.uint8),
    "one colour": lambda image, _, g: _one_colour(image, g),
    "frozen": lambda _, before, __: before[-1],
    "frozen, another buffer": lambda _, before, __: before[-1].copy(),
    "an old buffer": lambda _, before, g: before[int(g.integers(len(before)))],
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
    """Process ``count`` faulty frames and about as many clean ones, in random order.

    Findings are faulty frames with a finite interval, and a share of flagged clean frames above
    one in a hundred.
    """
    tally = Tally()
    for number, bundle in enumerate(_BUNDLES):
        share = count // len(_BUNDLES) + (number < count % len(_BUNDLES))
        with Odometer.load(bundle) as odometer:
            for kind, estimate in _estimates(
                odometer, share, np.random.default_rng([2028, number])
            ):
                if kind is None:
                    good = estimate.status is Status.OK and estimate.bounded
                    tally.outcomes[f"clean, {'ok' if good else ', '.join(estimate.reasons)}"] += 1
                    continue
                finite = bool(np.isfinite([*estimate.lower, *estimate.upper]).any())
                tally.add(
                    f"{kind}, {estimate.status}",
                    f"{bundle.name}, frame {estimate.seq}, {kind}: a finite interval"
                    if finite
                    else None,
                )
        print(f"  {bundle.name}: {tally.trials} of {count}", flush=True)
    by_status = {
        status: sum(n for name, n in tally.outcomes.items() if name.endswith(f", {status}"))
        for status in (Status.DEGRADED, Status.INVALID)
    }
    tally.summary = ", ".join(f"{n} {status}" for status, n in by_status.items())
    _check_false_alarms(tally)
    return tally


def _check_false_alarms(tally: Tally) -> None:
    clean = {name: n for name, n in tally.outcomes.items() if name.startswith("clean, ")}
    count = sum(clean.values())
    wrong = count - clean.get("clean, ok", 0)
    said = f"{wrong} of {count} clean frames flagged"
    tally.summary = "; ".join(filter(None, (tally.summary, said)))
    if wrong > _FALSE_ALARMS * count:
        tally.findings.append(said)


def _estimates(
    odometer: Odometer, count: int, generator: Generator
) -> Iterator[tuple[str | None, PoseInterval]]:
    """Yield the kind of fault (None: clean) and the estimate of frames, until ``count`` faults."""
    images = [frame.image for frame in open_source(str(_CLIP)) if frame.image is not None]
    kinds: list[str | None] = []

    def frames() -> Iterator[Frame]:
        # As many buffers as a camera driver may have.
        before: deque[Image] = deque([images[0]], maxlen=8)
        now_ns, left = 0, count
        while left > 0:
            number = len(kinds)
            image = _noisy(images[(number // 4) % len(images)], generator)
            now_ns += _STEP_NS
            frame = Frame(image, now_ns, "", 0.0)
            kind = (
                _KINDS[int(generator.integers(len(_KINDS)))]
                if number > 0 and generator.random() < 0.5
                else None
            )
            if kind in _IMAGES:
                frame = replace(frame, image=_IMAGES[kind](image, before, generator))
            elif kind in _STAMPS:
                now_ns += _STAMPS[kind] - _STEP_NS
                frame = replace(frame, stamp_ns=now_ns)
            elif kind == "stale":
                frame = replace(frame, queued_ms=float(generator.uniform(1001.0, 1e5)))
            left -= kind is not None
            kinds.append(kind)
            if frame.image is not None and to_bgr8(frame.image) is not None:
                before.append(frame.image)
            yield frame

    for estimate in odometer.stream(frames()):
        yield kinds[estimate.seq], estimate


def recordings(count: int) -> Tally:
    """Check the first ``count`` images of each real recording in ``$CVO_DATA``, if it is set.

    All frames are clean, but a recording may contain the same file twice in a row; flagging the
    second is not a false alarm. The finding is a share of false alarms above one in a hundred.
    """
    tally = Tally()
    data = os.environ.get("CVO_DATA")
    if data is None:
        tally.outcomes["no CVO_DATA"] += 1
        return tally
    for folder in sorted({path.parent for path in Path(data).rglob("*.color.*")}):
        checks, before = StreamChecks(), b""
        for path in sorted(folder.glob("*.color.*"))[:count]:
            content = path.read_bytes()
            tally.add(_told_of(decode_image(content), content == before, checks))
            before = content
    twice = sum(n for name, n in tally.outcomes.items() if name.startswith("twice"))
    tally.summary = f"{twice} repeated frames of the recordings flagged"
    _check_false_alarms(tally)
    return tally


def _told_of(decoded: Image | None, twice: bool, checks: StreamChecks) -> str:
    image = None if decoded is None else to_bgr8(decoded)
    if image is None:
        return "clean, unreadable"
    look = Look(model_input(image, *_MODEL_SIZE, "none"), (image.shape[0], image.shape[1]))
    doubt = image_doubt(look)
    doubts = (*((doubt,) if doubt else ()), *checks.picture(look))
    if doubts == (Reason.FRAME_REPEATED,) and twice:
        return "twice in the recording, frame_repeated"
    return f"clean, {', '.join(doubts) or 'ok'}"
