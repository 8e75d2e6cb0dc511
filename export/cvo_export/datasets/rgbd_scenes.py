"""RGB-D Scenes v2 (Lai et al. 2014): ``imgs/scene_NN/NNNNN-color.png`` with ``pc/NN.pose``.

Poses are read as ``cvo_edge.trajectories.rgbd_scenes`` describes. Each scene has its own world
frame, so a data set is one scene. Depth images are not read.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cvo_edge.files import natural_key
from cvo_edge.trajectories.rgbd_scenes import read_rgbd_scenes
from cvo_export.datasets.base import Intrinsics, PoseDataset
from cvo_export.datasets.folders import only_world
from cvo_export.datasets.frames import FrameList

_COLOUR = "-color.png"

# The authors use these intrinsics to convert depth images to points, at 640x480.
_NOMINAL, _NOMINAL_WIDTH = Intrinsics(570.3, 570.3, 320.0, 240.0), 640


def open_rgbd_scenes(path: str) -> PoseDataset:
    """Read one scene, ``ROOT/imgs/scene_NN``, with its poses in ``ROOT/pc/NN.pose``.

    ``path`` may be ``ROOT`` if it contains a single scene. Frames with a missing image, a missing
    pose or an invalid pose are left out and counted. The intrinsics are the authors' nominal ones,
    scaled to the images' width.

    Raises SourceError if there are several scenes, a line of the pose file is malformed, or no
    frame has a pose.
    """
    root = Path(path).absolute()
    folder = root
    if not any(root.glob("*" + _COLOUR)):
        found = {file.parent for file in root.glob(f"imgs/scene_*/*{_COLOUR}")}
        folder = only_world(root, sorted(found, key=natural_key), "scene imgs/scene_NN")
    frames = FrameList(folder)
    images = {
        int(file.name.removesuffix(_COLOUR)): file
        for file in frames.colour_images(folder)
        if file.name.removesuffix(_COLOUR).isdecimal()
    }
    pose_file = folder.parent.parent / "pc" / f"{folder.name.removeprefix('scene_')}.pose"
    frames.add_numbered(folder.name, images, read_rgbd_scenes(pose_file))
    dataset = frames.dataset(folder.name)
    width = dataset.read_image(0).shape[1]
    return replace(dataset, intrinsics=_NOMINAL.scaled(width / _NOMINAL_WIDTH))
