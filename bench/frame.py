"""One frame: the cost of a bundle beside its network, of uncertainty, and the gain of 8 bits.

    python bench/frame.py

For every method: whole MobileNetV2 and ResNet34 at 224x224 and the demonstration network, in
float32 and 8 bits, on frames of 640x480; CJP also at 240x240, which halving alone produces. Four
calls are compared in pairs that take turns: onnxruntime on a prepared input (``raw``), array to
interval (``step``), JPEG file to JSON record in a file (``record``), and array to pose with the
outputs for intervals and for the alarm removed from the network (``pose_alone``; SCR solves for the
pose, and no more). ``step`` runs all checks and the alarm.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from networks import (
    BACKBONES,
    DEMONSTRATED,
    HALVED,
    PRECISIONS,
    WORK,
    demonstration,
    frames,
    images,
    pose_alone,
    whole_bundle,
)
from rounds import Array, figures, interleaved, ratio, write_report

from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.engine.session import Session
from cvo_edge.heads.scr import ScrHead
from cvo_edge.input import preprocess
from cvo_edge.input.decoding import decode_image
from cvo_edge.input.view import SeenCamera, crop_view, seen_camera
from cvo_edge.odometer import Odometer
from cvo_edge.output.sinks import Sink
from cvo_edge.pose_solver import PoseSolver
from cvo_edge.vocabulary import Scope

THREADS, ROUNDS, WARM_UP, BLOCKS = 2, 90, 15, 3
PAIRS = (("record", "raw"), ("step", "pose_alone"), ("step", "raw"))


def seen_by(bundle: Bundle) -> SeenCamera:
    """Return the camera of a bundle of SCR as its solver sees it."""
    camera, inputs = bundle.calibration.camera, bundle.calibration.preprocess
    if camera is None:
        raise SystemExit("expected a bundle with a camera, found one without")
    shape = inputs.height, inputs.width, inputs.crop
    own = crop_view(camera.height, camera.width, *shape).camera(camera)
    return seen_camera(camera, own, inputs.crop)


def solve_alone(bundle: Bundle) -> Callable[[dict[str, np.ndarray]], object]:
    """Return what finds the pose alone in the outputs of ``pose_alone``'s network."""
    head = bundle.head
    if not isinstance(head, ScrHead):
        return lambda _: None
    seen, parameters = seen_by(bundle), head.parameters
    solver = PoseSolver(
        seen.rays(parameters.grid), np.array(parameters.starts), np.array(parameters.damping)
    )
    focal_px = seen.camera.focal_px

    def solve(outputs: dict[str, np.ndarray]) -> object:
        scales = np.exp(outputs["log_scale_px"][0].astype(float)) / focal_px
        return solver.solve(outputs["coordinates"][0], scales)

    return solve


class Timed:
    """The calls on one bundle; ``conformal_ms`` is the time after the network in each ``step``.

    Each call gets an array that has just been written, as a camera or a decoder leaves it, and
    always another picture: a repeated one would look like a frozen camera.
    """

    def __init__(self, bundle: Bundle, sink: Sink, scope: Scope = "marginal") -> None:
        self.conformal_ms: list[float] = []
        self.bounded: list[bool] = []
        self._spec = bundle.calibration.preprocess
        self._odometer = Odometer(bundle, threads=THREADS, scope=scope)
        self._alone = Session(pose_alone(bundle.model_bytes), THREADS)
        self._solve = solve_alone(bundle)
        self._sink = sink
        self._pictures, self._files = cycle(images()), cycle(frames())
        self._image = next(self._pictures).copy()
        self._feeds = dict(self._odometer.head.extra_inputs(0))

    def calls(self) -> dict[str, Callable[[int], object]]:
        """Return the calls by name."""
        return {
            "raw": self.raw,
            "step": self.step,
            "record": self.record,
            "pose_alone": self.pose_alone,
        }

    def before(self) -> dict[str, Callable[[int], object]]:
        """Return the untimed preparation of each call."""
        return {
            "raw": self.write_input,
            "step": self.write_image,
            "record": lambda _: None,
            "pose_alone": self.write_image,
        }

    def write_image(self, _: int) -> None:
        """Write the next picture."""
        np.copyto(self._image, next(self._pictures))

    def write_input(self, number: int) -> None:
        """Write the network's input for the next picture."""
        self.write_image(number)
        self._feeds["image"] = self._input()

    def raw(self, _: int) -> None:
        """Run the bare call on the threads of the odometer's session."""
        if self._odometer.session:
            self._odometer.session.run(self._feeds)

    def step(self, _: int) -> None:
        """Time one step, from image array to interval."""
        estimate = self._odometer.step(self._image)
        self.conformal_ms.append(estimate.latency_ms["conformal"])
        # Networks that know little doubt some frames, which take as long but for the set.
        self.bounded.append(estimate.bounded)

    def record(self, _: int) -> None:
        """From a JPEG file to a line in a file."""
        path = next(self._files)
        image = decode_image(path.read_bytes())
        self._sink.write(self._odometer.step(image, source=path.name))

    def pose_alone(self, _: int) -> None:
        """From an array to the pose, without the outputs for intervals."""
        self._solve(self._alone.run({"image": self._input()}))

    def _input(self) -> preprocess.Image:
        bgr = preprocess.to_bgr8(self._image)
        if bgr is None:
            raise SystemExit("expected images, found none")
        return preprocess.model_input(bgr, self._spec.height, self._spec.width, self._spec.crop)


def measured(folder: Path, rounds: int, scope: Scope = "marginal") -> dict[str, Any]:
    """Time one bundle: the two calls of each pair take turns.

    Each block opens new sessions, because the placement of a session's memory and threads shifts
    all of its times.
    """
    found: dict[tuple[str, str], list[tuple[Array, Array]]] = {pair: [] for pair in PAIRS}
    conformal_ms: list[float] = []
    bounded: list[bool] = []
    with Sink(str(WORK / "records.jsonl"), "jsonl") as sink:
        for _ in range(BLOCKS):
            timed = Timed(read_bundle(folder), sink, scope)
            calls, before = timed.calls(), timed.before()
            for first, second in PAIRS:
                timed.conformal_ms.clear()
                two = {name: calls[name] for name in (first, second)}
                ms = interleaved(two, rounds=rounds // BLOCKS, warmup=WARM_UP, before=before)
                found[first, second].append((ms[first], ms[second]))
            bounded += timed.bounded
            conformal_ms += timed.conformal_ms[WARM_UP:]
    (record, raw_beside_record), (step_beside_alone, alone), (step, raw) = (
        np.concatenate(blocks, axis=1) for blocks in found.values()
    )
    more_ms = step_beside_alone - alone
    return {
        "ms": {
            "raw": figures(raw),
            "step": figures(step),
            "record": figures(record),
            "pose_alone": figures(alone),
        },
        "step_over_raw": ratio(step, raw),
        "step_minus_raw_ms": figures(step - raw),
        "record_over_raw": ratio(record, raw_beside_record),
        "uncertainty_ms": figures(more_ms),
        "cost_of_uncertainty": figures(more_ms / alone),
        "after_network_ms": figures(np.array(conformal_ms)),
        "bounded": float(np.mean(bounded)),
    }


def precisions(folders: dict[str, Path], rounds: int) -> dict[str, Any]:
    """Return float32 over 8 bits for the bare calls, which take turns."""
    with Sink(str(WORK / "records.jsonl"), "jsonl") as sink:
        timed = {name: Timed(read_bundle(folder), sink) for name, folder in folders.items()}
        ms = interleaved(
            {name: one.raw for name, one in timed.items()},
            rounds=rounds,
            warmup=WARM_UP,
            before={name: one.write_input for name, one in timed.items()},
        )
    return ratio(ms["fp32"], ms["int8"])


def line(row: dict[str, Any]) -> str:
    """Return one bundle's figures as text."""
    return (
        f"raw {row['ms']['raw']['median']:7.3f} ms, step / raw "
        f"{row['step_over_raw']['median']:.3f} (+{row['step_minus_raw_ms']['median']:.3f} ms), "
        f"record / raw {row['record_over_raw']['median']:.3f}, uncertainty "
        f"{row['cost_of_uncertainty']['median']:.3f}, after the network "
        f"{row['after_network_ms']['median']:.3f} ms, {row['bounded']:.0%} with intervals"
    )


def main() -> None:
    """Time all bundles, or those of the methods that are named."""
    methods = sys.argv[1:] or DEMONSTRATED
    if not set(methods) <= set(DEMONSTRATED):
        raise SystemExit(f"expected some of {', '.join(DEMONSTRATED)}, found {', '.join(methods)}")
    results: dict[str, Any] = {}
    for backbone in (*BACKBONES, "demonstration"):
        results[backbone] = {}
        for method in methods:
            folders = {
                precision: demonstration(method, precision)
                if backbone == "demonstration"
                else whole_bundle(method, backbone, precision)
                for precision in PRECISIONS
            }
            found: dict[str, Any] = {}
            for precision, folder in folders.items():
                found[precision] = measured(folder, ROUNDS)
                print(
                    f"{backbone:<16} {method:<5} {precision} {line(found[precision])}", flush=True
                )
            found["fp32_over_int8"] = precisions(folders, ROUNDS)
            print(f"{'':<22} fp32 / int8 {found['fp32_over_int8']['median']:.2f}", flush=True)
            results[backbone][method] = found
    results["halved"] = {}
    for backbone in BACKBONES:
        found = measured(whole_bundle("cjp", backbone, size=HALVED), ROUNDS)
        results["halved"][backbone] = found
        print(f"{backbone:<16} {HALVED} {line(found)}", flush=True)
    if set(methods) == set(DEMONSTRATED):
        write_report(
            "frame", results, threads=THREADS, rounds=ROUNDS, warmup=WARM_UP, blocks=BLOCKS
        )


if __name__ == "__main__":
    main()
