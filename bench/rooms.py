"""How often a bundle gives an interval in a room that it does not know.

    python bench/rooms.py BUNDLE DATASET [DATASET ...] [--json FILE]

Each recording of a room is one stream in the joint scope at 0.9, with at most 100 frames, evenly
spread; of many recordings 12 are played. The first five frames of a stream do not count: an alarm
may need them. No interval of another room can be right, unless both have the same world frame. A
method that solves for the pose is told the room's own camera.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from played import Seen, by_recording, played, spread
from provenance import write_result
from wrong_frames import shares

from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_export.datasets import PoseDataset, open_dataset

FRAMES, RECORDINGS = 100, 12
SETTLED = 5


def visit(bundle: Bundle, room: PoseDataset) -> dict[str, Any]:
    """Return the share of finite intervals in a room, in all and for each recording."""
    recordings = by_recording(room, np.arange(len(room)))
    camera = room.camera() if bundle.head.solves else None
    found: dict[str, list[Seen]] = {}
    for number in spread(np.arange(len(recordings)), RECORDINGS).tolist():
        rows = spread(recordings[number], FRAMES).tolist()
        images = (room.read_image(row) for row in rows)
        estimates = played(bundle, images, camera=camera)
        found[room.sequence_names[number]] = [
            Seen(estimate, room.poses[row], number, place)
            for place, (row, estimate) in enumerate(zip(rows, estimates, strict=True), 1)
            if place > SETTLED
        ]
    return {
        **shares([each for seen in found.values() for each in seen]),
        "recordings": {
            name: float(np.mean([each.finite for each in seen])) for name, seen in found.items()
        },
    }


def main() -> None:
    """Print a line for each room; write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("rooms", nargs="+", help="data sets")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    bundle = read_bundle(arguments.bundle)
    report: dict[str, Any] = {}
    for text in arguments.rooms:
        room = open_dataset(text)
        report[room.name] = found = visit(bundle, room)
        shown = list(found["recordings"].values())
        print(
            f"{room.name}: finite {found['finite']:.3f} of {found['frames']} frames; recordings "
            f"{min(shown):.2f} to {max(shown):.2f}; "
            + ", ".join(f"{reason} {share:.2f}" for reason, share in found["reasons"].items()),
            flush=True,
        )
    if arguments.json:
        calibration = bundle.calibration
        heading = {"what": "rooms", "bundle": calibration.name, "method": calibration.method}
        write_result(arguments.json, {**heading, "settled_after": SETTLED, "rooms": report})


if __name__ == "__main__":
    main()
