"""How exact ``reconstruct`` is, and how long it takes.

    python bench/reconstruct.py trajectory DATASET [--frames 100 300] [--json FILE]
    python bench/reconstruct.py tag [--json FILE]
    python bench/reconstruct.py trained EVALUATION... [--json FILE]

``trajectory`` reconstructs the images of a data set without their poses and compares positions
after the best similarity: with the data set's intrinsics for each number of images, and for the
first number also by the incremental mapper and with estimated intrinsics. ``apart_cm`` is the
median distance between the map and the first one on the images of both: it does not depend on the
data set's poses. ``tag`` reconstructs the synthetic room with a tag of 0.2 m: the error of the
scale. ``trained`` collects what ``cvo-export evaluate --json`` wrote of bundles that were trained
on a reconstruction.
"""

from __future__ import annotations

import argparse
import json
import os
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
from cvo_export.reconstruct.model import Model, read_model
from cvo_export.reconstruct.recordings import frame_of
from cvo_export.reconstruct.run import Options, reconstruct
from cvo_export.reconstruct.similarity import between_points

Array = NDArray[np.float64]

ROOM, EVERY, TAG_M = "synthetic:room,flights=1,frames=300,size=640x480,tag=0.2", 6, 0.2
# Most images are then a frame or two apart, so that the number of images decides.
STEP = 0.01
CONFIDENCE = 0.9


def measured(
    folders: list[str], truth: dict[tuple[str, int], Array], options: Options
) -> tuple[dict[str, Any], Model]:
    """Reconstruct once; ``truth`` has the position (3,) of each frame by recording and number."""
    with TemporaryDirectory() as work, show_progress() as progress:
        scene = Path(work) / "scene"
        load = os.getloadavg()[0]
        before, start = os.times(), perf_counter()
        report = reconstruct(folders, scene, options, progress)
        seconds, after = perf_counter() - start, os.times()
        model = read_model(scene / "sparse" / "0")
    true = np.array([truth[frame_of(name)] for name in model.names])
    found = between_points(model.poses[:, :3], true)
    error = 100 * np.linalg.norm(found.points(model.poses[:, :3]) - true, axis=1)
    figures = {
        "images": report.images,
        "registered": report.registered,
        "mapper": report.mapper,
        "points": report.points,
        "reprojection_px": report.error_px,
        "camera": report.camera,
        "median_error_cm": float(np.median(error)),
        "largest_error_cm": float(error.max()),
        "scale_error": found.scale - 1.0 if options.tag_size_m else None,
        "scale_spread": report.scale.spread,
        "seconds": seconds,
        "processor_seconds": sum(after[:4]) - sum(before[:4]),
        "cores": allowed_cores(),
        "load_average": [load, os.getloadavg()[0]],
    }
    # Positions in metres, to compare maps with one another.
    return figures, model._replace(poses=found.poses(model.poses))


def apart_cm(one: Model, two: Model) -> float:
    """Return the median distance of two maps after the best similarity, on their common images."""
    common = sorted(set(one.names) & set(two.names))
    ours, theirs = (
        np.array([model.poses[model.names.index(name), :3] for name in common])
        for model in (one, two)
    )
    off = between_points(ours, theirs).points(ours) - theirs
    return 100 * float(np.median(np.linalg.norm(off, axis=1)))


def written(
    dataset: PoseDataset, rows: range, folder: Path
) -> tuple[list[str], dict[tuple[str, int], Array]]:
    """Write images of a data set, a folder for each sequence; returns folders and true positions.

    The truth has the position (3,) of each frame by folder and number.
    """
    truth: dict[tuple[str, int], Array] = {}
    counts: dict[str, int] = {}
    for row in rows:
        name = dataset.sequence_names[dataset.sequence[row]].replace("/", "-")
        number = counts[name] = counts.get(name, -1) + 1
        path = folder / name / f"{number:06d}.png"
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), dataset.read_image(row), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        truth[name, number] = dataset.poses[row, :3]
    return [str(folder / name) for name in counts], truth


def intrinsics_of(dataset: PoseDataset) -> str:
    """Return what ``--intrinsics`` takes; raises SystemExit if the data set states no camera."""
    if dataset.intrinsics is None or dataset.lens.distortion == "equidistant":
        raise SystemExit(f"{dataset.name}: expected known intrinsics without a fisheye lens")
    return ",".join(map(str, (*dataset.intrinsics, *dataset.lens.coefficients)))


def trajectory(name: str, frames: list[int]) -> dict[str, Any]:
    """Measure a data set with each number of images, and other options with the first number."""
    dataset = open_dataset(name)
    known = intrinsics_of(dataset)
    found: dict[str, Any] = {}
    first: Model | None = None
    with TemporaryDirectory() as work:
        folders, truth = written(dataset, range(len(dataset)), Path(work))
        runs = {
            f"{most} images": Options(intrinsics=known, step=STEP, most=most) for most in frames
        }
        small = runs[f"{frames[0]} images"]
        runs["incremental mapper"] = Options(
            intrinsics=known, step=STEP, most=small.most, mappers=("incremental",)
        )
        runs["estimated intrinsics"] = Options(step=STEP, most=small.most)
        for what, options in runs.items():
            found[what], model = measured(folders, truth, options)
            first = first or model
            found[what]["apart_cm"] = apart_cm(model, first)
    return found


def tag() -> dict[str, Any]:
    """Measure the scale that a tag in the synthetic room gives, with known and own intrinsics."""
    room = open_dataset(ROOM)
    with TemporaryDirectory() as work:
        folders, truth = written(room, range(0, len(room), EVERY), Path(work))
        return {
            what: measured(folders, truth, Options(intrinsics=given, tag_size_m=TAG_M))[0]
            for what, given in (
                ("known intrinsics", intrinsics_of(room)),
                ("estimated intrinsics", None),
            )
        }


def trained(files: list[str]) -> dict[str, Any]:
    """Return error and coverage of each evaluation, at 0.9."""
    found: dict[str, Any] = {}
    for file in files:
        content = json.loads(Path(file).read_text("utf-8"))
        kept = ("method", "split", "rule", "score", "frames", "n_calibration", "point_error")
        found[Path(file).stem] = {key: content[key] for key in kept} | {
            "levels": [level for level in content["levels"] if level["confidence"] == CONFIDENCE]
        }
    return found


def main() -> None:
    """Run the measurement that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["trajectory", "tag", "trained"])
    parser.add_argument("given", nargs="*")
    parser.add_argument("--frames", nargs="+", type=int, default=[100, 300])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    match arguments.what, arguments.given:
        case "tag", []:
            found = tag()
        case "trajectory", [dataset]:
            found = trajectory(dataset, arguments.frames)
        case "trained", [_, *_]:
            found = trained(arguments.given)
        case _:
            parser.error("expected one data set after trajectory, files after trained")
    for name, figures in found.items():
        print(name, *(f"{key} {value}" for key, value in figures.items()), sep="\n  ")
    if arguments.json is not None:
        write_result(arguments.json, found)


if __name__ == "__main__":
    main()
