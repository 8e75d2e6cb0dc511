"""What a bundle says of wrong frames: 100 frames of each kind, played as streams.

    python bench/wrong_frames.py BUNDLE DATASET [--frames 100] [--json FILE] [--sheet PNG]
    python bench/wrong_frames.py RUN [DATASET]

The frames are those of the role test of the bundle's own data; a run folder is published with
today's defaults first. ``wrong_kinds`` has the kinds. Each stream starts with a fresh odometer in
the joint scope at 0.9. A frame is *finite and wrong* if its interval is finite and misses the true
position in any axis. Frames before a fault do not count. Kinds that leave every image as it is
(colours of a grey camera) are reported as unchanged and count nowhere.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from played import Image, Rows, Seen, Subject, by_recording, played, remembered
from provenance import write_result
from wrong_kinds import HARMLESS, WRONG, Kind, frame

FRAMES = 100
# Of a recording, where there are many: several recordings say more than a long one.
LEAST_OF_A_STREAM = 25
LIMITS = (0.10, 0.15)
WORST = 10

Figures = dict[str, Any]


def streams_of(rows: list[Rows], start: int, frames: int) -> Iterator[Rows]:
    """Choose streams, ``start`` right frames and then faulty ones, until there are enough.

    Recordings come in an order drawn once, the same for all kinds; short ones make others longer.
    """
    left = [max(0, len(recording) - start) for recording in rows]
    lengths = range(LEAST_OF_A_STREAM, frames)
    most = next((n for n in lengths if sum(min(n, each) for each in left) >= frames), frames)
    for recording in np.random.default_rng(0).permutation(len(rows)).tolist():
        count = min(most, frames, left[recording])
        if count > 0:
            yield rows[recording][: start + count]
            frames -= count


def measure(subject: Subject, kind: Kind, frames: int, moving: bool | None = None) -> Figures:
    """Return the figures of one kind."""
    dataset = subject.dataset
    rows = by_recording(dataset, subject.roles["test"])
    found: list[list[Seen]] = []
    changed = False
    for stream in streams_of(rows, kind.start, frames):
        right = [dataset.read_image(row) for row in stream.tolist()]
        given = [frame(kind, right, number) for number in range(len(right))]
        changed |= any(not np.array_equal(*pair) for pair in zip(right, given, strict=True))
        estimates = played(subject.bundle, given, moving=moving)
        seen = [
            Seen(estimate, dataset.poses[row], int(dataset.sequence[row]), number + 1)
            for number, (row, estimate) in enumerate(zip(stream, estimates, strict=True))
        ]
        found.append(seen[kind.start :])
    return {
        "family": kind.family,
        "fitted": kind.fitted,
        "changed": changed,
        **shares([each for seen in found for each in seen]),
        "first_doubted": [_first_doubted(seen) for seen in found],
    }


def shares(seen: list[Seen]) -> Figures:
    """Return the shares of frames: finite and wrong, finite, and with each reason."""
    reasons = Counter(reason for each in seen for reason in each.estimate.reasons)
    return {
        "frames": len(seen),
        "wrong": float(np.mean([each.misplaced for each in seen])),
        "finite": float(np.mean([each.finite for each in seen])),
        "reasons": {str(reason): count / len(seen) for reason, count in reasons.most_common()},
    }


def _first_doubted(seen: list[Seen]) -> int | None:
    """Return the first frame without an interval, from 0 where the fault begins, or None."""
    return next((number for number, each in enumerate(seen) if not each.finite), None)


def summary(kinds: Iterable[Figures]) -> Figures:
    """Return the median share that is finite and wrong, and how many kinds are over the limits."""
    wrong = [kind["wrong"] for kind in kinds if kind["changed"]]
    return {
        "kinds": len(wrong),
        "median": float(np.median(wrong)) if wrong else None,
        **{f"over_{limit:.2f}": sum(share > limit for share in wrong) for limit in LIMITS},
        "worst": max(wrong, default=None),
    }


def line(name: str, found: Figures) -> str:
    """Return one row of what is printed."""
    if not found["changed"]:
        return f"  {name:<32} unchanged"
    first = [number for number in found["first_doubted"] if number is not None]
    reasons = ", ".join(f"{name} {share:.2f}" for name, share in found["reasons"].items())
    return (
        f"  {name:<32} finite and wrong {found['wrong']:.2f}, finite {found['finite']:.2f}, first "
        f"doubted {np.median(first) if first else '-'}; {reasons or 'no reasons'}"
    )


def summary_line(name: str, found: Figures) -> str:
    """Return one row of the summary."""
    if not found["kinds"]:
        return f"{name}: none"
    over = ", ".join(f"{found[f'over_{limit:.2f}']} over {limit:.2f}" for limit in LIMITS)
    return (
        f"{name}: {found['kinds']} kinds, finite and wrong: median {found['median']:.3f}, {over}, "
        f"worst {found['worst']:.2f}"
    )


def report(subject: Subject, frames: int) -> Figures:
    """Measure all kinds and print a line for each."""
    subject = subject._replace(dataset=remembered(subject.dataset))
    found: dict[str, dict[str, Figures]] = {"wrong": {}, "hinted": {}, "harmless": {}}

    def add(group: str, name: str, figures: Figures) -> None:
        found[group][name] = figures
        print(line(name, figures), flush=True)

    for kind in HARMLESS:
        figures = measure(subject, kind, frames)
        add("harmless", kind.name, {**figures, "changed": True})
    for kind in WRONG:
        add("wrong", kind.name, measure(subject, kind, frames))
    for kind in (kind for kind in WRONG if kind.still):
        figures = measure(subject, kind, frames, moving=True)
        add("hinted", f"{kind.name}, with the hint", figures)
    wrong = found["wrong"].values()
    summaries = {
        "all": summary(wrong),
        "left_out": summary(each for each in wrong if not each["fitted"]),
        "fitted": summary(each for each in wrong if each["fitted"]),
        "not_frozen": summary(each for each in wrong if each["family"] != "frozen"),
    }
    return {**found, "summary": summaries}


def sheet(subject: Subject) -> Image:
    """Return a contact sheet: one frame of each kind."""
    rows = by_recording(subject.dataset, subject.roles["test"])[0][:50].tolist()
    right = [subject.dataset.read_image(row) for row in rows]
    tiles = []
    for kind in (*WRONG, *HARMLESS):
        tile = cv2.resize(frame(kind, right, len(right) - 1), (208, 156))
        cv2.rectangle(tile, (0, 0), (208, 14), (0, 0, 0), -1)
        cv2.putText(tile, kind.name, (2, 11), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255,) * 3)
        tiles.append(tile)
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % 9)
    return np.vstack([np.hstack(tiles[at : at + 9]) for at in range(0, len(tiles), 9)])


def main() -> None:
    """Print a line for each kind and a summary; write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path, help="bundle or run folder")
    parser.add_argument("dataset", nargs="?", help="data set; a run knows its own")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--sheet", type=Path, help="write a contact sheet of the kinds instead")
    arguments = parser.parse_args()
    subject = Subject.of(arguments.bundle, arguments.dataset)
    if arguments.sheet:
        cv2.imwrite(str(arguments.sheet), sheet(subject))
        return
    print(", ".join(subject.heading.values()))
    found = report(subject, arguments.frames)
    worst = sorted(found["wrong"].items(), key=lambda item: -item[1]["wrong"])[:WORST]
    print("worst: " + ", ".join(f"{name} {each['wrong']:.2f}" for name, each in worst))
    for name, each in found["summary"].items():
        print(summary_line(name.replace("_", " "), each))
    if arguments.json:
        heading = {"what": "wrong frames", **subject.heading, "frames": arguments.frames}
        write_result(arguments.json, {**heading, **found})


if __name__ == "__main__":
    main()
