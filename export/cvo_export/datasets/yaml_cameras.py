"""Cameras in YAML files: ``sensor.yaml`` of the ASL layout and Kalibr's ``camchain.yaml``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from cvo_edge.camera import Camera, Distortion
from cvo_edge.errors import SourceError
from cvo_edge.trajectories.tables import read_text
from cvo_export.datasets.base import Intrinsics, Lens, PoseDataset
from cvo_export.datasets.sizes import with_camera

Array = NDArray[np.float64]

# No image is wider or higher.
_MOST_PX = 1e6

_MODELS: dict[str, Distortion] = {
    "radial-tangential": "radial_tangential",
    "radtan": "radial_tangential",
    "equidistant": "equidistant",
}


def read_document(path: Path, key: str) -> dict[Any, Any]:
    """Read a file that describes a camera; raises SourceError, which names the expected ``key``."""
    text = read_text(path, f"a camera's {key} and intrinsics")
    # OpenCV's tools require a first line %YAML:1.0, which is not valid YAML.
    text = "\n".join(line for line in text.splitlines() if not line.startswith("%YAML"))
    try:
        document: Any = yaml.safe_load(text)
    # Invalid dates raise ValueError, and deeply nested brackets raise RecursionError.
    except (yaml.YAMLError, ValueError, RecursionError):
        document = None
    if not isinstance(document, dict):
        raise SourceError(f"{path}: expected YAML with {key} and intrinsics, found other text")
    return document


class Pinhole(NamedTuple):
    """A camera of a YAML file; ``size`` is width and height of its images, None if not stated."""

    intrinsics: Intrinsics
    lens: Lens
    size: tuple[int, int] | None

    def of(self, dataset: PoseDataset, where: str) -> PoseDataset:
        """Return the data set with this camera, scaled to its images.

        Raises SourceError, which begins with ``where``, for images of another shape.
        """
        if self.size is None:
            return replace(dataset, intrinsics=self.intrinsics, lens=self.lens)
        camera = Camera(
            width=self.size[0],
            height=self.size[1],
            **self.intrinsics._asdict(),
            distortion=self.lens.distortion,
            coefficients=self.lens.coefficients,
        )
        return with_camera(dataset, where, camera)


def pinhole(path: Path, camera: dict[Any, Any], lens: str) -> Pinhole | None:
    """Return the camera, whose distortion coefficients have the key ``lens``.

    Returns None for a camera that is no pinhole or has another distortion than radial-tangential
    and equidistant. Raises SourceError for intrinsics that no camera has.
    """
    intrinsics = _numbers(camera.get("intrinsics"), 4)
    model = _MODELS.get(str(camera.get("distortion_model")))
    coefficients = _numbers(camera.get(lens), 4)
    if intrinsics is None or model is None or coefficients is None:
        return None
    if camera.get("camera_model") != "pinhole":
        return None
    found = Intrinsics(*intrinsics.tolist()).checked(str(path))
    resolution = _numbers(camera.get("resolution"), 2)
    size = None
    if resolution is not None and (resolution >= 1.0).all() and (resolution < _MOST_PX).all():
        size = int(resolution[0]), int(resolution[1])
    return Pinhole(found, Lens(model, tuple(coefficients.tolist())), size)


def _numbers(values: object, count: int) -> Array | None:
    try:
        numbers = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return numbers.reshape(count) if numbers.size == count else None
