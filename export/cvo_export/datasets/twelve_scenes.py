"""12-Scenes (Valentin et al. 2016): ``data/frame-NNNNNN.color.jpg`` with ``.pose.txt``.

A pose file contains the 4x4 camera-to-world matrix in metres, for an OpenCV camera; where tracking
was lost it holds ``-INF``. ``split.txt`` lists the recordings, one a line, as ``sequenceN
[frames=COUNT] [start=FIRST ; end=LAST]``; the first one is for tests. ``info.txt`` has lines
``key = value`` with size and intrinsics of the colour images. Depth images are not read.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from cvo_edge.camera import Camera
from cvo_edge.errors import SourceError
from cvo_edge.files import natural_key
from cvo_edge.input.image_files import frame_name
from cvo_edge.trajectories.poses import MATRIX_SUFFIX
from cvo_edge.trajectories.tables import read_text
from cvo_export.datasets.base import PoseDataset
from cvo_export.datasets.camera_matrices import matrix_intrinsics
from cvo_export.datasets.folders import only_world
from cvo_export.datasets.frames import FrameList
from cvo_export.datasets.sizes import with_camera

_INFO, _SPLIT = "info.txt", "split.txt"
_SPLIT_FORM = "sequenceN [frames=COUNT] [start=FIRST ; end=LAST]"
_SEQUENCE = re.compile(r"(sequence\d+)\s+\[frames=(\d+)\]\s+\[start=(\d+)\s*;\s*end=\d+\]")
_FRAME = re.compile(r"frame-(\d+)")
_MATRIX = "m_calibrationColorIntrinsic"


def open_twelve_scenes(path: str) -> PoseDataset:
    """Read one scene, e.g. ``apt1/kitchen``: a folder with ``data``, ``info.txt``, ``split.txt``.

    ``path`` may be a folder that contains a single scene. Frames with a missing pose file, an
    invalid pose (lost tracking) or in no sequence of ``split.txt`` are left out and counted.

    Raises SourceError if there are several scenes, a file is missing or malformed, or no frame has
    a pose.
    """
    root = Path(path)
    scene = root
    if not (root / _INFO).is_file():
        found = [file.parent for file in root.glob(f"*/{_INFO}")]
        scene = only_world(root, sorted(found, key=natural_key), f"scene with data and {_INFO}")
    sequences = _sequences(scene / _SPLIT)
    frames = FrameList(scene)
    for image in frames.colour_images(scene / "data"):
        name = frame_name(image.name)
        numbered = _FRAME.fullmatch(name)
        number = int(numbered[1]) if numbered else -1
        sequence = next((name for name, own in sequences.items() if number in own), None)
        if sequence is None:
            frames.skip(f"in no sequence of {_SPLIT}")
        else:
            frames.add_matrix(sequence, name, image, image.with_name(name + MATRIX_SUFFIX))
    dataset = frames.dataset(scene.resolve().name)
    test = next(iter(sequences))
    own_test = {index for index, name in enumerate(dataset.sequence_names) if name == test}
    info = scene / _INFO
    return replace(
        with_camera(dataset, str(info), _camera(info)),
        own_train=frozenset(range(len(dataset.sequence_names))) - own_test,
        own_test=frozenset(own_test),
    )


def _sequences(path: Path) -> dict[str, range]:
    """Return the numbers of each sequence's frames, in the order of the file."""
    found: dict[str, range] = {}
    for number, line in enumerate(read_text(path, _SPLIT_FORM).splitlines(), start=1):
        if not line.strip():
            continue
        parts = _SEQUENCE.fullmatch(line.strip())
        if parts is None or parts[1] in found:
            raise SourceError(
                f"{path}: expected {_SPLIT_FORM}, each sequence once, found {line[:80]!r} in line "
                f"{number}"
            )
        found[parts[1]] = range(int(parts[3]), int(parts[3]) + int(parts[2]))
    if not found:
        raise SourceError(f"{path}: expected lines {_SPLIT_FORM}, found none")
    return found


def _camera(path: Path) -> Camera:
    form = f"lines m_colorWidth, m_colorHeight and {_MATRIX} = 16 numbers"
    values = {
        key.strip(): value.split()
        for key, _, value in (line.partition("=") for line in read_text(path, form).splitlines())
    }
    try:
        (width,), (height,) = (map(int, values[f"m_color{each}"]) for each in ("Width", "Height"))
        numbers = [float(value) for value in values[_MATRIX]]
        if len(numbers) != 16 or min(width, height) < 1:
            raise ValueError
    except (KeyError, ValueError):
        found = {key: value for key, value in values.items() if "olor" in key}
        raise SourceError(f"{path}: expected {form}, found {str(found)[:160]}") from None
    intrinsics = matrix_intrinsics(str(path), numbers)
    return Camera(width=width, height=height, **intrinsics._asdict())
