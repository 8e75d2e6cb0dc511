"""COLMAP sparse models (Schoenberger and Frahm 2016): text or binary, with the images beside them.

``PATH[,camera=NUMBER]``. ``cameras``, ``images`` and ``points3D`` are files ``.bin`` or ``.txt``;
the points are not read. Poses are read as ``cvo_edge.trajectories.colmap`` describes.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from cvo_edge.camera import Camera
from cvo_edge.errors import SourceError
from cvo_edge.files import natural_key
from cvo_edge.trajectories.colmap import Image, model_folder, read_images
from cvo_edge.trajectories.path_options import path_options
from cvo_export.datasets.base import PoseDataset
from cvo_export.datasets.camera_groups import MOST_SPREAD, alike
from cvo_export.datasets.colmap_cameras import Stated, read_cameras
from cvo_export.datasets.frames import FrameList
from cvo_export.datasets.sizes import with_camera

# Cameras, numbers and folders that a message names; the others are counted.
_NAMED, _FEW = 8, 3


class _Group(NamedTuple):
    """Nearly equal cameras: their numbers, what a message says of them, and what they count as.

    ``camera`` is None if the model has no counterpart here; ``merged`` is empty for one camera.
    """

    numbers: list[int]
    text: str
    camera: Camera | None
    merged: str


def open_colmap(path: str) -> PoseDataset:
    """Read a model's folder, or a project with ``sparse/0`` and ``images``.

    Images lie in ``images``, in the project or beside the model. Images in several folders are one
    sequence a folder. Frames with an invalid pose or a missing image are left out and counted.
    Cameras of one model and size that differ by at most 1 % count as one, their median; ``chosen``
    says so. Of others, ``,camera=NUMBER`` chooses one, with those that are nearly equal to it; the
    images of the rest are left out and counted.

    Raises UsageError for another option, and SourceError if there is no model, a file is malformed
    or names an image elsewhere, the images have several cameras and none is chosen, or one without
    a counterpart here, or no frame has a pose.
    """
    place, options = path_options("colmap", path, ("camera",))
    root = Path(place)
    folder = _model_folder(root)
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    cameras = read_cameras(folder / f"cameras{suffix}")
    found = sorted(
        read_images(folder / f"images{suffix}"), key=lambda image: natural_key(Path(image.name))
    )
    images = _image_folder(root, folder)
    for image in found:
        name = PurePosixPath(image.name)
        if name.is_absolute() or ".." in name.parts:
            raise SourceError(
                f"{folder}: expected names of images below {images}, found {image.name!r}"
            )
    if missing := {image.camera for image in found} - cameras.keys():
        raise SourceError(f"{folder}: expected a camera {min(missing)} of an image, found none")
    present = [image for image in found if image.pose is not None]
    if len({image.camera for image in present}) > 1:
        present = [image for image in present if os.path.isfile(images / image.name)]  # noqa: PTH113
    groups = _groups(cameras, present or found)
    group = _choose(folder, place, groups, options.get("camera"))
    others = {number for each in groups if each is not group for number in each.numbers}
    frames = FrameList(root)
    for image in found:
        name = PurePosixPath(image.name)
        if image.camera in others:
            frames.skip("of another camera")
            continue
        sequence = str(name.parent) if name.parent.name else root.resolve().name
        where = f"{image.where}: {image.fault}" if image.fault else ""
        frames.add(sequence, name.stem, images / image.name, image.pose, where=where)
    dataset = frames.dataset(root.resolve().name)
    camera = group.camera or cameras[group.numbers[0]].camera()
    chosen = "; ".join(filter(None, [group.text if others else "", group.merged]))
    where = cameras[group.numbers[0]].where
    return replace(with_camera(dataset, where, camera), chosen=chosen)


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


def _groups(cameras: Mapping[int, Stated], images: Sequence[Image]) -> list[_Group]:
    """Return the cameras of the images in groups of nearly equal ones, the most images first."""
    counts = Counter(image.camera for image in images)
    folders: dict[int, dict[str, None]] = {}
    for image in images:
        folders.setdefault(image.camera, {})[str(PurePosixPath(image.name).parent)] = None
    kinds: dict[tuple[str, tuple[int, int]], list[int]] = {}
    for number in sorted(counts):
        kinds.setdefault((cameras[number].model, cameras[number].size), []).append(number)
    found = []
    for (model, (width, height)), numbers in kinds.items():
        each: list[tuple[Camera | None, list[int]]] = [(None, numbers)]
        read: dict[int, Camera] = {}
        if cameras[numbers[0]].usable:
            read = {number: cameras[number].camera() for number in numbers}
            each = [
                (camera, [numbers[index] for index in own])
                for camera, own in alike(list(read.values()), [counts[key] for key in numbers])
            ]
        for camera, own in each:
            count = sum(counts[number] for number in own)
            places = list(dict.fromkeys(place for number in own for place in folders[number]))
            text = (
                f"{_listed('camera', own)} ({model} {width}x{height}, {count} "
                f"image{'' if count == 1 else 's'} in {_listed('folder', places)})"
            )
            merged = _merged([read[number] for number in own]) if camera else ""
            found.append((count, _Group(own, text, camera, merged)))
    return [group for _, group in sorted(found, key=lambda entry: -entry[0])]


def _listed(what: str, items: Sequence[object]) -> str:
    """Return the first few of the items: ``cameras 1, 4, 7 and 295 more``."""
    more = f" and {len(items) - _FEW} more" if len(items) > _FEW else ""
    named = ", ".join(str(item) for item in items[:_FEW])
    return f"{what}{'' if len(items) == 1 else 's'} {named}{more}"


def _merged(cameras: Sequence[Camera]) -> str:
    """Say how several cameras count as one; return nothing for a single one."""
    if len(set(cameras)) == 1:
        return f"{len(cameras)} equal cameras count as one" if len(cameras) > 1 else ""
    focal_px = [camera.focal_px for camera in cameras]
    return (
        f"{len(cameras)} cameras count as one, the median of focal lengths "
        f"{min(focal_px):.1f} to {max(focal_px):.1f} px"
    )


def _choose(folder: Path, place: str, groups: Sequence[_Group], wanted: str | None) -> _Group:
    """Return the only group, or that with the camera ``wanted``; raises SourceError."""
    if not groups:
        raise SourceError(f"{folder}: expected images with a pose, found no image")
    texts = [group.text for group in groups[:_NAMED]]
    more = [f"{len(groups) - _NAMED} more"] if len(groups) > _NAMED else []
    listed = ", ".join([*texts, *more])
    if wanted is not None:
        for group in groups:
            if wanted in map(str, group.numbers):
                return group
        raise SourceError(f"{folder}: expected camera= to name one of {listed}, found {wanted!r}")
    if len(groups) > 1:
        raise SourceError(
            f"{folder}: expected images of one camera, within {MOST_SPREAD:.0%}, found {listed}; "
            f"choose one, e.g. colmap:{place},camera={groups[0].numbers[0]}, which leaves the "
            "images of the others out"
        )
    return groups[0]
