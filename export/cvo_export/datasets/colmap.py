"""COLMAP sparse models (Schoenberger and Frahm 2016): text or binary, with the images beside them.

``cameras``, ``images`` and ``points3D`` are files ``.bin`` or ``.txt``; the points are not read.
Poses are read as ``cvo_edge.trajectories.colmap`` describes.
COLMAP gives the centre of the first pixel the coordinates (0.5, 0.5), this project (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import Camera, Distortion
from cvo_edge.errors import SourceError
from cvo_edge.input.image_files import natural_key
from cvo_edge.trajectories.colmap import Bytes, model_folder, read_images, refusal
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
_CAMERA_FORM = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"


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
    found = read_images(folder / f"images.{'bin' if binary else 'txt'}")
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
    folder = model_folder(root)
    if folder is None:
        raise SourceError(
            f"{root}: expected cameras.bin and images.bin, or cameras.txt and images.txt, there or "
            "in sparse/0, found neither"
        )
    return folder


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
            raise refusal(path, _CAMERA_FORM, line, number) from None
        yield key, camera_of(f"{path}: line {number}", model, size, numbers)


def _binary_cameras(folder: Path) -> Iterator[tuple[int, Camera]]:
    path = folder / "cameras.bin"
    content = Bytes(path)
    (count,) = content.take("Q")
    for _ in range(count):
        identity, model, width, height = content.take("iiQQ")
        if not 0 <= model < len(_MODELS):
            raise content.refusal(f"a camera model 0 to {len(_MODELS) - 1}, not {model}")
        name, parameters, _ = _MODELS[model]
        values = list(content.take(f"{parameters}d"))
        yield identity, camera_of(f"{path}: camera {identity}", name, (width, height), values)
