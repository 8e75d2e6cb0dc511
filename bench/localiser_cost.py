"""What scene coordinates cost: a frame, the solver, memory and file, beside CJP in float32.

    python bench/localiser_cost.py [--json FILE]

Demonstration bundles of CJP and SCR, in float32 and 8 bits, on frames of 640x480. A frame is the
time from an image array to its interval; all four bundles take turns, on one thread and on two.
The solver is what the runtime does between the network's outputs and the pose, with covariance,
self-check and evidence for the camera check; ``solve`` is the pose and its information alone. Its
calls of functions in Python and in C are free of the machine's noise. Peak memory is that of a
process that loads the bundle and steps through fifty frames.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from frame import seen_by, solve_alone
from networks import PRECISIONS, demonstration, frames, images
from provenance import write_result
from rounds import figures, interleaved, ratio

from cvo_edge.engine.loading import read_bundle
from cvo_edge.odometer import Odometer

BUNDLES = {
    f"{method} {precision}": demonstration(method, precision)
    for method in ("cjp", "scr")
    for precision in PRECISIONS
}
REFERENCE = "cjp fp32"
ROUNDS, WARM_UP, CALLS = 300, 20, 500
_STEP = """
import sys
import cv2
from cvo_edge import Odometer
from cvo_edge.programs.measure import memory_mib

with Odometer.load(sys.argv[1], threads=2) as odometer:
    for path in sys.argv[2:]:
        odometer.step(cv2.imread(path))
    print(memory_mib()["peak_rss"])
"""


def frame_ms(threads: int) -> dict[str, dict[str, Any]]:
    """Time frames of all bundles in turn."""
    pictures = images()
    odometers = {
        name: Odometer(read_bundle(path), threads=threads) for name, path in BUNDLES.items()
    }
    kept = np.empty_like(pictures[0])
    ms = interleaved(
        {name: lambda _, one=one: one.step(kept) for name, one in odometers.items()},
        rounds=ROUNDS,
        warmup=WARM_UP,
        before={
            name: lambda number: np.copyto(kept, pictures[number % len(pictures)])
            for name in odometers
        },
    )
    return {
        name: {"ms": figures(spent), "over_reference": ratio(spent, ms[REFERENCE])}
        for name, spent in ms.items()
    }


def solver_figures() -> tuple[dict[str, float], dict[str, int]]:
    """Time the solver on outputs of the network, and count its calls for one frame."""
    bundle = read_bundle(BUNDLES["scr fp32"])
    head, seen, alone = bundle.head, seen_by(bundle), solve_alone(bundle)
    whole = head.solver(seen)
    if whole is None:
        raise SystemExit("expected a bundle of scr, found another one")
    with Odometer(bundle, threads=1) as odometer:
        outputs = [dict(odometer.observe(picture, 0).outputs) for picture in images()]
    spent: dict[str, list[float]] = {"solve": [], "solver": []}
    for number in range(CALLS):
        each = number % len(outputs)
        begin = perf_counter()
        alone(outputs[each])
        middle = perf_counter()
        whole(outputs[each])
        spent["solve"].append(1e3 * (middle - begin))
        spent["solver"].append(1e3 * (perf_counter() - middle))
    ms = {name: float(np.median(values)) for name, values in spent.items()}
    return ms, counted_calls(lambda: whole(outputs[0]))


def counted_calls(run: Callable[[], object]) -> dict[str, int]:
    """Return how many functions in Python and in C a call enters; numpy's ufuncs do not count."""
    counts = {"call": 0, "c_call": 0}

    def count(_frame: object, event: str, _argument: object) -> None:
        if event in counts:
            counts[event] += 1

    sys.setprofile(count)
    try:
        run()
    finally:
        sys.setprofile(None)
    return {"python": counts["call"], "c": counts["c_call"]}


def peak_mib(bundle: Path) -> float:
    """Peak memory of a process that steps through all frames."""
    command = [sys.executable, "-c", _STEP, str(bundle), *map(str, frames())]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def main() -> None:
    """Print the figures; write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    times = {threads: frame_ms(threads) for threads in (1, 2)}
    ms, calls = solver_figures()
    report: dict[str, Any] = {"solver_ms": ms, "solver_calls": calls, "bundles": {}}
    for name, path in BUNDLES.items():
        model = read_bundle(path).calibration.model.file
        found = {
            "frame": {str(threads): times[threads][name] for threads in times},
            "peak_mib": peak_mib(path),
            "model_bytes": (path / model).stat().st_size,
        }
        report["bundles"][name] = found
        per_thread = ", ".join(
            f"{threads} threads {found['frame'][str(threads)]['ms']['median']:.2f} ms "
            f"({found['frame'][str(threads)]['over_reference']['median']:.3f} x)"
            for threads in times
        )
        print(
            f"{name:<9} {per_thread}, peak {found['peak_mib']:.0f} MiB, file "
            f"{found['model_bytes'] / 1e6:.2f} MB"
        )
    print(
        f"solver    {ms['solve']:.2f} ms, with covariance, self-check and camera "
        f"{ms['solver']:.2f} ms, {calls['python']} calls in Python and {calls['c']} in C"
    )
    if arguments.json:
        write_result(arguments.json, report)


if __name__ == "__main__":
    main()
