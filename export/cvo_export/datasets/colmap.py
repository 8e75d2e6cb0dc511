"""COLMAP sparse models (Schoenberger and Frahm 2016): text or binary, with the images beside them.

``cameras``, ``images`` and ``points3D`` are files ``.bin`` or ``.txt``; the points are not read.
An image has ``qw qx qy qz tx ty tz`` of ``T_camera_world``, the inverse of the pose here, for an
OpenCV camera. A model knows lengths up to a factor only, unless its author has scaled it to metres.
COLMAP gives the centre of the first pixel the coordinates (0.5, 0.5), this project (0, 0).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import Camera, Distortion
from cvo_edge.errors import SourceError
from cvo_edge.input.image_files import natural_key
from cvo_edge.pose import Pose
from cvo_edge.trajectories.poses import quaternion_pose
from cvo_edge.trajectories.tables import read_text
from cvo_export.datasets.base import Intrinsics, Lens, PoseDataset
from cvo_export.datasets.folders import only_camera
from cvo_export.datasets.frames import FrameList

Array = NDArray[np.float64]

# COLMAP's models by number: name, parameters, distortion here. The first parameters are one or two
# focal lengths and the principal point.
_RADIAL: Distortion = "radial_tangential"
_MODELS: tuple[tuple[str, int, Distortion | None], ...] = (
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
)
# These have two focal lengths.
_TWO_FOCALS = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
_MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0")
_CAMERA_FORM = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
_IMAGE_FORM = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"


class _Image(NamedTuple):
    name: str
    camera: int
    pose: Array | None


def open_colmap(path: str) -> PoseDataset:
    """Read a model's folder, or a project with ``sparse/0`` and ``images``.

    Images lie in ``images``, in the project or beside the model. Images in several folders are one
    sequence a folder. Frames with an invalid pose or a missing image are left out and counted.

    Raises SourceError if there is no model, a file is malformed or names an image elsewhere, the
    images have several cameras or a camera model without a counterpart here, or no frame has a
    pose.
    """
    root = Path(path)
    folder = _model_folder(root)
    binary = (folder / "images.bin").is_file()
    cameras = dict(_binary_cameras(folder) if binary else _text_cameras(folder))
    found = list(_binary_images(folder) if binary else _text_images(folder))
    images = _image_folder(root, folder)
    frames = FrameList(root)
    name = root.resolve().name
    for image in sorted(found, key=lambda image: natural_key(Path(image.name))):
        place = PurePosixPath(image.name)
        if place.is_absolute() or ".." in place.parts:
            raise SourceError(
                f"{folder}: expected names of images below {images}, found {image.name!r}"
            )
        sequence = str(place.parent) if place.parent.name else name
        frames.add(sequence, place.stem, images / image.name, image.pose)
    used = {image.camera for image in found}
    if missing := used - cameras.keys():
        raise SourceError(f"{folder}: expected a camera {min(missing)} of an image, found none")
    dataset = frames.dataset(name)
    camera = only_camera(folder, {f"camera {number}": cameras[number] for number in sorted(used)})
    if camera is None:
        return dataset
    height, width = dataset.read_image(0).shape[:2]
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        raise SourceError(
            f"{images}: expected images of {camera.width}x{camera.height} or of that shape, as the "
            f"model states, found {width}x{height}"
        )
    camera = camera.scaled(width, height)
    return replace(
        dataset,
        intrinsics=Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy),
        lens=Lens(camera.distortion, camera.coefficients),
    )


def _model_folder(root: Path) -> Path:
    for below in _MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            if all((root / below / (part + suffix)).is_file() for part in ("cameras", "images")):
                return root / below
    raise SourceError(
        f"{root}: expected cameras.bin and images.bin, or cameras.txt and images.txt, there or in "
        "sparse/0, found neither"
    )


def _image_folder(root: Path, folder: Path) -> Path:
    above = folder.absolute().parents
    tried = [each / "images" for each in (root.absolute(), folder.absolute(), *above[:2])]
    for place in tried:
        if place.is_dir():
            return place
    raise SourceError(f"{root}: expected the images in a folder images, found no {tried[0]}")


def camera_of(where: str, model: str, size: tuple[int, int], values: list[float]) -> Camera:
    """Return the camera of COLMAP's model name, image width and height, and parameters.

    Raises SourceError, which begins with ``where``, if there is no such camera here.
    """
    known = {name: (count, distortion) for name, count, distortion in _MODELS}
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
    intrinsics = Intrinsics(fx, fy, cx - 0.5, cy - 0.5)
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


def _pose(q_wxyz: Array, t: Array) -> Array | None:
    world_to_camera = quaternion_pose(t, np.roll(q_wxyz, -1))
    if world_to_camera is None:
        return None
    T = np.linalg.inv(Pose.from_array(world_to_camera).to_matrix())
    return Pose.from_matrix(T).to_array()


def _text_cameras(folder: Path) -> Iterator[tuple[int, Camera]]:
    path = folder / "cameras.txt"
    for number, line in enumerate(read_text(path, _CAMERA_FORM).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            identity, model, width, height, *values = line.split()
            size, numbers = (int(width), int(height)), [float(value) for value in values]
            key = int(identity)
        except ValueError:
            raise _refusal(path, _CAMERA_FORM, line, number) from None
        yield key, camera_of(f"{path}: line {number}", model, size, numbers)


def _text_images(folder: Path) -> Iterator[_Image]:
    path = folder / "images.txt"
    lines = iter(enumerate(read_text(path, _IMAGE_FORM).splitlines(), start=1))
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split(maxsplit=9)
        try:
            values = np.array(fields[1:8], dtype=np.float64)
            camera, name = int(fields[8]), fields[9].strip()
        except (ValueError, IndexError):
            raise _refusal(path, _IMAGE_FORM, line, number) from None
        yield _Image(name, camera, _pose(values[:4], values[4:]))
        # The second line of an image lists its keypoints and may be empty.
        next(lines, None)


def _refusal(path: Path, form: str, line: str, number: int) -> SourceError:
    return SourceError(f"{path}: expected {form}, found {line[:80]!r} in line {number}")


class _Bytes:
    """Reads little-endian numbers of a file; raises SourceError at its end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.place = 0
        try:
            self._content = path.read_bytes()
        except OSError as error:
            raise SourceError(
                f"{path}: expected a file of COLMAP, but it cannot be read: {error.strerror}"
            ) from None

    def take(self, form: str) -> tuple[Any, ...]:
        try:
            found = struct.unpack_from("<" + form, self._content, self.place)
        except struct.error:
            raise self.refusal("more data; the file is cut short") from None
        self.place += struct.calcsize("<" + form)
        return found

    def name(self) -> str:
        end = self._content.find(b"\0", self.place)
        if end < 0:
            raise self.refusal("a name that ends")
        name, self.place = self._content[self.place : end], end + 1
        return name.decode("utf-8", "surrogateescape")

    def skip(self, count: int) -> None:
        if count > len(self._content) - self.place:
            raise self.refusal("more data; the file is cut short")
        self.place += count

    def refusal(self, expected: str) -> SourceError:
        return SourceError(
            f"{self._path}: expected {expected}, found {len(self._content)} bytes (at byte "
            f"{self.place})"
        )


def _binary_cameras(folder: Path) -> Iterator[tuple[int, Camera]]:
    path = folder / "cameras.bin"
    content = _Bytes(path)
    (count,) = content.take("Q")
    for _ in range(count):
        identity, model, width, height = content.take("iiQQ")
        if not 0 <= model < len(_MODELS):
            raise content.refusal(f"a camera model 0 to {len(_MODELS) - 1}, not {model}")
        name, parameters, _ = _MODELS[model]
        values = list(content.take(f"{parameters}d"))
        yield identity, camera_of(f"{path}: camera {identity}", name, (width, height), values)


def _binary_images(folder: Path) -> Iterator[_Image]:
    content = _Bytes(folder / "images.bin")
    (count,) = content.take("Q")
    for _ in range(count):
        values = np.array(content.take("i7d")[1:])
        (camera,) = content.take("i")
        name = content.name()
        content.skip(24 * content.take("Q")[0])
        yield _Image(name, camera, _pose(values[:4], values[4:]))
