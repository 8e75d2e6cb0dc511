"""Test frames on disk: flights that the demonstration bundles were neither trained nor set on."""

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

# What calibration_artifacts/README.md trains and calibrates on.
DATASET = "synthetic:room,flights=100"


def write_test_frames(folder: Path, recorded: SplitSpec, per_flight: int) -> int:
    """Write JPEG images and .pose.txt of the split's test flights -> how many frames.

    ``per_flight`` frames of each, evenly spaced in time. A folder that is there already is kept.
    Raises SourceError where the split is not one of ``DATASET``.
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
    """Of frame numbers (n,), ``per_flight`` of each sequence, the first and the last among them."""
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
