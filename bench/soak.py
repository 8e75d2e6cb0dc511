"""Growth of memory over a million frames.

    python bench/soak.py [FRAMES]

Repeats the frames of the demonstration clip, each time followed by a black and an unreadable one,
through every part of ``cvo-edge run``: odometer, records, summary, ground truth.

Memory is read a hundred times. Growth is the last tenth's mean less that of the second tenth; the
first tenth fills buffers of bounded size.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from networks import ARTIFACTS, demonstration
from rounds import write_report

from cvo_edge.estimate import PoseInterval
from cvo_edge.ground_truth import open_ground_truth
from cvo_edge.input.frame import Frame
from cvo_edge.input.sources import open_source
from cvo_edge.odometer import Odometer
from cvo_edge.output.sinks import Sink
from cvo_edge.programs.measure import memory_mib
from cvo_edge.programs.run import RunSummary, run

METHOD, FRAMES, READINGS = "cjp", 1_000_000, 100
CLIP = ARTIFACTS / "synthetic-room-clip"


class Cycled:
    """A source that repeats the decoded frames of the clip and two faulty ones."""

    live = False

    def __init__(self, length: int) -> None:
        self.length = length
        clip = list(open_source(str(CLIP)))
        black = np.zeros_like(clip[0].image)
        frames = [*clip, replace(clip[0], image=black), replace(clip[0], image=None)]
        # The clip comes again and again, which is no fault here.
        self._frames = [replace(frame, fresh_noise=False, moving=False) for frame in frames]

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames."""
        for _, frame in zip(range(self.length), cycle(self._frames), strict=False):
            yield frame

    def reads(self) -> Iterator[Any]:
        """Yield calls that return frames."""
        for frame in self:
            yield lambda frame=frame: frame


def main() -> None:
    """Run, read memory on the way, report."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else FRAMES
    readings: list[dict[str, float]] = []
    with (
        Odometer.load(demonstration(METHOD, "int8"), mode="throughput") as odometer,
        Sink(os.devnull, "jsonl") as sink,
    ):
        truth = open_ground_truth(CLIP)
        summary = RunSummary(odometer.chart.dof, 0.9, "marginal", truth=truth)

        def write(estimate: PoseInterval) -> None:
            sink.write(estimate)
            if (estimate.seq + 1) % max(1, count // READINGS) == 0:
                open_files = len(list(Path("/proc/self/fd").iterdir()))
                threads = len(list(Path("/proc/self/task").iterdir()))
                readings.append({**memory_mib(), "descriptors": open_files, "threads": threads})
                print(f"{estimate.seq + 1:>9} frames: {readings[-1]}", flush=True)

        run(odometer, Cycled(count), write, summary=summary)
    tenth = max(1, len(readings) // 10)

    def growth(key: str) -> float:
        values = [row[key] for row in readings]
        return round(float(np.mean(values[-tenth:]) - np.mean(values[tenth : 2 * tenth])), 3)

    results = {
        "frames": summary.frames,
        "statuses": dict(summary.statuses),
        "growth_mib": {key: growth(key) for key in ("rss", "anonymous")},
        "growth": {key: growth(key) for key in ("descriptors", "threads")},
        "first": readings[0],
        "last": readings[-1],
    }
    print(results)
    name = "soak" if count == FRAMES else f"soak-{count}"
    write_report(name, results, method=METHOD, precision="int8", mode="throughput")


if __name__ == "__main__":
    main()
