"""Images played through a bundle as a stream, for programs that ask what it says of each."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import Camera
from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.odometer import Odometer
from cvo_edge.vocabulary import Scope
from cvo_export.data.splits import same_split
from cvo_export.datasets import PoseDataset, open_dataset

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Rows = NDArray[np.int64]

CONFIDENCE = 0.9
# What the split of a bundle's data makes of its test frames.
SITUATIONS = {"random": "known frames", "block": "new parts", "sequence": "new recordings"}


class Subject(NamedTuple):
    """A bundle, the data it was made from, and the frames of each role."""

    bundle: Bundle
    dataset: PoseDataset
    roles: Mapping[str, Rows]

    @property
    def heading(self) -> dict[str, str]:
        """What a result file says of the bundle."""
        calibration = self.bundle.calibration
        return {
            "bundle": calibration.name,
            "method": calibration.method,
            "dataset": self.dataset.name,
            "situation": SITUATIONS[calibration.calibration.split.kind],
            "rule": calibration.calibration.rule,
        }

    @classmethod
    def of(cls, path: Path, dataset: str | None) -> Subject:
        """Open a bundle and its data set, or a run, which is published with today's defaults."""
        if (path / "network.pt").is_file():
            return cls._of_run(path, dataset)
        if dataset is None:
            raise UsageError(f"{path}: expected a data set after a bundle, or a run folder")
        bundle, opened = read_bundle(path), open_dataset(dataset)
        split = same_split(opened, bundle.calibration.calibration.split)
        return cls(bundle, opened, split.roles)

    @classmethod
    def _of_run(cls, path: Path, dataset: str | None) -> Subject:
        # Only here: it takes torch, which bundles do not need.
        from cvo_export.publish import publish
        from cvo_export.training.run import load_run

        run = load_run(path, dataset)
        with TemporaryDirectory() as folder:
            publish(run, Path(folder) / "bundle", path.name)
            return cls(read_bundle(Path(folder) / "bundle"), run.dataset, run.split.roles)


class Seen(NamedTuple):
    """An estimate, the true pose (7,), the recording, and the frame's number in it, from 1."""

    estimate: PoseInterval
    truth: Array
    recording: int
    number: int

    @property
    def finite(self) -> bool:
        """Whether the frame has a finite set."""
        return self.estimate.bounded

    @property
    def misplaced(self) -> bool:
        """Whether a finite set misses the true position in any of its axes."""
        return self.finite and not self.estimate.covers(self.truth)[:3].all()


def by_recording(dataset: PoseDataset, rows: Rows) -> list[Rows]:
    """Return the frames of each recording, in order."""
    recordings = np.unique(dataset.sequence[rows])
    return [rows[dataset.sequence[rows] == recording] for recording in recordings]


def spread(rows: Rows, most: int) -> Rows:
    """Return at most so many of the frames, evenly spread."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(np.int64))]


def remembered(dataset: PoseDataset, images: int = 400) -> PoseDataset:
    """Return the data set with its last images kept in memory; they must not be changed."""
    return replace(dataset, read_image=lru_cache(maxsize=images)(dataset.read_image))


def played(
    bundle: Bundle,
    images: Iterable[Image],
    *,
    scope: Scope = "joint",
    camera: Camera | None = None,
    moving: bool | None = None,
) -> Iterator[PoseInterval]:
    """Yield the estimates of one stream, from an odometer of its own.

    ``moving`` is the hint about motion that each step is given; None gives none. One thread: the
    figures do not depend on time, and two programs may run at once.
    """
    with Odometer(bundle, threads=1, confidence=CONFIDENCE, scope=scope, camera=camera) as odometer:
        for image in images:
            yield odometer.step(image, moving=moving)
