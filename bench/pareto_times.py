"""Times of the networks that ``bench/pareto.py`` made, and of other backbones.

    python bench/pareto_times.py WORK --json bench/results/pareto/pareto.json

Frames of 640x480 through each graph in interleaved rounds, on one thread and on two, in float32 and
in 8 bits: ``raw`` is onnxruntime alone, ``frame`` is preprocessing, network and, for scene
coordinates, the solver. Checks, set and record are the same for all and left out. A network that
WORK lacks is timed without its solver and has no score. ``BACKBONES`` are timed up to stride 16
with random weights. Writes these times with the scores in WORK.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from networks import open_branches
from numpy.typing import NDArray
from pareto import (
    BUDGETS,
    CANDIDATES,
    DATA,
    PRECISIONS,
    Candidate,
    Outputs,
    config_of,
    graphs,
    images_of,
    solver_of,
)
from provenance import write_result
from rounds import figures, interleaved

from cvo_edge.engine.session import Session
from cvo_edge.input import preprocess
from cvo_export.data.splits import make_split
from cvo_export.datasets import open_dataset
from cvo_export.graph.quantise import quantised
from cvo_export.graph.to_onnx import export_onnx
from cvo_export.networks.backbone import Backbone, BackboneConfig
from cvo_export.networks.heads import ExportedHead, Setting
from cvo_export.networks.heads.cjp import CjpHead, CjpNetwork
from cvo_export.networks.heads.scr import CellNetwork, ScrHead
from cvo_export.networks.standardised import fit_target
from cvo_export.training.features import ModelImages
from cvo_export.training.run import NETWORK_FILE, PoseGraph, Run, load_run, loaded_backbone

# Whose latency is measured beside, with random weights, up to stride 16.
BACKBONES = (
    "mobilenetv2_100",
    "mobilenetv2_050",
    "mobilenetv3_large_100",
    "mobilenetv4_conv_small",
    "repvit_m0_9",
    "resnet34",
)
SIZE = 256, 192
ROUNDS, WARM_UP, _PICTURES = 60, 5, 16

Solve = Callable[[Outputs], object]


def candidate_graphs(candidate: Candidate, work: Path) -> dict[str, bytes]:
    """Return the trained network of seed 0 in both precisions, or an untrained one of its form."""
    trained = {p: work / "graphs" / f"{candidate.name}-0-{p}.onnx" for p in PRECISIONS}
    if all(path.exists() for path in trained.values()):
        return {p: path.read_bytes() for p, path in trained.items()}
    return kept(candidate.name, work, lambda: untrained(candidate, work))


def kept(name: str, work: Path, make: Callable[[], dict[str, bytes]]) -> dict[str, bytes]:
    """Return graphs without training that were made before, or make them."""
    paths = {p: work / "untrained" / f"{name}-{p}.onnx" for p in PRECISIONS}
    if not all(path.exists() for path in paths.values()):
        paths["fp32"].parent.mkdir(parents=True, exist_ok=True)
        for precision, content in make().items():
            paths[precision].write_bytes(content)
        print(f"-> {name}", flush=True)
    return {p: path.read_bytes() for p, path in paths.items()}


def untrained(candidate: Candidate, work: Path) -> dict[str, bytes]:
    """Return an untrained network in both precisions."""
    config = config_of(candidate, 0, work)
    dataset = open_dataset(config.dataset)
    backbone, upper, _ = loaded_backbone(config, config.weights)
    head: ExportedHead
    if upper is not None:
        network = CellNetwork(upper.size, config.head, np.zeros(3), 1.0)
        head = ScrHead(upper, network, dataset.local_poses[:1], np.ones(6))
    else:
        target = fit_target(dataset.local_poses)
        setting = Setting(backbone.size, target, 0)
        head = CjpHead(CjpNetwork(backbone.size, config.head, target.size), setting)
    some = np.linspace(0, len(dataset) - 1, 16).astype(np.int64)
    images = ModelImages(dataset, some, config.height, config.width, config.crop)
    return graphs(PoseGraph(backbone, head), config, images)


def backbone_graphs(name: str) -> dict[str, bytes]:
    """Return a network up to stride 16 with random weights in both precisions."""
    torch.manual_seed(0)
    width, height = SIZE
    backbone = Backbone(BackboneConfig(name, normalisation="timm"), height, width)
    images = np.random.default_rng(0).integers(0, 256, (8, height, width, 3)).astype(np.uint8)
    open_branches(backbone)
    blank = torch.zeros((1, height, width, 3), dtype=torch.uint8)
    content = export_onnx(backbone, [blank], ["image"], ["features"])
    return {
        "fp32": content,
        "int8": quantised(content, [{"image": image[np.newaxis]} for image in images]),
    }


class Timed:
    """Frames of 640x480 through one graph: ``raw``, onnxruntime alone, and ``frame``.

    The latter is preprocessing, network and, for scene coordinates, the solver.
    """

    def __init__(self, content: bytes, threads: int, solve: Solve | None = None) -> None:
        self._session = Session(content, threads=threads)
        self._solve = solve
        self._pictures = pictures()
        _, self._height, self._width, _ = (
            value.dim_value
            for value in onnx.load_from_string(content).graph.input[0].type.tensor_type.shape.dim
        )
        self._kept = np.empty_like(self._pictures[0])

    def calls(self) -> dict[str, Callable[[int], object]]:
        """Return the calls by name."""
        return {"raw": self.raw, "frame": self.frame}

    def write(self, number: int) -> None:
        """Leave the next picture as a camera does; the untimed preparation of both."""
        np.copyto(self._kept, self._pictures[number % len(self._pictures)])
        self._input = self._prepared()

    def raw(self, _: int) -> object:
        """Run the bare call."""
        return self._session.run({"image": self._input})

    def frame(self, _: int) -> None:
        """From an array to the pose."""
        found = self._session.run({"image": self._prepared()})
        if self._solve is not None:
            self._solve(found)

    def _prepared(self) -> NDArray[np.uint8]:
        return preprocess.model_input(self._kept, self._height, self._width, "none")


@cache
def pictures() -> list[NDArray[np.uint8]]:
    """Return frames of a test flight, doubled to 640x480; halving them gives them back."""
    dataset = open_dataset(os.path.expandvars(DATA["flights"][0]))
    indices = make_split(dataset, "sequence", 0).roles["test"][:_PICTURES]
    images = [dataset.read_image(int(index)) for index in indices]
    return [image.repeat(2, axis=0).repeat(2, axis=1) for image in images]


def solve_of(run: Run) -> Solve:
    """Return the function from a network's outputs to the pose."""
    solver, focal_px = solver_of(run, images_of(run, run.split.roles["test"][:1]))

    def solve(found: Outputs) -> object:
        scale = np.exp(found["log_scale_px"][0].astype(float)) / focal_px
        return solver.solve(found["coordinates"][0].astype(float), scale)

    return solve


def measured(work: Path) -> dict[str, Any]:
    """Time all graphs in turns, on one thread and on two -> name -> threads -> call -> figures."""
    found: dict[str, Any] = {}
    contents: dict[str, tuple[bytes, Solve | None]] = {}
    for candidate in dict.fromkeys(map(timed_as, CANDIDATES)):
        run = work / "runs" / f"{candidate.name}-0"
        known = candidate.method == "scr" and (run / NETWORK_FILE).exists()
        solve = solve_of(load_run(run)) if known else None
        for precision, content in candidate_graphs(candidate, work).items():
            contents[f"{candidate.name} {precision}"] = content, solve
    for name in BACKBONES:
        for precision, content in kept(name, work, partial(backbone_graphs, name)).items():
            contents[f"{name} {precision}"] = content, None
    for threads in (1, 2):
        timed = {name: Timed(one, threads, solve) for name, (one, solve) in contents.items()}
        calls = {
            (name, what): call for name, one in timed.items() for what, call in one.calls().items()
        }
        before = {(name, what): timed[name].write for name, what in calls}
        ms = interleaved(calls, rounds=ROUNDS, warmup=WARM_UP, before=before)
        for (name, what), spent in ms.items():
            row = found.setdefault(name, {}).setdefault(str(threads), {})
            # The machine may be shared: the 10th percentile is what a call takes undisturbed.
            row[what] = {"p10": round(float(np.percentile(spent, 10)), 4), **figures(spent)}
    return found


def timed_as(candidate: Candidate) -> Candidate:
    """Return the network whose times are these: data do not change them."""
    return replace(candidate, data="flights")


def report(work: Path, times: dict[str, Any]) -> dict[str, Any]:
    """Return scores and times of all networks."""
    networks: dict[str, Any] = {}
    for candidate in CANDIDATES:
        cells = sorted((work / "cells").glob(f"{candidate.name}-?.json"))
        rows = [json.loads(path.read_text("utf-8")) for path in cells]
        networks[candidate.name] = {
            **asdict(candidate),
            "train_processor_s": [row["processor_s"] for row in rows],
            **{
                precision: {
                    "seeds": [row[precision] for row in rows],
                    "threads": times[f"{timed_as(candidate).name} {precision}"],
                }
                for precision in PRECISIONS
            },
        }
    backbones = {name: {p: times[f"{name} {p}"] for p in PRECISIONS} for name in BACKBONES}
    settings = {"rounds": ROUNDS, "warmup": WARM_UP, "budgets": BUDGETS}
    return {"settings": settings, "networks": networks, "backbones": backbones}


def main() -> None:
    """Time all, print scores and times, and write the result where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found = report(arguments.work, measured(arguments.work))
    for name, row in found["networks"].items():
        for precision in PRECISIONS:
            seeds = row[precision]["seeds"]
            # Networks that are not trained are timed alone.
            value = np.median([seed["normalised_interval_score"] for seed in seeds] or [np.nan])
            ms = [row[precision]["threads"][str(t)]["frame"]["p10"] for t in (1, 2)]
            print(f"{name:<22} {precision} score {value:.3f}, {ms[0]:.2f} and {ms[1]:.2f} ms")
    if arguments.json:
        write_result(arguments.json, found)


if __name__ == "__main__":
    main()
