"""ScanNet (Dai et al. 2017) as exported by its tool: ``color``, ``pose`` and ``intrinsic``.

``pose/N.txt`` is the 4x4 camera-to-world matrix of ``color/N.jpg`` in metres, for an OpenCV camera;
where tracking was lost it holds ``-inf``. ``intrinsic/intrinsic_color.txt`` is a 4x4 matrix for
colour images of full size. Depth images are not read.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cvo_edge.files import natural_key
from cvo_export.datasets.base import PoseDataset
from cvo_export.datasets.camera_matrices import centred, matrix_intrinsics, read_numbers
from cvo_export.datasets.folders import only_world
from cvo_export.datasets.frames import FrameList

_IMAGES, _POSES, _CAMERA = "color", "pose", "intrinsic/intrinsic_color.txt"


def open_scannet(path: str) -> PoseDataset:
    """Read one scan, a folder with ``color`` and ``pose``; it is one sequence.

    ``path`` may be a folder that contains a single scan: each scan has its own world frame, also
    if several show one room. Frames with a missing pose file or an invalid pose (lost tracking) are
    left out and counted. Intrinsics are set if ``intrinsic/intrinsic_color.txt`` exists.

    Raises SourceError if there are several scans, the intrinsics are malformed or not those of the
    images, or no frame has a pose.
    """
    root = Path(path)
    scan = root
    if not (root / _IMAGES).is_dir():
        found = [folder.parent for folder in root.glob(f"*/{_IMAGES}") if folder.is_dir()]
        scan = only_world(
            root, sorted(found, key=natural_key), f"scan with folders {_IMAGES} and {_POSES}"
        )
    frames = FrameList(scan)
    name = scan.resolve().name
    for image in frames.colour_images(scan / _IMAGES):
        frames.add_matrix(name, image.stem, image, scan / _POSES / f"{image.stem}.txt")
    dataset = frames.dataset(name)
    camera = scan / _CAMERA
    if not camera.is_file():
        return dataset
    numbers = read_numbers(camera, (16,), "the sixteen numbers of a 4x4 matrix")
    intrinsics = matrix_intrinsics(str(camera), numbers)
    return replace(dataset, intrinsics=centred(str(camera), intrinsics, dataset))
