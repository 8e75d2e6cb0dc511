"""Which folders under a path are recordings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cvo_edge.errors import SourceError
from cvo_edge.input.image_files import natural_key
from cvo_export.datasets.base import Intrinsics


def recordings(root: Path, marker: str) -> dict[str, Path]:
    """``root`` where it holds the file ``marker``, else its folders that do, in natural order.

    By name. They become sequences of one data set: it is for data whose recordings share a world
    frame. Raises SourceError where there is none.
    """
    if (root / marker).is_file():
        return {root.resolve().name: root}
    folders = [file.parents[marker.count("/")] for file in root.glob(f"*/{marker}")]
    found = {folder.name: folder for folder in sorted(folders, key=natural_key)}
    if not found:
        raise SourceError(f"{root}: expected {marker}, or folders that hold it, found neither")
    return found


def only_world(root: Path, folders: list[Path], kind: str) -> Path:
    """Return the one folder of data whose folders have a world frame each.

    Raises SourceError where there are several, naming them, or none.
    """
    if not folders:
        raise SourceError(f"{root}: expected a {kind}, found none")
    if len(folders) > 1:
        names = ", ".join(folder.name for folder in folders)
        raise SourceError(
            f"{root}: expected one {kind}, as each has a world frame of its own, found {names}; "
            f"choose one, e.g. {folders[0]}"
        )
    return folders[0]


def only_camera(root: Path, cameras: Mapping[str, Intrinsics | None]) -> Intrinsics | None:
    """Return the camera of all sequences, by name; raises SourceError where they have several."""
    (first, camera), *others = cameras.items()
    for name, other in others:
        if other != camera:
            raise SourceError(
                f"{root}: expected sequences of one camera, found {first} and {name} of two"
            )
    return camera
