"""Compare this checkout with another, turn by turn: from an array to the interval.

    python bench/against.py CHECKOUT [--methods METHOD ...] [--rounds N]

Every method on a whole MobileNetV2 and ResNet34, in float32 and 8 bits. Each checkout runs in
processes of its own, on two cores and on one, which take turns of a few frames. A turn times the
step from an image array of 640x480 to the interval and, in turns with it, the bare call of the
session on the same input. ``bench/files.py --against`` compares files to records.
"""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from networks import BACKBONES, DEMONSTRATED, PRECISIONS, frames, whole_bundle
from provenance import ROOT
from rounds import figures, in_turn, write_report
from workers import Worker, commit_of

CORES = (2, 1)
WARM_UP, FRAMES = 2, 8
ROUNDS = 25
SLOW_ROUNDS = 15

# Bundle, folder, cores, frames a turn.
_STEPS = """
from time import perf_counter
from pathlib import Path
import cv2, numpy
from cvo_edge.input import preprocess
from cvo_edge.odometer import Odometer
bundle, folder, cores, frames = sys.argv[1:]
paths = sorted(map(str, Path(folder).iterdir()))
odometer = Odometer.load(bundle, threads=int(cores))
session, inputs = odometer.session, odometer.calibration.preprocess
number = 0
def answer(what):
    global number
    steps, calls = [], []
    for _ in range(int(frames)):
        # Just decoded, as the caches then are; the checks have forgotten a picture that returns.
        image = cv2.imread(paths[number % len(paths)])
        number += 1
        begin = perf_counter()
        odometer.step(image)
        steps.append(perf_counter() - begin)
        tensor = preprocess.model_input(image, inputs.height, inputs.width, inputs.crop)
        feeds = {"image": tensor, **odometer.head.extra_inputs(number)}
        begin = perf_counter()
        session.run(feeds)
        calls.append(perf_counter() - begin)
    return [1e3 * float(numpy.median(each)) for each in (steps, calls)]
"""


def measured(bundle: Path, rounds: int, other: Path) -> dict[str, Any]:
    """Time one bundle on both checkouts -> figures by cores and checkout."""
    folder = frames()[0].parent
    checkouts = {"now": ROOT, "before": other}
    with ExitStack() as stack:
        workers = {
            (cores, name): stack.enter_context(
                Worker(_STEPS, [bundle, folder, cores, FRAMES], cores, checkout)
            )
            for cores, (name, checkout) in product(CORES, checkouts.items())
        }
        turns: dict[tuple[int, str], list[list[float]]] = {key: [] for key in workers}
        for number in range(WARM_UP + rounds):
            for key in in_turn(list(workers), number):
                turns[key].append(workers[key].turn())
    spent = {key: np.array(rows[WARM_UP:]).T for key, rows in turns.items()}
    found: dict[str, Any] = {}
    for cores in CORES:
        row = found[str(cores)] = {
            name: {
                "ms": {"step": figures(step), "raw": figures(raw)},
                "step_over_raw": figures(step / raw),
                "step_minus_raw_ms": figures(step - raw),
            }
            for name in checkouts
            for step, raw in [spent[cores, name]]
        }
        now, before = spent[cores, "now"], spent[cores, "before"]
        row["step_now_over_before"] = figures(now[0] / before[0])
        row["around_now_over_before"] = figures((now[0] - now[1]) / (before[0] - before[1]))
    return found


def line(found: dict[str, Any]) -> str:
    """Return one bundle's figures as text."""
    parts = []
    for cores, row in found.items():
        around = " -> ".join(
            f"{row[name]['step_minus_raw_ms']['median']:.3f} "
            f"(p10 {row[name]['step_minus_raw_ms']['p10']:.3f})"
            for name in ("before", "now")
        )
        over = row["step_now_over_before"]["median"]
        parts.append(f"{cores} cores: less the raw call {around} ms, step {over:.3f} x")
    return "; ".join(parts)


def main() -> None:
    """Compare on all bundles, or on those of the methods that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkout", type=Path)
    parser.add_argument("--methods", nargs="+", default=DEMONSTRATED, choices=DEMONSTRATED)
    parser.add_argument("--rounds", type=int, help="for a quick look, which writes no result")
    arguments = parser.parse_args()
    other = arguments.checkout.resolve()
    results: dict[str, Any] = {}
    for method, backbone, precision in product(arguments.methods, BACKBONES, PRECISIONS):
        slow = (backbone, precision) == ("resnet34", "fp32")
        rounds = arguments.rounds or (SLOW_ROUNDS if slow else ROUNDS)
        found = measured(whole_bundle(method, backbone, precision), rounds, other)
        results.setdefault(backbone, {}).setdefault(method, {})[precision] = found
        print(f"{backbone:<16} {method:<5} {precision} {line(found)}", flush=True)
    if arguments.rounds is None and set(arguments.methods) == set(DEMONSTRATED):
        settings = {"rounds": ROUNDS, "slow_rounds": SLOW_ROUNDS, "frames_a_turn": FRAMES}
        write_report("against", results, before=commit_of(other), **settings)


if __name__ == "__main__":
    main()
