"""COLMAP images (Schoenberger and Frahm 2016): ``images.txt`` or ``images.bin``.

An image has ``qw qx qy qz tx ty tz`` of ``T_camera_world``, the inverse of the pose here, for an
OpenCV camera. A model knows lengths up to a factor only, unless its author has scaled it to metres.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.files import read_regular_file
from cvo_edge.pose import Pose
from cvo_edge.trajectories.poses import quaternion_fault, quaternion_pose
from cvo_edge.trajectories.tables import read_text

Array = NDArray[np.float64]

FORM = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0")
_MAX_BYTES = 16 << 30


class Image(NamedTuple):
    """An image of a model: its name, the number of its camera, its pose, what is wrong with it."""

    name: str
    camera: int
    pose: Array | None
    where: str
    fault: str | None


def model_folder(root: Path) -> Path | None:
    """Return the folder of the model at ``root`` or in a project's usual places below, or None."""
    for below in _MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            if all((root / below / (part + suffix)).is_file() for part in ("cameras", "images")):
                return root / below
    return None


def read_images(path: Path) -> list[Image]:
    """Read ``images.txt`` or ``images.bin``; raises SourceError if it is malformed."""
    return list(_binary_images(path) if path.suffix == ".bin" else _text_images(path))


def _image(name: str, camera: int, values: Array, where: str) -> Image:
    """Return the image of ``qw qx qy qz tx ty tz``."""
    q_xyzw, t = np.roll(values[:4], -1), values[4:]
    fault = quaternion_fault(t, q_xyzw)
    world_to_camera = quaternion_pose(t, q_xyzw)
    if world_to_camera is None:
        return Image(name, camera, None, where, fault)
    T = np.linalg.inv(Pose.from_array(world_to_camera).to_matrix())
    return Image(name, camera, Pose.from_matrix(T).to_array(), where, None)


def _text_images(path: Path) -> Iterator[Image]:
    lines = iter(enumerate(read_text(path, FORM).splitlines(), start=1))
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split(maxsplit=9)
        try:
            values = np.array(fields[1:8], dtype=np.float64)
            camera, name = int(fields[8]), fields[9].strip()
        except (ValueError, IndexError):
            raise refusal(path, FORM, line, number) from None
        yield _image(name, camera, values, f"{path.name}, line {number}")
        # The second line of an image lists its keypoints and may be empty.
        next(lines, None)


def refusal(path: Path, form: str, line: str, number: int) -> SourceError:
    """Return an error that states what was expected in a line."""
    return SourceError(f"{path}: expected {form}, found {line[:80]!r} in line {number}")


class Bytes:
    """Reads little-endian numbers of a file; raises SourceError at its end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.place = 0
        self._content = read_regular_file(path, _MAX_BYTES, SourceError, links=True)

    def take(self, form: str) -> tuple[Any, ...]:
        """Return the next numbers, as ``struct`` names them."""
        try:
            found = struct.unpack_from("<" + form, self._content, self.place)
        except struct.error:
            raise self.refusal("more data; the file is cut short") from None
        self.place += struct.calcsize("<" + form)
        return found

    def name(self) -> str:
        """Return the next text, which ends with a zero."""
        end = self._content.find(b"\0", self.place)
        if end < 0:
            raise self.refusal("a name that ends")
        name, self.place = self._content[self.place : end], end + 1
        return name.decode("utf-8", "surrogateescape")

    def skip(self, count: int) -> None:
        """Pass over bytes."""
        if count > len(self._content) - self.place:
            raise self.refusal("more data; the file is cut short")
        self.place += count

    def refusal(self, expected: str) -> SourceError:
        """Return an error with what was expected and the place."""
        return SourceError(
            f"{self._path}: expected {expected}, found {len(self._content)} bytes (at byte "
            f"{self.place})"
        )


def _binary_images(path: Path) -> Iterator[Image]:
    content = Bytes(path)
    (count,) = content.take("Q")
    for _ in range(count):
        values = np.array(content.take("i7d")[1:])
        (camera,) = content.take("i")
        name = content.name()
        content.skip(24 * content.take("Q")[0])
        yield _image(name, camera, values, f"{path.name}, image {name}")
