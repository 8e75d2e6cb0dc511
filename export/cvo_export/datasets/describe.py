"""Describe a data set as text: what was read, and which frames were skipped and why."""

from __future__ import annotations

import numpy as np

from cvo_edge.input.image_files import left_out_text
from cvo_export.datasets.base import PoseDataset, skipped_text
from cvo_export.datasets.sizes import image_sizes, sizes_text


def summary(dataset: PoseDataset) -> str:
    """Return one line with name, frames, sequences and skipped frames."""
    frames = _counted(len(dataset), "frame")
    sequences = _counted(len(dataset.sequence_names), "sequence")
    return f"{dataset.name:<11} {frames} in {sequences}; {skipped_text(dataset.skipped)}"


def describe(dataset: PoseDataset) -> list[str]:
    """Return the summary, image sizes, camera, extent of the positions and frames per sequence.

    Raises SourceError if the first image cannot be read.
    """
    height, width = dataset.read_image(0).shape[:2]
    sizes = image_sizes(dataset)
    mixed = f"; of several sizes: {sizes_text(sizes)}" if len(sizes) > 1 else ""
    camera = "not stated"
    if dataset.intrinsics is not None:
        numbers = dataset.intrinsics._asdict()
        camera = ", ".join(f"{name} {value:.1f}" for name, value in numbers.items()) + " px"
        if dataset.lens.distortion != "none":
            values = " ".join(f"{value:g}" for value in dataset.lens.coefficients)
            camera += f", distortion {dataset.lens.distortion.replace('_', '-')} {values}"
    position_m = dataset.poses[:, :3]
    extent = zip("xyz", position_m.min(axis=0), position_m.max(axis=0), strict=True)
    counts = np.bincount(dataset.sequence, minlength=len(dataset.sequence_names))
    return [
        summary(dataset),
        *([f"read        {dataset.chosen}"] if dataset.chosen else []),
        *([f"left out    {left_out_text(dataset.left_out)}"] if dataset.left_out else []),
        f"image       {width} x {height} px{mixed}",
        f"camera      {camera}",
        "positions   " + ", ".join(f"{axis} {a:.2f} .. {b:.2f}" for axis, a, b in extent) + " m",
        *(
            f"sequence    {name}: {count}"
            for name, count in zip(dataset.sequence_names, counts, strict=True)
        ),
    ]


def _counted(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"
