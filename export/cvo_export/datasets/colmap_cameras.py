"""Cameras of COLMAP (Schoenberger and Frahm 2016): ``cameras.txt`` or ``cameras.bin``.

COLMAP gives the centre of the first pixel the coordinates (0.5, 0.5), this project (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from cvo_edge.camera import Camera, Distortion
from cvo_edge.errors import SourceError
from cvo_edge.files import regular_file
from cvo_edge.trajectories.colmap import MAX_COUNT, Bytes, refusal
from cvo_edge.trajectories.tables import read_text
from cvo_export.datasets.base import Intrinsics

HALF_PIXEL = 0.5

# COLMAP's models by number: name, parameters, distortion here. The first parameters are one or two
# focal lengths and the principal point.
_RADIAL: Distortion = "radial_tangential"
MODELS: tuple[tuple[str, int, Distortion | None], ...] = (
    ("SIMPLE_PINHOLE", 3, "none"),
    ("PINHOLE", 4, "none"),
    ("SIMPLE_RADIAL", 4, _RADIAL),
    ("RADIAL", 5, _RADIAL),
    ("OPENCV", 8, _RADIAL),
    ("OPENCV_FISHEYE", 8, "equidistant"),
    ("FULL_OPENCV", 12, _RADIAL),
    ("FOV", 5, None),
    ("SIMPLE_RADIAL_FISHEYE", 4, "equidistant"),
    ("RADIAL_FISHEYE", 5, "equidistant"),
    ("THIN_PRISM_FISHEYE", 12, None),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16, None),
    ("SIMPLE_DIVISION", 4, None),
    ("DIVISION", 5, None),
    ("SIMPLE_FISHEYE", 3, "equidistant"),
    ("FISHEYE", 4, "equidistant"),
    ("EUCM", 6, None),
    ("EQUIRECTANGULAR", 2, None),
)
# These have two focal lengths.
_TWO_FOCALS = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FISHEYE")
_FORM = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
_MAX_BYTES = 256 << 20
# Bytes of the shortest camera in cameras.bin.
_LEAST = 40


class Stated(NamedTuple):
    """A camera as the file states it: file and place, model, width and height, parameters."""

    where: str
    model: str
    size: tuple[int, int]
    values: list[float]

    @property
    def usable(self) -> bool:
        """Whether the model has a counterpart here."""
        return any(name == self.model and lens for name, _, lens in MODELS)

    def camera(self) -> Camera:
        """Return the camera; raises SourceError if there is no such camera here."""
        return camera_of(*self)


def read_cameras(path: Path) -> dict[int, Stated]:
    """Read ``cameras.txt`` or ``cameras.bin``, at most a million cameras in 256 MiB, by number.

    Raises SourceError if the file is malformed, larger, or states a camera twice.
    """
    found: dict[int, Stated] = {}
    for number, stated in _binary(path) if path.suffix == ".bin" else _text(path):
        if number in found or len(found) >= MAX_COUNT:
            raise SourceError(
                f"{stated.where}: expected each camera once and at most {MAX_COUNT}, found camera "
                f"{number} {'again' if number in found else 'as well'}"
            )
        found[number] = stated
    return found


def camera_of(where: str, model: str, size: tuple[int, int], values: list[float]) -> Camera:
    """Return the camera of COLMAP's model name, image width and height, and parameters.

    Raises SourceError, which begins with ``where``, if there is no such camera here.
    """
    known = {name: (count, distortion) for name, count, distortion in MODELS}
    count, distortion = known.get(model, (0, None))
    if distortion is None:
        usable = ", ".join(name for name, (_, lens) in known.items() if lens)
        raise SourceError(
            f"{where}: expected a camera model {usable}, found {model}; undistort the images with "
            "`colmap image_undistorter`"
        )
    if len(values) != count:
        raise SourceError(f"{where}: expected {count} parameters of {model}, found {len(values)}")
    focal = 2 if model in _TWO_FOCALS else 1
    fx, fy, (cx, cy) = values[0], values[focal - 1], values[focal : focal + 2]
    intrinsics = Intrinsics(fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL)
    if not (intrinsics.possible and np.isfinite(values).all() and min(size) > 0):
        raise SourceError(f"{where}: expected positive focal lengths and sizes, found {values}")
    lens = values[focal + 2 :]
    if distortion != "none":
        lens = [*lens, *[0.0] * (4 - len(lens))]
    return Camera(
        width=size[0],
        height=size[1],
        **intrinsics._asdict(),
        distortion=distortion,
        coefficients=tuple(lens),
    )


def _text(path: Path) -> Iterator[tuple[int, Stated]]:
    for number, line in enumerate(read_text(path, _FORM).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            identity, model, width, height, *values = line.split()
            size, numbers = (int(width), int(height)), [float(value) for value in values]
            key = int(identity)
        except ValueError:
            raise refusal(path, _FORM, line, number) from None
        yield key, Stated(f"{path}: line {number}", model, size, numbers)


def _binary(path: Path) -> Iterator[tuple[int, Stated]]:
    with regular_file(path, _MAX_BYTES, SourceError, links=True) as stream:
        try:
            yield from _binary_cameras(path, stream)
        except OSError as error:
            raise SourceError(f"{path}: cannot be read: {error.strerror}") from None


def _binary_cameras(path: Path, stream: BinaryIO) -> Iterator[tuple[int, Stated]]:
    content = Bytes(path, stream)
    for _ in range(content.count("cameras", _LEAST)):
        identity, model, width, height = content.take("iiQQ")
        if not 0 <= model < len(MODELS):
            raise content.refusal(f"a camera model 0 to {len(MODELS) - 1}, not {model}")
        name, parameters, _ = MODELS[model]
        values = list(content.take(f"{parameters}d"))
        yield identity, Stated(f"{path}: camera {identity}", name, (width, height), values)
