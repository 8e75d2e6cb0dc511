"""Read the camera matrices of text files, with or without the size of their images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cvo_edge.errors import SourceError
from cvo_edge.trajectories.tables import read_text
from cvo_export.datasets.base import Intrinsics, PoseDataset


def read_numbers(path: Path, counts: Sequence[int], what: str) -> list[float]:
    """Return all numbers of a file; raises SourceError if it has none of the counts, or text."""
    text = read_text(path, what)
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            np.array(line.split(), dtype=np.float64)
        except ValueError:
            raise SourceError(
                f"{path}: expected {what}, found {line.strip()[:80]!r} in line {number}"
            ) from None
    values = [float(word) for word in text.split()]
    if len(values) not in counts:
        raise SourceError(f"{path}: expected {what}, found {len(values)} numbers")
    return values


def matrix_intrinsics(where: str, values: Sequence[float]) -> Intrinsics:
    """Return the camera of the 9 or 16 numbers of a 3x3 or 4x4 matrix, row by row.

    Raises SourceError, which begins with ``where``, for numbers that are no camera.
    """
    K = np.reshape(values, (4, 4) if len(values) == 16 else (3, 3))
    found = Intrinsics(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    if not (found.possible and K[1, 0] == 0.0 and (K[2, :3] == [0.0, 0.0, 1.0]).all()):
        raise SourceError(
            f"{where}: expected a matrix of finite intrinsics with positive focal lengths, found "
            f"{K.tolist()}"
        )
    return found


def centred(where: str, intrinsics: Intrinsics, dataset: PoseDataset) -> Intrinsics:
    """Return the intrinsics if the principal point is near the middle of the images.

    A file without the size of its images may be of images that somebody has resized since.

    Raises SourceError, which begins with ``where``, if the point is further than a tenth of the
    image's width or height from the middle, or if the first image cannot be read.
    """
    height, width = dataset.read_image(0).shape[:2]
    if max(abs(intrinsics.cx / width - 0.5), abs(intrinsics.cy / height - 0.5)) > 0.1:
        raise SourceError(
            f"{where}: expected the principal point near the middle of images of "
            f"{width}x{height}, found {intrinsics.cx:g} {intrinsics.cy:g}; if the images were "
            "resized, scale the matrix as well"
        )
    return intrinsics
