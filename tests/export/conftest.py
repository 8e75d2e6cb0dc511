"""A tiny run that is trained once: random weights, small images, a few hundred steps."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d
from torch.onnx._internal.exporter import _registration

from cvo_export import publish as publishing
from cvo_export.bundles import alarm, difficulty
from cvo_export.data.augment import AugmentConfig
from cvo_export.datasets import synthetic
from cvo_export.graph import familiarise, to_onnx
from cvo_export.networks.backbone import BackboneConfig
from cvo_export.networks.heads.cjp import CjpConfig
from cvo_export.publish import publish
from cvo_export.training import features, loop
from cvo_export.training import run as training_run
from cvo_export.training.lesson import Lesson
from cvo_export.training.loop import train
from cvo_export.training.run import Run, TrainConfig

# For networks this small, several threads only add overhead.
torch.set_num_threads(1)

DATASET = "synthetic:room,flights=8,frames=40,size=64x48"


def tiny_config(**changes: Any) -> TrainConfig:
    values: dict[str, Any] = {
        "head": CjpConfig(),
        "dataset": DATASET,
        "split": "random",
        "height": 48,
        "width": 64,
        # Its graph exports in a third of the time of a MobileNetV2.
        "backbone": BackboneConfig("test_efficientnet", stages=("16",), grid=(3, 4)),
        "weights": "none",
        "augment": AugmentConfig(2.0, 0.5),
        "copies": 2,
        "steps": 240,
        "warm_up_steps": 20,
        "averaging": 0.9,
    }
    return TrainConfig(**{**values, **changes})


class Thumbnail(nn.Module):
    """The image itself in 8x6 pixels: a backbone whose graphs export in a third of the time."""

    size = 3 * 8 * 6
    mean = std = (0.5, 0.5, 0.5)

    def forward(self, image: Tensor) -> Tensor:
        return avg_pool2d(image.permute(0, 3, 1, 2) / 127.5 - 1.0, 8).flatten(1)

    def cells(self, features: Tensor) -> Tensor:
        return features.unflatten(1, (3, -1)).transpose(1, 2)


@contextmanager
def thumbnails() -> Iterator[None]:
    """Train and load runs on thumbnails: for laws that hold for any backbone."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (loop, training_run):
            patch.setattr(module, "loaded_backbone", lambda *_: (Thumbnail(), None, None))
        yield


@pytest.fixture
def small_backbone() -> Iterator[None]:
    with thumbnails():
        yield


# Attributes of a torch module that ``named_modules`` and ``state_dict`` already show.
_STATE = {"_parameters", "_buffers", "_modules"}


def ignore_progress(stage: str, done: int, total: int, note: str = "") -> None:
    """Discard progress reports."""


@pytest.fixture(scope="session", autouse=True)
def _exported_once() -> Iterator[None]:
    """Export each network once: most runs have the same random backbone, some are published twice.

    An attribute whose repr is an address makes a network differ from all others.
    """
    graphs: dict[str, bytes] = {}

    def export_once(module: Any, *rest: Any) -> bytes:
        parts = [
            (name, type(part), sorted((k, v) for k, v in vars(part).items() if k not in _STATE))
            for name, part in module.named_modules()
        ]
        state = [(name, values.numpy().tobytes()) for name, values in module.state_dict().items()]
        key = hashlib.sha256(repr((parts, state, rest)).encode()).hexdigest()
        if key not in graphs:
            graphs[key] = to_onnx.export_onnx(module, *rest)
        return graphs[key]

    # torch parses its five hundred operators again for each export.
    operators = functools.cache(_registration.onnxscript_apis.get_torchlib_ops)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_registration.onnxscript_apis, "get_torchlib_ops", operators)
        patch.setattr(features, "export_onnx", export_once)
        patch.setattr(publishing, "export_onnx", export_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def _last_checkpoint() -> Iterator[None]:
    """Write the last checkpoint of a lesson alone, if nothing can interrupt it before."""
    write = Lesson._write_checkpoint

    def written(lesson: Lesson, phase: int, step: int, ended: bool, *rest: Any) -> None:
        if ended or lesson.material.progress is not ignore_progress:
            write(lesson, phase, step, ended, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Lesson, "_write_checkpoint", written)
        yield


@pytest.fixture(scope="session", autouse=True)
def _few_copies() -> Iterator[None]:
    """Fit the alarm to a tenth of the frames: its laws do not depend on how many there are."""
    with pytest.MonkeyPatch.context() as patch:
        for name, count in (("_FRAMES", 120), ("_HARMLESS", 15), ("_NOISY", 36), ("_CHECKED", 4)):
            patch.setattr(familiarise, name, count)
        patch.setattr(alarm, "_CHANGED_FRAMES", 25)
        patch.setattr(difficulty, "_COPIES", 6)
        yield


_PICTURES: dict[Any, Any] = {}


@pytest.fixture(scope="session", autouse=True)
def _drawn_once() -> Iterator[None]:
    """Draw each picture of the scene once: many tests train on the same scene."""
    draw = synthetic.Flight.photograph

    def photograph(flight: Any, frame: int, intrinsics: Any, size: tuple[int, int]) -> Any:
        path = flight._yaw, tuple(flight._still), flight._tag_m
        key = (flight._entropy, path, frame, size)
        if key not in _PICTURES:
            _PICTURES[key] = draw(flight, frame, intrinsics, size)
        return _PICTURES[key].copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic.Flight, "photograph", photograph)
        yield


@pytest.fixture(scope="session")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs") / "tiny"


@pytest.fixture(scope="session")
def tiny_run(run_dir: Path) -> Run:
    return train(run_dir, tiny_config(), ignore_progress)


@pytest.fixture(scope="session")
def tiny_bundle(tiny_run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bundles") / "tiny"
    publish(tiny_run, folder, "tiny")
    return folder
