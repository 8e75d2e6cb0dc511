"""Bundles of whole networks, and frames, made from the synthetic room for measurements.

    python bench/networks.py

The networks are briefly trained (100 steps, no pretrained weights): they take the time of trained
ones, but their poses are useless. SCR's end at stride 16, where its cells are. Everything is kept
in ``build/bench`` and reused. The trained bundles are those in ``calibration_artifacts``.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import onnx
from onnx.utils import Extractor

if TYPE_CHECKING:
    from torch import nn

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "build" / "bench"
ARTIFACTS = ROOT / "calibration_artifacts"
# Those that regress a pose, and those with a demonstration bundle.
METHODS = ("cjp", "cqr", "csp", "mcqr")
DEMONSTRATED = ("scr", *METHODS)
BACKBONES = ("mobilenetv2_100", "resnet34")
PRECISIONS = ("fp32", "int8")
ROOM = "synthetic:room,flights=20,frames=20"
# Longer than the memory of the checks of repetition, which would doubt a picture that comes again.
FRAMES = "synthetic:room,flights=7,frames=50,size=640x480,seed=1"
_CROP = "--crop centre"
_WHOLE = "--stages final --grid 1x1"
# A cropped frame of 640x480, halved.
HALVED = "240x240"
_UNTRAINED = "--split random --steps 100 --copies 0"
# Cells must agree on a pose, or none of its frames has an interval.
_CELLS = "--cell-steps 600 --upper-rate 0.1"


def whole_bundle(
    method: str,
    backbone: str,
    precision: str = "fp32",
    size: str = "224x224",
    provider: str = "onnxruntime",
) -> Path:
    """Return a bundle of a whole, briefly trained network, made if it does not exist."""
    name = f"{method}-{backbone}" if size == "224x224" else f"{method}-{backbone}-{size}"
    part = _CELLS if method == "scr" else _WHOLE
    options = f"--backbone {backbone} {part} {_CROP} --size {size}"
    options = f"{options} --weights {_random_weights(backbone, calm=method == 'scr')}"
    run, bundle = WORK / "runs" / name, WORK / f"{name}-{precision}"
    if provider != "onnxruntime":
        bundle = bundle.with_name(f"{bundle.name}-{provider}")
    if not bundle.exists():
        features = str(WORK / "features")
        options = f"{options} {_UNTRAINED}"
        _cvo_export("train", method, ROOM, str(run), *options.split(), "--cache", features)
        how = ("--precision", precision, "--provider", provider)
        _cvo_export("publish", str(run), str(bundle), *how)
    return bundle


def half_bundle(backbone: str, precision: str) -> Path:
    """Return CJP's bundle for JPEG files that are decoded at half size, made if it is missing."""
    bundle = WORK / f"cjp-{backbone}-{precision}-half"
    if not bundle.exists():
        whole = whole_bundle("cjp", backbone, precision)
        _cvo_export("calibrate", str(whole), f"7scenes:{_room()}", str(bundle), "--decode", "half")
    return bundle


def _room() -> Path:
    """Return the room's recordings as JPEG files of 640x480 with poses, in 7-Scenes' layout."""
    room = WORK / "room"
    if not room.exists():
        from cvo_export.datasets import open_dataset
        from cvo_export.datasets.seven_scenes import write_sequence

        partial = WORK / "room.partial"
        shutil.rmtree(partial, ignore_errors=True)
        dataset = open_dataset(f"{ROOM},size=640x480")
        for sequence in range(len(dataset.sequence_names)):
            write_sequence(dataset, sequence, partial / f"seq-{sequence + 1:02}", None)
        partial.rename(room)
    return room


def _random_weights(backbone: str, *, calm: bool) -> Path:
    """Return the file of a backbone's random weights, made if it does not exist.

    Those that can be trained in few steps are ``calm``: their residual branches add little.
    """
    path = WORK / f"{backbone}-{'calm' if calm else 'random'}.safetensors"
    if not path.exists():
        import timm
        import torch
        from safetensors.torch import save_file

        WORK.mkdir(parents=True, exist_ok=True)
        torch.manual_seed(0)
        body = timm.create_model(backbone, pretrained=False, num_classes=0)
        open_branches(body, 0.2 if calm else 1.0)
        save_file(body.state_dict(), path)
    return path


def open_branches(body: nn.Module, scale: float = 1.0) -> None:
    """Replace the scales of zero with which residual branches start.

    Otherwise an engine that folds constants drops these branches and is timed on a fraction of
    ResNet34, and 8 bits have nothing to round.
    """
    for name, values in body.named_parameters():
        if name.endswith("weight") and not values.any():
            values.data.fill_(scale)


def demonstration(method: str, precision: str = "fp32") -> Path:
    """Return the demonstration bundle of a method: a trained, truncated network."""
    return ARTIFACTS / f"synthetic-room-{method}{'' if precision == 'fp32' else '-int8'}"


def frames() -> list[Path]:
    """Return 350 JPEG files, 640x480, of flights through the room; rendered once."""
    folder = WORK / "flights"
    if not folder.exists():
        from cvo_export.datasets import open_dataset

        partial = WORK / "flights.partial"
        partial.mkdir(parents=True, exist_ok=True)
        dataset = open_dataset(FRAMES)
        for index in range(len(dataset)):
            cv2.imwrite(str(partial / f"frame-{index:06}.jpg"), dataset.read_image(index))
        partial.rename(folder)
    return sorted(folder.glob("*.jpg"))


def frames_as(form: str, count: int = 50) -> Path:
    """Return a folder of the first of these frames: ``jpg``, or the same pixels as ``bmp``."""
    folder = WORK / f"frames-{form}-{count}"
    if not folder.exists():
        partial = folder.with_suffix(".partial")
        partial.mkdir(parents=True, exist_ok=True)
        for path in frames()[:count]:
            if form == path.suffix[1:]:
                shutil.copyfile(path, partial / path.name)
            else:
                cv2.imwrite(str(partial / f"{path.stem}.{form}"), cv2.imread(str(path)))
        partial.rename(folder)
    return folder


def images() -> list[np.ndarray]:
    """Return the same frames decoded, (480, 640, 3) uint8 BGR."""
    return [cv2.imread(str(path)) for path in frames()]


def pose_alone(model_bytes: bytes) -> bytes:
    """Return the part of a model that computes the pose, or what a solver needs for it."""
    model = onnx.load_from_string(model_bytes)
    solved = {"coordinates", "log_scale_px"} & {output.name for output in model.graph.output}
    outputs = sorted(solved) or ["pose"]
    part: bytes = Extractor(model).extract_model(["image"], outputs).SerializeToString()
    return part


def _cvo_export(*arguments: str) -> None:
    command = [sys.executable, "-c", "from cvo_export.cli import main; main()", *arguments]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    """Make all of them."""
    frames()
    for method, backbone, precision in product(DEMONSTRATED, BACKBONES, PRECISIONS):
        print(whole_bundle(method, backbone, precision).name, flush=True)
    for backbone in BACKBONES:
        print(whole_bundle("cjp", backbone, size=HALVED).name, flush=True)
        for precision in PRECISIONS:
            print(half_bundle(backbone, precision).name, flush=True)


if __name__ == "__main__":
    main()
