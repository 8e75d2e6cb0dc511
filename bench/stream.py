"""A steady camera: processor time; and steps beside a busy process.

    python bench/stream.py

Camera: 30 frames per second; processor time per frame of onnxruntime with default settings (the
model alone, on a prepared input) and of mode ``live``. ``bench/files.py`` measures files.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from itertools import cycle
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
import onnxruntime
from networks import BACKBONES, images, whole_bundle
from rounds import figures, in_turn, interleaved, ratio, write_report

from cvo_edge.engine.loading import read_bundle
from cvo_edge.input.frame import Frame
from cvo_edge.odometer import Odometer

METHOD, THREADS = "cjp", 2
FPS, SECONDS, CAMERA_ROUNDS = 30, 3, 5
STEPS = 200
BUSY = "while True: pass"


def default_session(bundle: Path, threads: int) -> onnxruntime.InferenceSession:
    """Return a session of onnxruntime with default settings but for the number of threads."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    return onnxruntime.InferenceSession(
        (bundle / "model.onnx").read_bytes(), options, providers=["CPUExecutionProvider"]
    )


class Recording:
    """A source that repeats pictures with the stamps of a steady camera."""

    live = False
    length = FPS * SECONDS

    def __init__(self, pictures: list[np.ndarray]) -> None:
        self._pictures = pictures

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames."""
        for number, image in zip(range(self.length), cycle(self._pictures), strict=False):
            yield Frame(image, round(1e9 * number / FPS), "", 0.0)

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield calls that return frames."""
        for frame in self:
            yield lambda frame=frame: frame


def camera(backbone: str) -> dict[str, Any]:
    """Processor time per frame at 30 frames per second, in turns of some seconds; ages in ms."""
    count = FPS * SECONDS
    pictures = images()
    feeds = {"image": np.zeros((1, 224, 224, 3), np.uint8)}

    def paced(engine: onnxruntime.InferenceSession) -> Callable[[], list[float]]:
        def run() -> list[float]:
            begin = perf_counter()
            for number in range(count):
                time.sleep(max(0.0, begin + number / FPS - perf_counter()))
                engine.run(None, feeds)
            return []

        return run

    def live(odometer: Odometer) -> Callable[[], list[float]]:
        return lambda: [e.latency_ms["total"] for e in odometer.stream(Recording(pictures))]

    with ExitStack() as stack:
        calls: dict[str, Callable[[], list[float]]] = {}
        calls["onnxruntime"] = paced(default_session(whole_bundle(METHOD, backbone), THREADS))
        for precision, threads in (("fp32", THREADS), ("int8", THREADS), ("int8", 1)):
            bundle = read_bundle(whole_bundle(METHOD, backbone, precision))
            odometer = Odometer(bundle, threads=threads, mode="live")
            calls[f"live {precision}, {threads}"] = live(stack.enter_context(odometer))
        cpu_ms: dict[str, list[float]] = {name: [] for name in calls}
        ages_ms: dict[str, list[float]] = {name: [] for name in calls}
        skipped = dict.fromkeys(calls, 0)
        for number in range(CAMERA_ROUNDS):
            for name, call in in_turn(list(calls.items()), number):
                # Wait until the threads of the previous call have stopped spinning.
                time.sleep(1.0)
                begin = process_time()
                found = call()
                # A dropped frame costs nothing and must not count.
                cpu_ms[name].append(1e3 * (process_time() - begin) / (len(found) or count))
                ages_ms[name] += found
                skipped[name] += len(found) and count - len(found)
    others = np.array(cpu_ms["onnxruntime"])
    return {
        name: {
            "cpu_ms_per_frame": figures(np.array(cpu_ms[name])),
            "over_onnxruntime": ratio(np.array(cpu_ms[name]), others),
            "age_ms": figures(np.array(ages_ms[name])) if ages_ms[name] else None,
            "frames": CAMERA_ROUNDS * count,
            "frames_skipped": skipped[name],
        }
        for name in calls
    }


def neighbour(backbone: str) -> dict[str, Any]:
    """Milliseconds of a step alone, and beside one process that keeps a core busy."""
    found: dict[str, Any] = {}
    content = read_bundle(whole_bundle(METHOD, backbone))
    pictures = images()
    for name in ("alone", "beside one"):
        with ExitStack() as stack:
            if name != "alone":
                busy = stack.enter_context(subprocess.Popen([sys.executable, "-c", BUSY]))
                stack.callback(busy.kill)
            calls: dict[str, Callable[[int], object]] = {}
            for mode in ("latency", "live"):
                for threads in (THREADS, 1):
                    odometer = Odometer(content, threads=threads, mode=mode)
                    stack.enter_context(odometer)
                    calls[f"{mode}, {threads}"] = partial(_step, odometer, pictures)
            spent = interleaved(calls, rounds=STEPS, warmup=20)
        found[name] = {call: figures(values) for call, values in spent.items()}
    return found


def _step(odometer: Odometer, pictures: list[np.ndarray], number: int) -> None:
    odometer.step(pictures[number % len(pictures)])


def main() -> None:
    """Measure all for both backbones."""
    results: dict[str, Any] = {}
    for backbone in BACKBONES:
        results[backbone] = {
            "camera": camera(backbone),
            "neighbour": neighbour(backbone),
        }
        for name, row in results[backbone]["camera"].items():
            print(
                f"{backbone:<16} {name:<17} {row['cpu_ms_per_frame']['median']:7.2f} CPU-ms per "
                f"frame at {FPS}, {row['over_onnxruntime']['median']:.3f} of onnxruntime's",
                flush=True,
            )
        for name, rows in results[backbone]["neighbour"].items():
            line = ", ".join(f"{call}: {row['median']:.2f}" for call, row in rows.items())
            print(f"{backbone:<16} {name:<17} ms per step, mode and threads: {line}", flush=True)
    write_report(
        "stream",
        results,
        threads=THREADS,
        rounds=CAMERA_ROUNDS,
        steps=STEPS,
        fps=FPS,
        method=METHOD,
    )


if __name__ == "__main__":
    main()
