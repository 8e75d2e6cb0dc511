"""Find the poses in a file or folder of any format that can be told by its content.

===========================  ==============================================  =======================
content                      format                                          poses belong to frames
===========================  ==============================================  =======================
folder of ``*.pose.txt``     7-Scenes, 12-Scenes: ``T_world_camera`` (4, 4)  by name
folder of ``*.txt``          ScanNet: the same                               by name
folder with ``calibration``  ACE: the same, of ``rgb`` in the sorted order   by name
eight columns                TUM                                             by stamp, within 0.02 s
columns with commas          EuRoC, moved from the body to the camera        by stamp, within 5 ms
``mocap0``, ``gt_imu.csv``   TUM-VI, moved from the IMU to the camera        by stamp, interpolated
twelve columns               KITTI, moved from camera 0 to the camera        by number
seven columns                RGB-D Scenes v2                                 by number
``images.bin``, image lines  COLMAP                                          by name
JSON with ``frames``         nerfstudio, instant-ngp (``transforms.json``)   by name
``.bag``, ``.mcap``...       ROS bags, with the options of training          by stamp, interpolated
===========================  ==============================================  =======================

Of interpolated poses, the nearest is within 5 ms (TUM-VI) or 0.02 s (bags). A folder may also be a
recording of these data sets, in which the file has its usual name.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.ground_truth.bags import bag_options, find_bag_poses
from cvo_edge.ground_truth.found import Found, by_key, by_nearest_stamp, interpolated
from cvo_edge.input.image_files import frame_name
from cvo_edge.trajectories import ace, colmap, euroc, kitti, transforms, tum, tum_vi
from cvo_edge.trajectories.bag import is_bag
from cvo_edge.trajectories.interpolation import Mask, Stamps
from cvo_edge.trajectories.poses import (
    MATRIX_SUFFIX,
    matrix_entry,
    read_pose_matrices,
    read_pose_matrix,
)
from cvo_edge.trajectories.rgbd_scenes import read_rgbd_scenes
from cvo_edge.trajectories.tables import first_line, read_text
from cvo_edge.trajectories.trajectory import Entry, Trajectory, trajectory_of

Array = NDArray[np.float64]

FORMATS = (
    f"a folder of *{MATRIX_SUFFIX}, or poses of TUM (8 columns), KITTI (12 columns), EuRoC "
    "(data.csv), TUM-VI (mocap0, gt_imu.csv), ACE (rgb, poses, calibration), RGB-D Scenes (7 "
    "columns), COLMAP (images.txt, images.bin), transforms.json or a ROS bag (.bag, .mcap, .db3)"
)


def find_poses(given: str, frames: Path) -> Found:
    """Read the poses that ``given`` names, of the camera whose frames are in the folder ``frames``.

    Raises SourceError if the format is not one of those above, a file is malformed, what leads to
    the camera is missing, or no pose is valid; UsageError as ``find_bag_poses`` does.
    """
    if (bag := bag_options(given)) is not None:
        return find_bag_poses(*bag)
    path = Path(given)
    if path.is_dir():
        if (part := ace.part_of(path, frames)) is not None:
            return by_key("name", _ace(part))
        for suffix in (MATRIX_SUFFIX, ".txt"):
            first = min(path.glob("*" + suffix), default=None)
            if first and (suffix == MATRIX_SUFFIX or read_pose_matrix(first) is not None):
                return by_key("name", read_pose_matrices(path, suffix))
        file = _file_in(path)
        if file is None and any(is_bag(each) for each in path.iterdir()):
            return find_bag_poses(path, {})
        if file is None:
            raise SourceError(f"{path}: expected {FORMATS}, found none of them")
        path = file
    elif not path.exists():
        raise SourceError(f"{path}: no such file; expected {FORMATS}")
    return _read_file(path, frames)


def _file_in(folder: Path) -> Path | None:
    """Return the file of poses in a recording's folder, or None."""
    model = colmap.model_folder(folder)
    places = [
        folder / "groundtruth.txt",
        folder / "mav0/state_groundtruth_estimate0/data.csv",
        folder / "state_groundtruth_estimate0/data.csv",
        *(folder / place for place in tum_vi.POSES),
        folder / "mocap0/data.csv",
        folder / "gt_imu.csv",
        folder / "data.csv",
        *([kitti.pose_file(folder)] if (folder / kitti.CALIBRATION).is_file() else []),
        *([model / "images.bin", model / "images.txt"] if model else []),
        folder / transforms.FILE,
        folder.parent.parent / "pc" / f"{folder.name.removeprefix('scene_')}.pose",
    ]
    return next((place for place in places if place.is_file()), None)


def _read_file(path: Path, frames: Path) -> Found:
    # The lines of keypoints make this file longer than those of other formats may be.
    if path.suffix == ".bin" or path.name == "images.txt":
        return by_key("name", _colmap(path, frames))
    number, line = first_line(read_text(path, FORMATS))
    if line.startswith("{"):
        entries = transforms.frame_poses(path, transforms.read_document(path))
        return by_key("name", _named(path, entries, frames))
    if "," in line:
        if path.name == "gt_imu.csv" or path.absolute().parent.name == "mocap0":
            return _tum_vi(path, frames)
        T_body_camera, note = _body_camera(path, frames)
        trajectory = euroc.read_euroc(path, T_body_camera)
        return by_nearest_stamp(trajectory, euroc.MAX_STAMP_DIFFERENCE_NS, note)
    fields = line.split()
    if len(fields) == len(tum.FORM.split()):
        return by_nearest_stamp(tum.read_tum(path), tum.MAX_STAMP_DIFFERENCE_NS)
    if len(fields) == len(kitti.FORM.split()):
        T_camera0_camera, note = _camera0_camera(path, frames)
        return by_key("number", kitti.read_kitti(path, T_camera0_camera), note)
    if len(fields) == 7:
        return by_key("number", read_rgbd_scenes(path))
    if len(fields) > 9 and fields[0].isdecimal() and fields[8].isdecimal():
        return by_key("name", _colmap(path, frames))
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


def _ace(part: Path) -> Trajectory[str]:
    entries = [matrix_entry(frame_name(image.name), pose) for image, pose, _ in ace.together(part)]
    return trajectory_of(part, entries)


def _tum_vi(path: Path, frames: Path) -> Found:
    camera = _camera_of(frames, "cam[0-9]+")
    folder = path.absolute().parent
    recording = folder.parent if path.name == "gt_imu.csv" else folder.parent.parent
    chain = recording / tum_vi.CAMERA
    if not chain.is_file():
        raise SourceError(
            f"{path}: expected {chain} with T_cam_imu, which leads from the IMU, whose poses these "
            "are, to the camera, found none"
        )
    track, skipped = tum_vi.read_imu_track(path)
    T_imu_camera = tum_vi.read_imu_camera(chain, camera)

    def at(stamps_ns: Stamps) -> tuple[Array, Mask]:
        T_world_imu, near = track.at(stamps_ns, tum_vi.MAX_STAMP_DIFFERENCE_NS)
        return T_world_imu @ T_imu_camera, near

    first_ns, last_ns = track.stamps_ns[[0, -1]].tolist()
    return interpolated(at, first_ns, last_ns, skipped, f"moved from the IMU to {camera}")


def _camera_of(frames: Path, pattern: str) -> str:
    """Return the camera of the ASL layout whose frames, or whose folder ``data``, these are."""
    names = (frames.parent.name, frames.name)
    return next((name for name in names if re.fullmatch(pattern, name)), "cam0")


def _body_camera(path: Path, frames: Path) -> tuple[Array, str]:
    camera = _camera_of(frames, "cam.*")
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
