"""Write test frames: flights used neither to train nor to calibrate the demonstration bundles."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import SplitSpec
from cvo_export.data.splits import same_split
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.datasets.seven_scenes import write_sequence

# The data set on which calibration_artifacts/README.md trains and calibrates.
DATASET = "synthetic:room,flights=100"


def write_test_frames(folder: Path, recorded: SplitSpec, per_flight: int) -> int:
    """Write images and poses of the split's test flights and return the number of frames.

    Writes ``per_flight`` frames of each flight, evenly spaced in time, as JPEG and .pose.txt files.
    Keeps an existing folder. Raises SourceError if the split does not belong to ``DATASET``.
    """
    dataset = open_dataset(DATASET)
    chosen = evenly(dataset, same_split(dataset, recorded).roles["test"], per_flight)
    if not folder.is_dir():
        partial = folder.with_suffix(".partial")
        shutil.rmtree(partial, ignore_errors=True)
        write_sequence(_as_one_sequence(dataset, chosen), 0, partial, None)
        partial.rename(folder)
    return int(chosen.size)


def evenly(dataset: PoseDataset, indices: NDArray[np.int64], per_flight: int) -> NDArray[np.int64]:
    """Choose ``per_flight`` of the frame numbers (n,) per sequence, including first and last."""
    sequences = dataset.sequence[indices]
    parts = [indices[sequences == number] for number in np.unique(sequences)]
    spaced = [np.linspace(0, part.size - 1, per_flight).round().astype(int) for part in parts]
    return np.concatenate([part[places] for part, places in zip(parts, spaced, strict=True)])


def _as_one_sequence(dataset: PoseDataset, indices: NDArray[np.int64]) -> PoseDataset:
    numbers = indices.tolist()
    return replace(
        dataset,
        poses=dataset.poses[indices],
        sequence=np.zeros(indices.size, np.int64),
        sequence_names=("test",),
        frame_names=tuple(dataset.frame_names[number] for number in numbers),
        read_image=lambda place: dataset.read_image(numbers[place]),
    )
