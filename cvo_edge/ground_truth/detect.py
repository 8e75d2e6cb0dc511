"""Find the poses in a file or folder of any format that can be told by its content.

===========================  ==============================================  =======================
content                      format                                          poses belong to frames
===========================  ==============================================  =======================
folder of ``*.pose.txt``     7-Scenes, 12-Scenes: ``T_world_camera`` (4, 4)  by name
folder of ``*.txt``          ScanNet: the same                               by name
eight columns                TUM                                             by stamp, within 0.02 s
columns with commas          EuRoC, moved from the body to the camera        by stamp, within 5 ms
twelve columns               KITTI, moved from camera 0 to the camera        by number
seven columns                RGB-D Scenes v2                                 by number
``images.bin``, image lines  COLMAP                                          by name
JSON with ``frames``         nerfstudio, instant-ngp (``transforms.json``)   by name
===========================  ==============================================  =======================

A folder may also be a recording of these data sets, in which the file has its usual name.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.input.image_files import frame_name
from cvo_edge.trajectories import colmap, euroc, kitti, transforms, tum
from cvo_edge.trajectories.poses import MATRIX_SUFFIX, read_pose_matrices, read_pose_matrix
from cvo_edge.trajectories.rgbd_scenes import read_rgbd_scenes
from cvo_edge.trajectories.tables import first_line, read_text
from cvo_edge.trajectories.trajectory import Entry, Trajectory, trajectory_of

Array = NDArray[np.float64]

FORMATS = (
    f"a folder of *{MATRIX_SUFFIX}, or poses of TUM (8 columns), KITTI (12 columns), EuRoC "
    "(data.csv), RGB-D Scenes (7 columns), COLMAP (images.txt, images.bin) or transforms.json"
)
_BAGS = (".bag", ".mcap", ".db3")


@dataclass(frozen=True)
class Found:
    """Poses, what they belong to frames by, and the largest difference of stamps.

    ``note`` says how the poses were moved to the camera, if they were.
    """

    trajectory: Trajectory[Any]
    by: Literal["stamp", "number", "name"]
    bound_ns: int = 0
    note: str = ""


def find_trajectory(path: Path, frames: Path) -> Found:
    """Read the poses at ``path``, of the camera whose frames are in the folder ``frames``.

    Raises SourceError if the format is not one of those above, a file is malformed, what leads to
    the camera is missing, or no pose is valid.
    """
    if path.is_dir():
        for suffix in (MATRIX_SUFFIX, ".txt"):
            first = min(path.glob("*" + suffix), default=None)
            if first and (suffix == MATRIX_SUFFIX or read_pose_matrix(first) is not None):
                return Found(read_pose_matrices(path, suffix), "name")
        file = _file_in(path)
        if file is None:
            raise SourceError(f"{path}: expected {FORMATS}, found none of them")
        path = file
    elif not path.exists():
        raise SourceError(f"{path}: no such file; expected {FORMATS}")
    return _read_file(path, frames)


def _file_in(folder: Path) -> Path | None:
    """Return the file of poses in a recording's folder, or None."""
    if (folder / "metadata.yaml").is_file():
        raise _bag(folder)
    model = colmap.model_folder(folder)
    places = [
        folder / "groundtruth.txt",
        folder / "mav0/state_groundtruth_estimate0/data.csv",
        folder / "state_groundtruth_estimate0/data.csv",
        folder / "data.csv",
        *([kitti.pose_file(folder)] if (folder / kitti.CALIBRATION).is_file() else []),
        *([model / "images.bin", model / "images.txt"] if model else []),
        folder / transforms.FILE,
        folder.parent.parent / "pc" / f"{folder.name.removeprefix('scene_')}.pose",
    ]
    return next((place for place in places if place.is_file()), None)


def _read_file(path: Path, frames: Path) -> Found:
    if path.suffix in _BAGS:
        raise _bag(path)
    # The lines of keypoints make this file longer than those of other formats may be.
    if path.suffix == ".bin" or path.name == "images.txt":
        return Found(_colmap(path, frames), "name")
    number, line = first_line(read_text(path, FORMATS))
    if line.startswith("{"):
        entries = transforms.frame_poses(path, transforms.read_document(path))
        return Found(_named(path, entries, frames), "name")
    if "," in line:
        T_body_camera, note = _body_camera(path, frames)
        trajectory = euroc.read_euroc(path, T_body_camera)
        return Found(trajectory, "stamp", euroc.MAX_STAMP_DIFFERENCE_NS, note)
    fields = line.split()
    if len(fields) == len(tum.FORM.split()):
        return Found(tum.read_tum(path), "stamp", tum.MAX_STAMP_DIFFERENCE_NS)
    if len(fields) == len(kitti.FORM.split()):
        T_camera0_camera, note = _camera0_camera(path, frames)
        return Found(kitti.read_kitti(path, T_camera0_camera), "number", note=note)
    if len(fields) == 7:
        return Found(read_rgbd_scenes(path), "number")
    if len(fields) > 9 and fields[0].isdecimal() and fields[8].isdecimal():
        return Found(_colmap(path, frames), "name")
    found = f"found {line[:80]!r} in line {number}" if line else "found no line"
    raise SourceError(f"{path}: expected {FORMATS}, {found}")


def _colmap(path: Path, frames: Path) -> Trajectory[str]:
    images = colmap.read_images(path)
    entries = [Entry(image.name, image.pose, image.where, image.fault) for image in images]
    return _named(path, entries, frames)


def _named(path: Path, entries: Iterable[Entry[str]], frames: Path) -> Trajectory[str]:
    """Return poses by the names of image files; of several folders, that of the frames counts."""
    listed = [(PurePosixPath(entry.key), entry) for entry in entries]
    same = [(place, entry) for place, entry in listed if place.parent.name == frames.name]
    seen: dict[str, PurePosixPath] = {}
    named = []
    for place, entry in same or listed:
        name = frame_name(place.name)
        if seen.setdefault(name, place) != place:
            raise SourceError(
                f"{path}: expected one image of each name, found {seen[name]} and {place}; run on "
                "one of the folders"
            )
        named.append(entry._replace(key=name))
    return trajectory_of(path, named)


def _body_camera(path: Path, frames: Path) -> tuple[Array, str]:
    camera = next((part for part in (frames.parent.name, frames.name) if part[:3] == "cam"), "cam0")
    sensor = path.absolute().parent.parent / camera / "sensor.yaml"
    if not sensor.is_file():
        raise SourceError(
            f"{path}: expected {sensor} with T_BS, which leads from the body, whose poses these "
            "are, to the camera, found none; or write frames with their poses by `cvo-export "
            "render`"
        )
    return euroc.read_body_camera(sensor), f"moved from the body to {camera}"


def _camera0_camera(path: Path, frames: Path) -> tuple[Array, str]:
    found = re.fullmatch("image_([0-9])", frames.name)
    if found is None or found[1] == "0":
        return np.eye(4), ""
    calibration = frames.parent / kitti.CALIBRATION
    if not calibration.is_file():
        raise SourceError(
            f"{path}: expected {calibration}, which leads from camera 0, whose poses these are, to "
            f"{frames.name}, found none"
        )
    return kitti.read_calibration(calibration, int(found[1]))[1], f"moved to camera {found[1]}"


def _bag(path: Path) -> SourceError:
    return SourceError(
        f"{path}: expected {FORMATS}, found a ROS bag, which the runtime does not read; write its "
        f"frames and poses with `cvo-export render rosbag:{path} FOLDER`"
    )
