"""False alarms: doubts in a long stream of right frames.

    python bench/alarms.py BUNDLE DATASET [--frames 18000] [--json FILE]
    python bench/alarms.py RUN [DATASET] [--frames 18000] [--json FILE]

The test recordings of the bundle's own data are played again and again, every second time with the
frames of each recording backwards. In each pass exposure (up to a tenth of a stop) and place (up to
one percent of the width) are drawn again, and each frame has noise of its own (deviation of one
grey level), so that no frame is a copy. With at least 512 test frames, all passes form one stream;
with fewer, each pass is its own, because the same frame would come back sooner than a robot does.
An episode is a run of consecutive frames without an interval.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from itertools import count, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from altered import Image, Random, shown
from played import Subject, by_recording, played, remembered
from provenance import write_result

from cvo_edge.estimate import PoseInterval
from cvo_export.data.noise import Noise
from cvo_export.datasets import PoseDataset

FRAMES = 18_000
HORIZON = 512
STOPS, LEVELS, SHIFT = 0.1, 1.0, 0.01


def passes(subject: Subject) -> Iterator[list[int]]:
    """Yield the frames of each pass through the recordings, without end."""
    recordings = by_recording(subject.dataset, subject.roles["test"])
    for number in count():
        step = -1 if number % 2 else 1
        yield [row for recording in recordings for row in recording[::step].tolist()]


def again(dataset: PoseDataset, rows: list[int], random: Random) -> Iterator[Image]:
    """Yield images as a camera that comes by again would take them."""
    exposure = Noise("exposure", random.uniform(-STOPS, STOPS))
    shift = SHIFT * random.uniform(-1.0, 1.0, 2)
    for row in rows:
        image = exposure.degrade(dataset.read_image(row), random)
        matrix = np.column_stack([np.eye(2), shift * image.shape[1]])
        size = image.shape[1::-1]
        moved = cv2.warpAffine(image, matrix, size, borderMode=cv2.BORDER_REFLECT_101)
        yield shown(moved + LEVELS * random.standard_normal(image.shape))


def estimates(subject: Subject, frames: int) -> Iterator[list[PoseInterval]]:
    """Yield the estimates of each stream, ``frames`` in all."""
    random = np.random.default_rng(0)
    dataset = remembered(subject.dataset, 1000)
    order = passes(subject)
    several = len(subject.roles["test"]) >= HORIZON

    def images() -> Iterator[Image]:
        for rows in order:
            yield from again(dataset, rows, random)
            if not several:
                return

    while frames > 0:
        found = list(islice(played(subject.bundle, images()), frames))
        frames -= len(found)
        yield found


def false_alarms(streams: list[list[PoseInterval]]) -> dict[str, Any]:
    """Count the frames without an interval, their reasons and their episodes."""
    reasons: Counter[str] = Counter()
    lengths: list[int] = []
    for stream in streams:
        before = False
        for estimate in stream:
            doubted = not estimate.bounded
            if doubted:
                reasons.update(map(str, estimate.reasons))
                if not before:
                    lengths.append(0)
                lengths[-1] += 1
            before = doubted
    return {
        "frames": sum(map(len, streams)),
        "streams": len(streams),
        "doubted": sum(lengths),
        "reasons": dict(reasons.most_common()),
        "episodes": len(lengths),
        "longest_episode": max(lengths, default=0),
        "streams_with_doubts": sum(any(not e.bounded for e in stream) for stream in streams),
    }


def main() -> None:
    """Print the counts; write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path, help="bundle or run folder")
    parser.add_argument("dataset", nargs="?", help="data set; a run knows its own")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    subject = Subject.of(arguments.bundle, arguments.dataset)
    found = false_alarms(list(estimates(subject, arguments.frames)))
    print(", ".join(subject.heading.values()))
    print(
        f"{found['doubted']} of {found['frames']} frames without an interval, in "
        f"{found['episodes']} episodes (longest {found['longest_episode']}), in "
        f"{found['streams_with_doubts']} of {found['streams']} streams; "
        + (", ".join(f"{reason} {n}" for reason, n in found["reasons"].items()) or "no reasons")
    )
    if arguments.json:
        write_result(arguments.json, {"what": "false alarms", **subject.heading, **found})


if __name__ == "__main__":
    main()
