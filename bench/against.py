"""Compare this checkout with another, turn by turn: array to interval over the bare model call.

    python bench/against.py OTHER_CHECKOUT [ROUNDS]

Each checkout runs in its own process; the processes alternate every few frames, so that a change of
the machine's speed affects both. A turn times the step from an image array to the interval and the
bare call of the session on the same input. The result goes to ``results/speed/against.json``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from networks import ARTIFACTS, METHODS
from provenance import RESULTS, ROOT, write_result

ROUNDS, FRAMES, WARM_UP = 60, 10, 3

# What a process does: one line of JSON out for each line in. It imports no more than both have.
_WORKER = """
import json, sys
from time import perf_counter
from cvo_edge import Odometer, open_source
bundle, clip, frames = sys.argv[1], sys.argv[2], int(sys.argv[3])
images = [frame.image for frame in open_source(clip)]
odometer = Odometer.load(bundle)
session, inputs = odometer.session, odometer.calibration.preprocess
from importlib import import_module
try:
    preprocess = import_module("cvo_edge.input.preprocess")
except ModuleNotFoundError:
    preprocess = import_module("cvo_edge.preprocess")
number = 0
for _ in sys.stdin:
    steps, calls = [], []
    for _ in range(frames):
        image = images[number % len(images)]
        number += 1
        tensor = preprocess.model_input(image, inputs.height, inputs.width, inputs.crop)
        feeds = {"image": tensor, **odometer.head.extra_inputs(number)}
        begin = perf_counter()
        odometer.step(image)
        middle = perf_counter()
        session.run(feeds)
        end = perf_counter()
        steps.append(middle - begin)
        calls.append(end - middle)
    print(json.dumps([steps, calls]), flush=True)
"""


class Checkout:
    """One checkout's process, which measures a turn when it is asked to."""

    def __init__(self, folder: Path, bundle: Path) -> None:
        arguments = [str(bundle), str(ARTIFACTS / "synthetic-room-clip"), str(FRAMES)]
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _WORKER, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(folder)},
        )
        self.ratios: list[float] = []
        self.around_ms: list[float] = []

    def turn(self, counts: bool) -> None:
        """Measure one turn; keep its medians where it counts."""
        stdin, stdout = self._process.stdin, self._process.stdout
        if stdin is None or stdout is None:
            raise RuntimeError("expected pipes to the process")
        stdin.write("\n")
        stdin.flush()
        steps, calls = json.loads(stdout.readline())
        if counts:
            self.ratios.append(float(np.median(steps) / np.median(calls)))
            self.around_ms.append(1e3 * float(np.median(steps) - np.median(calls)))

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def compared(other: Path, bundle: Path, rounds: int) -> dict[str, dict[str, float]]:
    """Return the medians of both checkouts on one bundle."""
    pair = {"this": Checkout(ROOT, bundle), "other": Checkout(other, bundle)}
    try:
        for number in range(WARM_UP + rounds):
            names = list(pair) if number % 2 else list(pair)[::-1]
            for name in names:
                pair[name].turn(counts=number >= WARM_UP)
    finally:
        for checkout in pair.values():
            checkout.close()
    return {
        name: {
            "ratio_to_raw": round(float(np.median(checkout.ratios)), 4),
            "around_the_network_ms": round(float(np.median(checkout.around_ms)), 4),
        }
        for name, checkout in pair.items()
    }


def main() -> None:
    """Compare on the float32 demonstration bundle of each method."""
    other = Path(sys.argv[1]).resolve()
    rounds = int(sys.argv[2]) if len(sys.argv) > 2 else ROUNDS
    commit = subprocess.run(
        ["git", "rev-parse", "--short=12", "HEAD"],
        cwd=other,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    results: dict[str, Any] = {}
    for method in METHODS:
        results[method] = compared(other, ARTIFACTS / f"synthetic-room-{method}", rounds)
        print(method, results[method], flush=True)
    write_result(
        RESULTS / "speed" / "against.json",
        {
            # The other checkout's folder says nothing; its commit does.
            "command": f"python bench/against.py OTHER_CHECKOUT {rounds}",
            "other_commit": commit,
            "rounds": rounds,
            "frames_a_turn": FRAMES,
            "results": results,
        },
    )


if __name__ == "__main__":
    main()
