"""How exact ``reconstruct`` is, and how long it takes.

    python bench/reconstruct.py redkitchen FOLDER [--frames 100 300] [--json FILE]
    python bench/reconstruct.py tag [--json FILE]

``redkitchen`` reconstructs the images of a 7-Scenes folder without their poses, with its intrinsics
of 585 pixels, by each mapper: registered share, error of the positions after the best similarity,
seconds. ``tag`` reconstructs the synthetic room with a tag of 0.2 m: the error of the scale.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from provenance import write_result

from cvo_edge.engine.cores import allowed_cores
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.progress import show_progress
from cvo_export.reconstruct.mapping import Mapper
from cvo_export.reconstruct.model import read_model
from cvo_export.reconstruct.recordings import frame_of
from cvo_export.reconstruct.run import Options, reconstruct
from cvo_export.reconstruct.similarity import between_points

KITCHEN = "585,585,319.5,239.5"
ROOM, EVERY, TAG_M = "synthetic:room,flights=1,frames=300,size=640x480,tag=0.2", 6, 0.2


def measured(
    folders: list[str], truth: dict[tuple[str, int], NDArray[np.float64]], options: Options
) -> dict[str, Any]:
    """Reconstruct once; ``truth`` has the position (3,) of each frame by recording and number."""
    with TemporaryDirectory() as work, show_progress() as progress:
        scene = Path(work) / "scene"
        start = perf_counter()
        report = reconstruct(folders, scene, options, progress)
        seconds = perf_counter() - start
        model = read_model(scene / "sparse" / "0")
    true = np.array([truth[frame_of(name)] for name in model.names])
    found = between_points(model.poses[:, :3], true)
    error = 100 * np.linalg.norm(found.points(model.poses[:, :3]) - true, axis=1)
    return {
        "images": report.images,
        "registered": report.registered,
        "mapper": report.mapper,
        "points": report.points,
        "reprojection_px": report.error_px,
        "median_error_cm": float(np.median(error)),
        "largest_error_cm": float(error.max()),
        "scale_error": found.scale - 1.0 if options.tag_size_m else None,
        "seconds": seconds,
        "cores": allowed_cores(),
    }


def positions(dataset: PoseDataset) -> dict[tuple[str, int], NDArray[np.float64]]:
    """Return the position of each frame by sequence and number in its name."""
    found = {}
    for name, pose in zip(dataset.frame_names, dataset.poses, strict=True):
        sequence, frame = name.split("/")
        found[sequence, int(frame.rpartition("-")[2])] = pose[:3]
    return found


def kitchen(folder: Path, frames: list[int]) -> dict[str, Any]:
    """Measure redkitchen with each number of images and each mapper."""
    truth = positions(open_dataset(f"7scenes:{folder}"))
    folders = [str(folder / name) for name in sorted({sequence for sequence, _ in truth})]
    mappers: tuple[Mapper, ...] = ("global", "incremental")
    return {
        f"{mapper}, {most} images": measured(
            folders, truth, Options(intrinsics=KITCHEN, step=0.01, most=most, mappers=(mapper,))
        )
        for most in frames
        for mapper in mappers
    }


def tag() -> dict[str, Any]:
    """Measure the scale that a tag in the synthetic room gives, with known and own intrinsics."""
    room = open_dataset(ROOM)
    rows = range(0, len(room), EVERY)
    truth = {("room", number): room.poses[row, :3] for number, row in enumerate(rows)}
    known = ",".join(map(str, room.intrinsics or ()))
    with TemporaryDirectory() as work:
        folder = Path(work) / "room"
        folder.mkdir()
        for number, row in enumerate(rows):
            cv2.imwrite(str(folder / f"{number:06d}.png"), room.read_image(row))
        return {
            name: measured([str(folder)], truth, Options(intrinsics=given, tag_size_m=TAG_M))
            for name, given in (("known intrinsics", known), ("estimated intrinsics", None))
        }


def main() -> None:
    """Run the measurement that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["redkitchen", "tag"])
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--frames", nargs="+", type=int, default=[100, 300])
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    if given.what == "redkitchen" and given.folder is None:
        parser.error("redkitchen needs its folder")
    found = tag() if given.what == "tag" else kitchen(given.folder, given.frames)
    for name, figures in found.items():
        print(name, *(f"{key} {value}" for key, value in figures.items()), sep="\n  ")
    if given.json is not None:
        write_result(given.json, found)


if __name__ == "__main__":
    main()
