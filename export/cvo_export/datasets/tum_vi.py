"""TUM-VI (Schubert et al. 2018), its layout for EuRoC and DSO: ``mav0`` and ``dso``.

``mav0/cam0/data.csv`` lists ``timestamp,filename`` of the images in ``mav0/cam0/data``, grey, 16
bits; ``cvo_edge.trajectories.tum_vi`` describes the poses. The motion capture system hangs in one
room: of recordings that leave it, only the start and the end have poses. The lens is a fisheye
(equidistant); its distortion is read, not corrected.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.trajectories.poses import matrix_to_pose
from cvo_edge.trajectories.tables import read_rows
from cvo_edge.trajectories.tum_vi import (
    CAMERA,
    MAX_STAMP_DIFFERENCE_NS,
    POSES,
    read_imu_camera,
    read_imu_track,
)
from cvo_export.datasets.base import PoseDataset
from cvo_export.datasets.folders import only_camera, recordings
from cvo_export.datasets.frames import FrameList
from cvo_export.datasets.yaml_cameras import Pinhole, pinhole, read_document

_IMAGES = "mav0/cam0/data.csv"
# Poses further apart belong to different visits of the room.
_GAP_NS = 1_000_000_000


def open_tum_vi(path: str) -> PoseDataset:
    """Read one recording (the folder that contains ``mav0``), or all recordings in a folder.

    Poses are interpolated to the images' stamps, because the cameras do not run with the motion
    capture system. Frames with no pose within 5 ms, an invalid pose or a missing image are left out
    and counted; ``chosen`` says which share of a recording has ground truth, and in how many parts,
    unless it has it throughout. All recordings share the frame of the motion capture system.

    Raises SourceError if a file is missing or malformed, recordings come from different cameras,
    or no frame has a pose.
    """
    root = Path(path)
    frames = FrameList(root)
    cameras: dict[str, Pinhole | None] = {}
    partial: list[str] = []
    for name, folder in recordings(root, _IMAGES).items():
        cameras[name], T_imu_camera = _read_camera(folder / CAMERA)
        partial += _add_recording(frames, name, folder, T_imu_camera)
    dataset = replace(frames.dataset(root.resolve().name), chosen="; ".join(partial))
    camera = only_camera(root, cameras)
    if camera is None:
        return dataset
    return camera.of(dataset, f"{root}: {CAMERA}")


def _add_recording(
    frames: FrameList, name: str, folder: Path, T_imu_camera: NDArray[np.float64]
) -> list[str]:
    """Add a recording; return what is to be said of a ground truth with gaps."""
    rows = sorted(
        (row.nanoseconds(), row.fields[1])
        for row in read_rows(folder / _IMAGES, "timestamp,filename", separator=",")
    )
    places = [folder / each for each in POSES]
    track, _ = read_imu_track(next(filter(Path.is_file, places), places[0]))
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in rows], np.int64)
    T_world_imu, near = track.at(stamps_ns, MAX_STAMP_DIFFERENCE_NS)
    images = (folder / _IMAGES).with_name("data")
    for (stamp_ns, file), T, found in zip(rows, T_world_imu @ T_imu_camera, near, strict=True):
        if found:
            image = images / file
            pose = matrix_to_pose(T)
            where = "" if pose is not None else f"the poses about {stamp_ns} ns"
            frames.add(name, image.stem, image, pose, stamp_ns, where)
        else:
            frames.skip(f"no pose within {MAX_STAMP_DIFFERENCE_NS / 1e9:g} s")
    if near.all():
        return []
    steps_ns = np.diff(track.stamps_ns)
    parts = 1 + int((steps_ns > _GAP_NS).sum())
    covered_s = steps_ns[steps_ns <= _GAP_NS].sum() / 1e9
    whole_s = (stamps_ns[-1] - stamps_ns[0]) / 1e9
    return [
        f"{name} has ground truth for {covered_s:.1f} of {whole_s:.1f} s, in {parts} "
        f"part{'' if parts == 1 else 's'}"
    ]


def _read_camera(path: Path) -> tuple[Pinhole | None, NDArray[np.float64]]:
    """Return the intrinsics with the lens of ``cam0``, and ``T_imu_camera``, (4, 4), metres."""
    T_imu_camera = read_imu_camera(path)
    camera = read_document(path, "cam0 with T_cam_imu").get("cam0")
    found = pinhole(path, camera, "distortion_coeffs") if isinstance(camera, dict) else None
    return found, T_imu_camera
