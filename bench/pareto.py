"""The network itself: score on new recordings against milliseconds, for networks of every size.

    python bench/pareto.py WORK [--only WORD ...] [--seeds N]
    python bench/pareto_times.py WORK --json bench/results/pareto/pareto.json

This program makes each network of ``CANDIDATES`` that WORK lacks, exports it in float32 and in
8 bits, and scores both graphs on the test frames: the interval score at 0.9 in deviations of the
training poses, with thresholds of the cal frames of the same graph, as ``cvo-export evaluate`` has
it, but without the alarm and the choices of ``publish``. SCR is published and evaluated, because
the self-check decides which frames have an interval. Networks of one method had the same budget, a
small part of the default one: scores can be compared within a method only.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from precision import figures
from pruned import pruned_weights

from cvo_edge.camera import cell_centres
from cvo_edge.conformal import conformal_quantile, interval_score
from cvo_edge.engine.session import Session
from cvo_edge.heads.scr import ScrParameters
from cvo_edge.pose_solver import PoseSolver
from cvo_edge.vocabulary import Precision, SplitKind
from cvo_export.data.splits import make_split
from cvo_export.datasets import open_dataset
from cvo_export.graph.quantise import quantised
from cvo_export.graph.to_onnx import export_onnx
from cvo_export.networks.backbone import Backbone, load_weights
from cvo_export.progress import show_progress
from cvo_export.publish import publish
from cvo_export.training.configure import configure
from cvo_export.training.features import FeatureExtractor, ModelImages, cached_copies
from cvo_export.training.loop import MAP_FILE, train
from cvo_export.training.material import shared_folder
from cvo_export.training.run import PoseGraph, Run, TrainConfig, load_run

Array = NDArray[np.float64]

# Recordings and their split: new flights, and frames between known ones.
DATA: dict[str, tuple[str, SplitKind]] = {
    "flights": ("7scenes:$CVO_DATA/kitchen_flights", "sequence"),
    "walk": ("7scenes:$CVO_DATA/redkitchen", "random"),
}
PRETRAINED = "$CVO_WEIGHTS/mobilenetv2_100_imagenet.safetensors"
PRECISIONS: tuple[Precision, ...] = ("fp32", "int8")
# Those whose features are computed in one pass.
STAGES = ("8", "16")
# The equal budget of a method's networks. SCR's stages after the stem stay as they were pretrained.
BUDGETS: dict[str, dict[str, Any]] = {
    "cjp": {"copies": 4, "steps": 1200},
    "scr": {"copies": 7, "steps": 1, "head": {"cell_steps": 800}},
}
_RANGE_FRAMES = 64
Outputs = Mapping[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Candidate:
    """One network.

    ``kept`` is the percentage of the expansion channels that pruning leaves.
    """

    method: str
    size: str
    stages: str = "16"
    kept: int = 100
    data: str = "flights"

    @property
    def name(self) -> str:
        """File name."""
        pruned = "" if self.kept == 100 else f"-kept{self.kept}"
        data = "" if self.data == "flights" else f"-{self.data}"
        return f"{self.method}-{self.size}-{self.stages}{pruned}{data}"

    @property
    def backbone(self) -> str:
        """Name of the network in timm."""
        return "mobilenetv2_100" if self.kept == 100 else f"mobilenetv2_kept_{self.kept}"


CANDIDATES = (
    *(Candidate("scr", size) for size in ("256x192", "192x144", "320x240", "128x96")),
    *(
        Candidate("cjp", size, stage)
        for size, stage in product(("256x192", "192x144", "160x120", "320x240"), ("16", "8"))
    ),
    *(Candidate("cjp", "256x192", kept=kept) for kept in (75, 50)),
    Candidate("cjp", "256x192", "32"),
    *(Candidate("cjp", size, data="walk") for size in ("256x192", "160x120", "192x144")),
)


def config_of(candidate: Candidate, seed: int, work: Path) -> TrainConfig:
    """Return the options of a training run."""
    weights = Path(os.path.expandvars(PRETRAINED))
    if candidate.kept < 100:
        weights = pruned_weights(
            weights, candidate.kept, work / f"{candidate.backbone}.safetensors"
        )
    dataset, split = DATA[candidate.data]
    return configure(
        method=candidate.method,
        dataset=os.path.expandvars(dataset),
        split=split,
        seed=seed,
        size=candidate.size,
        crop="none",
        backbone=candidate.backbone,
        weights=str(weights),
        stages=candidate.stages,
        grid="3x4",
        normalisation=None,
        **{"head": {}, **BUDGETS[candidate.method]},
    )


def share_features(config: TrainConfig, cache: Path) -> None:
    """Fill the caches of ``STAGES`` at this size in one pass over the augmented copies."""
    dataset = open_dataset(config.dataset)
    roles = make_split(dataset, config.split, config.seed).roles
    size = config.height, config.width
    indices = np.concatenate([roles["train"], roles["fit"]])
    images = ModelImages(dataset, indices, *size, config.crop)
    together = Backbone(replace(config.backbone, stages=STAGES), *size)
    sha256 = str(load_weights(together, config.weights))
    folders = []
    for stage in STAGES:
        one = replace(config, backbone=replace(config.backbone, stages=(stage,)))
        folders.append(shared_folder(cache, one, sha256, images))
    if all((folder / f"copy-{config.copies:03d}.npz").exists() for folder in folders):
        return
    whole = cache / f"together-{images.digest()[:24]}-{config.seed}"
    extractor = FeatureExtractor(together, *size)
    with show_progress() as progress:
        features, poses = cached_copies(
            whole, images, extractor, config.augment, config.copies, config.seed, progress
        )
    cells = together.config.grid[0] * together.config.grid[1]
    ends = np.cumsum([shape[0] * cells for shape in together.map_shapes])[:-1]
    for folder, part in zip(folders, np.split(features, ends, axis=2), strict=True):
        folder.mkdir(parents=True, exist_ok=True)
        for number in range(config.copies + 1):
            path = folder / f"copy-{number:03d}.npz"
            np.savez(path, features=part[number], poses=poses[number])
    shutil.rmtree(whole)


def trained(candidate: Candidate, seed: int, work: Path) -> Run:
    """Train one network, or read it if it is there."""
    config, run_dir = config_of(candidate, seed, work), work / "runs" / f"{candidate.name}-{seed}"
    if (run_dir / "network.pt").exists():
        return load_run(run_dir)
    if candidate.stages in STAGES and candidate.method == "cjp" and candidate.kept == 100:
        share_features(config, work / "features")
    # The map of the recordings does not depend on the network's size.
    known = work / f"map-{seed}.npz"
    if candidate.method == "scr" and known.exists():
        run_dir.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(known, run_dir / MAP_FILE)
    with show_progress() as progress:
        run = train(run_dir, config, progress, work / "features")
    if candidate.method == "scr":
        shutil.copyfile(run_dir / MAP_FILE, known)
    return run


def graphs(graph: PoseGraph, config: TrainConfig, images: ModelImages) -> dict[Precision, bytes]:
    """Return a network in both precisions; images give the ranges of its maps."""
    blank = torch.zeros((1, config.height, config.width, 3), dtype=torch.uint8)
    deployed = PoseGraph(graph.backbone, graph.head.deployed()).eval()
    names = list(graph.head.output_names)
    with torch.no_grad():
        # A method with cells also returns a map, for the alarm.
        names += ["map"] * (len(deployed(blank)) - len(names))
    content = export_onnx(deployed, [blank], ["image"], names)
    feeds = [{"image": image[np.newaxis]} for image in images.images]
    return {"fp32": content, "int8": quantised(content, feeds)}


def range_images(run: Run) -> ModelImages:
    """Return some training frames as the network's inputs."""
    frames = run.training_frames
    return images_of(run, frames[np.linspace(0, frames.size - 1, _RANGE_FRAMES).astype(int)])


def images_of(run: Run, indices: NDArray[np.int64]) -> ModelImages:
    """Return frames as the network's inputs."""
    return ModelImages(run.dataset, indices, run.config.height, run.config.width, run.config.crop)


def score(run: Run, content: bytes) -> dict[str, Any]:
    """Return the interval score at 0.9 on test, with thresholds of cal, and the median error."""
    session = Session(content, threads=1)
    error: dict[str, Array] = {}
    below: dict[str, Array] = {}
    above: dict[str, Array] = {}
    for role in ("cal", "test"):
        images = images_of(run, run.split.roles[role])
        found = [session.run({"image": image[np.newaxis]}) for image in images.images]
        error[role], below[role], above[role] = of_bounds(run, images, found)
    scores = np.maximum(-error["cal"] / below["cal"], error["cal"] / above["cal"])
    q_hat = np.array([conformal_quantile(column, 0.9) for column in scores.T])
    lower, upper = -q_hat * below["test"], q_hat * above["test"]
    distance = np.maximum(np.maximum(lower - error["test"], error["test"] - upper), 0.0)
    value = interval_score(upper - lower, distance, 0.1) / run.target.deviation
    sequence = run.dataset.sequence[run.split.roles["test"]]
    return {
        "normalised_interval_score": float(value.mean()),
        # For the standard error of differences.
        "of_recordings": [float(value[sequence == each].mean()) for each in np.unique(sequence)],
        "without_interval": 0.0,
        "coverage": float((distance == 0.0).mean()),
        "median_m": float(np.median(np.linalg.norm(error["test"][:, :3], axis=1))),
        "bytes": len(content),
    }


def of_bounds(
    run: Run, images: ModelImages, found: Sequence[Outputs]
) -> tuple[Array, Array, Array]:
    """Errors of the points, and their distances to both bounds, (n, 6) each."""
    pose, lower, upper = (
        np.concatenate([one[name] for one in found]).astype(float)
        for name in ("pose", "lower", "upper")
    )
    at, floor = run.target.coordinates(pose), 1e-3 * run.target.deviation
    error = run.target.coordinates(images.poses) - at
    return error, np.maximum(at - lower, floor), np.maximum(upper - at, floor)


def published_score(run: Run, precision: Precision, bundle: Path) -> dict[str, Any]:
    """Return the same of a bundle, made if it is missing; frames without an interval do not count.

    Without ``of_recordings``, which ``evaluate`` does not report.
    """
    if not bundle.exists():
        publish(run, bundle, bundle.name, rule="pooled", precision=precision)
    found = figures(bundle, run.config.dataset)
    frames = found["frames"]
    return {
        "normalised_interval_score": found["normalised_interval_score"],
        "without_interval": 1.0 - frames["bounded"] / frames["total"],
        "coverage": found["mean_coverage"],
        "median_m": found["point_error"]["median_m"],
        "bytes": found["model_bytes"],
    }


def solver_of(run: Run, images: ModelImages) -> tuple[PoseSolver, float]:
    """Return the solver of the network's images, and their focal length in pixels."""
    parameters, camera = run.graph.head.candidates()[0].parameters, images.camera
    if not isinstance(parameters, ScrParameters) or camera is None:
        raise SystemExit("expected a run of scr, found another one")
    rays = camera.rays(cell_centres(camera.height, camera.width, parameters.grid))
    starts, damping = np.array(parameters.starts), np.array(parameters.damping)
    return PoseSolver(rays, starts, damping), camera.focal_px


def train_all(work: Path, only: list[str], seeds: int) -> None:
    """Make what is missing."""
    work.mkdir(parents=True, exist_ok=True)
    for seed, candidate in product(range(seeds), CANDIDATES):
        path = work / "cells" / f"{candidate.name}-{seed}.json"
        if path.exists() or not all(word in path.name for word in only):
            continue
        begin = process_time()
        run = trained(candidate, seed, work)
        row: dict[str, Any] = {
            "processor_s": round(process_time() - begin),
            "parameters": sum(values.numel() for values in run.graph.parameters()),
        }
        for precision, content in graphs(run.graph, run.config, range_images(run)).items():
            graph = work / "graphs" / f"{candidate.name}-{seed}-{precision}.onnx"
            graph.parent.mkdir(exist_ok=True)
            graph.write_bytes(content)
            row[precision] = (
                published_score(run, precision, work / "bundles" / graph.stem)
                if candidate.method == "scr"
                else score(run, content)
            )
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(row, indent=1) + "\n", "utf-8")
        scores = [round(row[each]["normalised_interval_score"], 4) for each in PRECISIONS]
        print(f"{path.stem}: {scores}, {row['processor_s']} s", flush=True)


def main() -> None:
    """Make, train and score what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--only", nargs="*", default=[], help="words of the networks' names")
    parser.add_argument("--seeds", type=int, default=1)
    arguments = parser.parse_args()
    train_all(arguments.work, arguments.only, arguments.seeds)


if __name__ == "__main__":
    main()
