"""Image files to records, in turns with the script that one would write; before and after.

    python bench/files.py [--against CHECKOUT] [--methods METHOD ...] [--rounds N]

Fifty files of 640x480 (ResNet34: twenty, in float32 ten) go through what ``cvo-edge run`` runs,
with its summary and records in a file, in mode ``latency`` and in mode ``throughput``, and through
a sequential script on onnxruntime with default settings (``script``). All run in fresh processes
that take turns, on two cores and on one; with another checkout, its processes take turns, too.
``bmp`` holds the same pixels without compression. CJP also runs with ``decode: half`` in its bundle
(``cjp, half``). The script writes the pose and what else is small, and solves for the pose of
``scr`` with OpenCV's ``solvePnP``. Ratios are medians within a turn.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import product
from pathlib import Path
from time import sleep
from typing import Any

import numpy as np
from networks import BACKBONES, DEMONSTRATED, PRECISIONS, WORK, frames_as, half_bundle, whole_bundle
from rounds import Array, figures, in_turn, ratio, write_report
from workers import Worker, commit_of

MODES = ("latency", "throughput")
SCRIPT = "script"
FORMATS = ("jpg", "bmp")
CORES = (2, 1)
WARM_UP, REST_S = 1, 1.0
# CJP stands for the goals; the others differ in what follows the network.
ROUNDS = {"cjp": 15}
OTHER_ROUNDS = 3
# A bundle of this checkout's newest format, which another one may not read.
HALF = "cjp, half"
FILES = 50
SLOW_FILES = {("resnet34", "int8"): 20, ("resnet34", "fp32"): 10}

METHODS = (*DEMONSTRATED, HALF)

# Bundle, folder, cores, file for records.
_OURS = """
from time import perf_counter, process_time
from cvo_edge.input.sources import open_source
from cvo_edge.odometer import Odometer
from cvo_edge.output.sinks import Sink
from cvo_edge.programs.run import RunSummary, run
bundle, folder, cores, target = sys.argv[1:]
odometers = {
    mode: Odometer.load(bundle, threads=int(cores), mode=mode) for mode in ("latency", "throughput")
}
try:
    from cvo_edge.scheduling import usual_mode
    usual = usual_mode(open_source(folder), adapts=False)
except ImportError:
    usual = "latency"
def answer(what):
    if what is None:
        return usual
    odometer = odometers[what]
    begin, cpu = perf_counter(), process_time()
    summary = RunSummary(odometer.chart.dof, 0.9, "marginal")
    with Sink(target, "jsonl") as sink:
        run(odometer, open_source(folder), sink.write, summary=summary)
    spent = perf_counter() - begin, process_time() - cpu
    return [1e3 * each / summary.frames for each in spent]
"""

_SCRIPT = """
from pathlib import Path
from time import perf_counter, process_time
import cv2, numpy, onnxruntime
bundle, folder, cores, target = sys.argv[1:]
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = int(cores)
content = Path(bundle, "model.onnx").read_bytes()
session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
small = [port.name for port in session.get_outputs() if numpy.prod(port.shape) <= 16]
solves = not any(port.name == "pose" for port in session.get_outputs())
height, width = session.get_inputs()[0].shape[1:3]
extra = {
    port.name: numpy.zeros(port.shape, numpy.float32)
    for port in session.get_inputs() if port.name != "image"
}
# The centres of the cells of stride 16.
rows, columns = height // 16, width // 16
cells = numpy.stack(numpy.meshgrid(numpy.arange(columns), numpy.arange(rows)), -1)
pixels = (16.0 * cells.reshape(-1, 2) + 7.5).astype(numpy.float32)
camera = numpy.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
def answer(what):
    begin, cpu = perf_counter(), process_time()
    paths = sorted(Path(folder).iterdir())
    with open(target, "w") as stream:
        for path in paths:
            image = cv2.resize(cv2.imread(str(path)), (width, height))
            image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)[numpy.newaxis]
            if solves:
                (points,) = session.run(["coordinates"], {"image": image, **extra})
                found = cv2.solvePnP(points[0], pixels, camera, None, flags=cv2.SOLVEPNP_SQPNP)
                values = found[1:]
            else:
                values = session.run(small, {"image": image, **extra})
            stream.write(json.dumps([value.tolist() for value in values]) + "\\n")
    spent = perf_counter() - begin, process_time() - cpu
    return [1e3 * each / len(paths) for each in spent]
"""


def calls(
    stack: ExitStack, bundle: Path, folder: Path, cores: int, other: Path | None
) -> Iterator[tuple[str, Worker, str]]:
    """Yield name, process and mode of each call; the script has no mode."""
    arguments = [bundle, folder, cores]
    text = [*arguments, WORK / "script.jsonl"]
    yield SCRIPT, stack.enter_context(Worker(_SCRIPT, text, cores)), SCRIPT
    arguments.append(WORK / "records.jsonl")
    checkouts = {"": None, "before, ": other} if other else {"": None}
    for name, checkout in checkouts.items():
        where = {} if checkout is None else {"checkout": checkout}
        worker = stack.enter_context(Worker(_OURS, arguments, cores, **where))
        for mode in MODES:
            yield f"{name}{mode}", worker, mode


def measured(
    bundle: Path, folder: Path, cores: int, rounds: int, other: Path | None
) -> dict[str, Any]:
    """Time one bundle on one folder: milliseconds a frame of every call, and over the script."""
    with ExitStack() as stack:
        several = list(calls(stack, bundle, folder, cores, other))
        usual = {
            f"{name.removesuffix(mode)}default": name.removesuffix(mode) + worker.turn()
            for name, worker, mode in several
            if mode == MODES[0]
        }
        turns: dict[str, list[list[float]]] = {name: [] for name, _, _ in several}
        for number in range(WARM_UP + rounds):
            for name, worker, mode in in_turn(several, number):
                turns[name].append(worker.turn(mode))
                if name == SCRIPT:
                    # Its threads go on spinning, which would slow down whoever comes next.
                    sleep(REST_S)
    spent: dict[str, Array] = {name: np.array(row[WARM_UP:]).T for name, row in turns.items()}
    spent |= {name: spent[of] for name, of in usual.items()}
    script = spent[SCRIPT]
    return {
        name: {
            "ms": figures(wall),
            "cpu_ms": figures(cpu),
            "over_script": ratio(wall, script[0]),
            "cpu_over_script": ratio(cpu, script[1]),
        }
        for name, (wall, cpu) in spent.items()
    }


def line(found: dict[str, Any]) -> str:
    """Return one bundle's figures as text."""
    ours = (
        f"{name} {row['over_script']['median']:.3f} x, processor "
        f"{row['cpu_over_script']['median']:.3f} x"
        for name, row in found.items()
        if name != SCRIPT
    )
    return f"script {found[SCRIPT]['ms']['median']:.2f} ms; {'; '.join(ours)}"


def main() -> None:
    """Time all bundles, or those of the methods that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, help="another checkout, to take turns with")
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--rounds", type=int, help="for a quick look, which writes no result")
    arguments = parser.parse_args()
    other = None if arguments.against is None else arguments.against.resolve()
    results: dict[str, Any] = {}
    for method, backbone, precision in product(arguments.methods, BACKBONES, PRECISIONS):
        rounds = arguments.rounds or ROUNDS.get(method, OTHER_ROUNDS)
        files = SLOW_FILES.get((backbone, precision), FILES)
        half = method == HALF
        bundle = (
            half_bundle(backbone, precision) if half else whole_bundle(method, backbone, precision)
        )
        for form, cores in product(("jpg",) if half else FORMATS, CORES):
            folder = frames_as(form, files)
            found = measured(bundle, folder, cores, rounds, None if half else other)
            row = results.setdefault(backbone, {}).setdefault(method, {}).setdefault(precision, {})
            row[f"{form}, {cores}"] = found
            print(
                f"{backbone:<16} {method:<5} {precision} {form}, cores {cores}: {line(found)}",
                flush=True,
            )
    if arguments.rounds is None and set(arguments.methods) == set(METHODS):
        before = {} if other is None else {"before": commit_of(other)}
        write_report("files", results, rounds=ROUNDS, other_rounds=OTHER_ROUNDS, **before)


if __name__ == "__main__":
    main()
