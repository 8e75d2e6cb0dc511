"""DSAC* and ACE (Brachmann et al. 2021, 2023): folders ``train`` and ``test``, one file an item.

In each, ``rgb``, ``poses`` and ``calibration`` hold one file a frame, in the same sorted order. A
pose is the 4x4 camera-to-world matrix in metres, for an OpenCV camera.
"""

from __future__ import annotations

import re
from pathlib import Path

from cvo_edge.errors import SourceError
from cvo_edge.files import natural_key

PARTS = ("train", "test")
KINDS = ("rgb", "poses", "calibration")


def part_of(path: Path, frames: Path) -> Path | None:
    """Return the part at ``path``, or None if there is none.

    ``path`` is a part, its folder ``poses``, or a scene; of a scene, it is the part that the
    images in the folder ``frames`` are of, or the only one. Raises SourceError if neither is so.
    """
    place = path.absolute()
    if place.name == KINDS[1] and _is_part(place.parent):
        return place.parent
    parts = [each for each in (path, *(path / part for part in PARTS)) if _is_part(each)]
    own = [part for part in parts if (part / KINDS[0]).resolve() == frames.resolve()]
    if not own and len(parts) > 1:
        raise SourceError(
            f"{path}: expected the frames of {parts[0] / KINDS[0]} or {parts[1] / KINDS[0]}, found "
            f"those of {frames}; name one of the folders, e.g. {parts[-1]}"
        )
    return next(iter(own or parts), None)


def _is_part(folder: Path) -> bool:
    return all((folder / kind).is_dir() for kind in KINDS)


def together(folder: Path) -> list[tuple[Path, Path, Path]]:
    """Return image, pose and calibration of each frame, in natural order of the images.

    Raises SourceError if a folder is missing, or its files are not those of the other folders'
    frames.
    """
    found = [_files(folder / kind) for kind in KINDS]
    images, *others = found
    for kind, files in zip(KINDS[1:], others, strict=True):
        if len(files) != len(images):
            raise SourceError(
                f"{folder}: expected as many files in {kind} as in rgb, found {len(files)} and "
                f"{len(images)}; delete what is left over of incomplete frames"
            )
        numbers = {_numbers(file) for file in files}
        for image, file in zip(images, files, strict=True):
            # Names may differ in everything, but not if the number stands at another place.
            if _numbers(image) != _numbers(file) and _numbers(image) in numbers:
                raise SourceError(
                    f"{folder}: expected files of one frame at the same place of the sorted names, "
                    f"found rgb/{image.name} and {kind}/{file.name}; delete incomplete frames"
                )
    return sorted(zip(*found, strict=True), key=lambda files: natural_key(files[0]))


def _files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise SourceError(f"{folder}: expected a folder with one file a frame, found none")
    return sorted(file for file in folder.iterdir() if not file.name.startswith("."))


def _numbers(file: Path) -> tuple[str, ...]:
    return tuple(re.findall(r"\d+", file.name.partition(".")[0]))
