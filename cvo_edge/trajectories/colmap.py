"""COLMAP images (Schoenberger and Frahm 2016): ``images.txt`` or ``images.bin``.

Files are read image by image, and keypoints are passed over, so memory depends on the number of
images alone: at most a million, in files of at most 64 GiB.

An image has ``qw qx qy qz tx ty tz`` of ``T_camera_world``, the inverse of the pose here, for an
OpenCV camera. A model knows lengths up to a factor only, unless its author has scaled it to metres.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.files import regular_file
from cvo_edge.pose import Pose
from cvo_edge.trajectories.poses import quaternion_fault, quaternion_pose

Array = NDArray[np.float64]

FORM = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0")
MAX_COUNT = 1_000_000
_MAX_BYTES = 64 << 30
# Bytes of a name, of a line with an image, of a step over a line of keypoints, and of the shortest
# image in images.bin.
_LONGEST_NAME, _LONGEST_LINE, _STEP, _LEAST = 4096, 8192, 1 << 20, 73


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


def read_images(path: Path) -> Iterator[Image]:
    """Yield the images of ``images.txt`` or ``images.bin``.

    Raises SourceError if the file is malformed or larger than the limits.
    """
    with regular_file(path, _MAX_BYTES, SourceError, links=True) as stream:
        read = _binary_images if path.suffix == ".bin" else _text_images
        try:
            for number, image in enumerate(read(path, stream), start=1):
                if number > MAX_COUNT:
                    raise SourceError(
                        f"{path}: expected at most {MAX_COUNT} images, found more; divide the model"
                    )
                yield image
        except OSError as error:
            raise SourceError(f"{path}: cannot be read: {error.strerror}") from None


def _image(name: str, camera: int, values: Array, where: str) -> Image:
    """Return the image of ``qw qx qy qz tx ty tz``."""
    q_xyzw, t = np.roll(values[:4], -1), values[4:]
    fault = quaternion_fault(t, q_xyzw)
    world_to_camera = quaternion_pose(t, q_xyzw)
    if world_to_camera is None:
        return Image(name, camera, None, where, fault)
    T = np.linalg.inv(Pose.from_array(world_to_camera).to_matrix())
    return Image(name, camera, Pose.from_matrix(T).to_array(), where, None)


def _text_images(path: Path, stream: BinaryIO) -> Iterator[Image]:
    lines = _lines(stream)
    for number, content in lines:
        line = content.decode("utf-8-sig" if number == 1 else "utf-8", "replace")
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split(maxsplit=9)
        try:
            content.decode()
            values = np.array(fields[1:8], dtype=np.float64)
            camera, name = int(fields[8]), fields[9].strip()
        except (ValueError, IndexError):
            raise refusal(path, FORM, line, number) from None
        if len(content) == _LONGEST_LINE:
            raise refusal(path, f"{FORM} of less than {_LONGEST_LINE} bytes", line, number)
        yield _image(name, camera, values, f"{path.name}, line {number}")
        # The second line of an image lists its keypoints and may be empty.
        number, content = next(lines, (number, b""))
        if _is_image(content.split(maxsplit=9)):
            line = content.decode("utf-8", "replace")
            raise refusal(
                path, "a line of keypoints, or an empty one, after an image", line, number
            )


def _lines(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield number and content of each line; what is beyond the longest one is passed over."""
    number = 0
    while line := stream.readline(_LONGEST_LINE):
        number += 1
        rest = line
        while rest and not rest.endswith(b"\n"):
            rest = stream.readline(_STEP)
        yield number, line


def _is_image(fields: list[bytes]) -> bool:
    """Whether the tenth field is a name; of keypoints, it is a number."""
    try:
        float(fields[9].split()[0])
    except IndexError:
        return False
    except ValueError:
        return True
    return False


def refusal(path: Path, form: str, line: str, number: int) -> SourceError:
    """Return an error that states what was expected in a line."""
    return SourceError(f"{path}: expected {form}, found {line.strip()[:80]!r} in line {number}")


class Bytes:
    """Reads little-endian numbers of a file; raises SourceError at its end."""

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self._path, self._stream = path, stream
        self._size = stream.seek(0, 2)
        self.place = stream.seek(0)

    def take(self, form: str) -> tuple[Any, ...]:
        """Return the next numbers, as ``struct`` names them."""
        size = struct.calcsize("<" + form)
        content = self._stream.read(size)
        if len(content) < size:
            raise self.refusal("more data; the file is cut short")
        self.place += size
        return struct.unpack("<" + form, content)

    def count(self, what: str, least: int) -> int:
        """Return the number of things that follow, each of ``least`` bytes or more."""
        (count,) = self.take("Q")
        most = min(MAX_COUNT, (self._size - self.place) // least)
        if count > most:
            raise self.refusal(f"at most {most} {what}, not {count}")
        return int(count)

    def name(self) -> str:
        """Return the next text, which ends with a zero."""
        content = self._stream.read(_LONGEST_NAME)
        end = content.find(b"\0")
        if end < 0:
            raise self.refusal("a name that ends")
        self.place = self._stream.seek(self.place + end + 1)
        return content[:end].decode("utf-8", "surrogateescape")

    def skip(self, count: int) -> None:
        """Pass over bytes."""
        if count > self._size - self.place:
            raise self.refusal("more data; the file is cut short")
        self.place = self._stream.seek(self.place + count)

    def refusal(self, expected: str) -> SourceError:
        """Return an error with what was expected and the place."""
        return SourceError(
            f"{self._path}: expected {expected}, found {self._size} bytes (at byte {self.place})"
        )


def _binary_images(path: Path, stream: BinaryIO) -> Iterator[Image]:
    content = Bytes(path, stream)
    for _ in range(content.count("images", _LEAST)):
        *values, camera = content.take("i7di")[1:]
        name = content.name()
        content.skip(24 * content.take("Q")[0])
        yield _image(name, camera, np.array(values), f"{path.name}, image {name}")
