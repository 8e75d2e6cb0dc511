"""Microseconds of each stage of a step.

    python bench/stages.py

The demonstration network on two threads, frames of 640x480 that have just been written; medians.
Then each OpenCV call of the preprocessing in a separate loop.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from time import perf_counter

import cv2
import numpy as np
from networks import DEMONSTRATED, demonstration, frames, images

from cvo_edge.input import preprocess
from cvo_edge.input.decoding import decode_image
from cvo_edge.odometer import Odometer

THREADS, ROUNDS, WARM_UP = 2, 300, 50


def stages(method: str) -> dict[str, float]:
    """Median microseconds by stage; ``rest`` is checks and record."""
    rows: list[list[float]] = []
    kept = np.empty_like(images()[0])
    with Odometer.load(demonstration(method), threads=THREADS) as odometer:
        for picture in (images() * (1 + ROUNDS // 50))[:ROUNDS]:
            np.copyto(kept, picture)
            begin = perf_counter()
            estimate = odometer.step(kept)
            spent = 1e3 * (perf_counter() - begin)
            row = [estimate.latency_ms[name] for name in ("preprocess", "model", "conformal")]
            rows.append([*row, spent - sum(row)])
    found = 1e3 * np.median(rows[WARM_UP:], axis=0)
    return dict(zip(("preprocess", "model", "set", "rest"), found.tolist(), strict=True))


def median_us(call: Callable[[], object]) -> float:
    """Median microseconds of a call in a loop."""
    spent = []
    for _ in range(ROUNDS):
        begin = perf_counter()
        call()
        spent.append(perf_counter() - begin)
    return float(1e6 * np.median(spent[WARM_UP:]))


def main() -> None:
    """Print both."""
    for method in DEMONSTRATED:
        row = stages(method)
        print(method, ", ".join(f"{name} {us:.0f} us" for name, us in row.items()), flush=True)
    picture, content = images()[0], frames()[0].read_bytes()
    half = cv2.resize(picture, (320, 240), interpolation=cv2.INTER_AREA)
    four = cv2.cvtColor(half, cv2.COLOR_BGR2RGBA)
    calls = {
        "halve": partial(cv2.resize, picture, (320, 240), interpolation=cv2.INTER_AREA),
        "to four channels": partial(cv2.cvtColor, half, cv2.COLOR_BGR2RGBA),
        "linear, exact": partial(
            cv2.resize, four, (256, 192), interpolation=cv2.INTER_LINEAR_EXACT
        ),
        "linear, default": partial(cv2.resize, half, (256, 192), interpolation=cv2.INTER_LINEAR),
        "all of it": partial(preprocess.model_input, picture, 192, 256, "none"),
        "decode JPEG": partial(decode_image, content),
    }
    for name, call in calls.items():
        print(f"{name}: {median_us(call):.0f} us", flush=True)


if __name__ == "__main__":
    main()
