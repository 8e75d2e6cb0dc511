"""nerfstudio and instant-ngp: ``transform_matrix`` of the frames in ``transforms.json``.

The 4x4 camera-to-world matrix of an OpenGL camera (x right, y up, z backward), converted here to an
OpenCV camera. Its units are metres only if its author scaled it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from cvo_edge.errors import SourceError
from cvo_edge.trajectories.poses import matrix_fault, matrix_to_pose
from cvo_edge.trajectories.tables import read_text
from cvo_edge.trajectories.trajectory import Entry

FILE = "transforms.json"
_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


def read_document(file: Path) -> dict[str, Any]:
    """Read the file; raises SourceError if it is no JSON with a list ``frames``."""
    try:
        document = json.loads(read_text(file, "frames with file_path and transform_matrix"))
    except (ValueError, RecursionError) as error:
        raise SourceError(f"{file}: expected JSON, found {error}") from None
    if not (isinstance(document, dict) and isinstance(document.get("frames"), list)):
        raise SourceError(f"{file}: expected a list frames, found none")
    return document


def frame_poses(file: Path, document: dict[str, Any]) -> list[Entry[str]]:
    """Return the frames by ``file_path``, in the file's order; raises SourceError."""
    entries = []
    for number, frame in enumerate(document["frames"]):
        name = frame.get("file_path") if isinstance(frame, dict) else None
        if not (isinstance(name, str) and "transform_matrix" in frame):
            raise SourceError(
                f"{file}: expected file_path and transform_matrix in frame {number}, found "
                f"{str(frame)[:80]}"
            )
        entries.append(_entry(name, frame["transform_matrix"], f"{file.name}, frame {number}"))
    return entries


def _entry(name: str, matrix: object, where: str) -> Entry[str]:
    try:
        T = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        T = np.empty(0)
    if T.shape == (3, 4):
        T = np.vstack([T, [0.0, 0.0, 0.0, 1.0]])
    if T.shape != (4, 4):
        return Entry(name, None, where, "a matrix that is not 4x4")
    fault = matrix_fault(T)
    return Entry(name, None if fault else matrix_to_pose(T @ _AXES), where, fault)
