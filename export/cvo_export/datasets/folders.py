"""Find the recordings under a path, and the camera that they share."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from cvo_edge.errors import SourceError
from cvo_edge.files import natural_key

Camera = TypeVar("Camera")


def recordings(root: Path, marker: str) -> dict[str, Path]:
    """Return ``root`` if it contains ``marker``, otherwise all its folders that do, by name.

    Folders are in natural order and become sequences of one data set, so their recordings must
    share a world frame. Raises SourceError if there is no such folder.
    """
    if (root / marker).is_file():
        return {root.resolve().name: root}
    folders = [file.parents[marker.count("/")] for file in root.glob(f"*/{marker}")]
    found = {folder.name: folder for folder in sorted(folders, key=natural_key)}
    if not found:
        raise SourceError(f"{root}: expected {marker}, or folders that contain it, found neither")
    return found


def only_world(root: Path, folders: list[Path], kind: str) -> Path:
    """Return the only folder, for data in which each folder has its own world frame.

    Raises SourceError if there is no folder, or more than one; the message names them.
    """
    if not folders:
        raise SourceError(f"{root}: expected a {kind}, found none")
    if len(folders) > 1:
        names = ", ".join(folder.name for folder in folders)
        raise SourceError(
            f"{root}: expected one {kind}, because each has its own world frame, found {names}; "
            f"choose one, e.g. {folders[0]}"
        )
    return folders[0]


def only_camera(root: Path, cameras: Mapping[str, Camera | None]) -> Camera | None:
    """Return the camera of all sequences; raises SourceError if they have different cameras."""
    (first, camera), *others = cameras.items()
    for name, other in others:
        if other != camera:
            raise SourceError(
                f"{root}: expected sequences from one camera, found different cameras in {first} "
                f"and {name}"
            )
    return camera
