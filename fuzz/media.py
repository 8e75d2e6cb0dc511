"""Run ``cvo-edge run`` on image files and videos with changed bytes."""

from __future__ import annotations

import json
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fuzz.bundles import ARTIFACTS
from fuzz.mutate import changed_bytes
from fuzz.trials import Tally, command, in_parallel

_BUNDLE, _CLIP = ARTIFACTS / "synthetic-room-cjp-int8", ARTIFACTS / "synthetic-room-clip"
_SUFFIXES = (".jpg", ".png", ".bmp", ".ppm", ".tif", ".webp")
_MANY = 20


def images(count: int) -> Tally:
    """Mix twenty changed files with intact ones; the intact files' poses must not change.

    Each changed file is one trial.
    """
    tally = Tally()
    for found in in_parallel(_folder_of_images, -(-count // _MANY)).outcomes.elements():
        outcomes, finding = json.loads(found)
        for outcome, number in outcomes.items():
            for _ in range(number):
                tally.add(outcome)
        if finding:
            tally.findings.append(finding)
    return tally


def _folder_of_images(number: int) -> tuple[str, str | None]:
    generator = np.random.default_rng([2029, number])
    clip = sorted(_CLIP.glob("*.jpg"))
    outcomes: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for place in range(_MANY):
            shutil.copy(clip[place], folder / f"{place:03d}-a.jpg")
            suffix = _SUFFIXES[int(generator.integers(len(_SUFFIXES)))]
            content = cv2.imencode(suffix, _picture(clip[place + 1]))[1].tobytes()
            (folder / f"{place:03d}-b{suffix}").write_bytes(changed_bytes(content, generator))
        ended = command(["run", _BUNDLE, folder, "--quiet", "--threads", 1])
        finding = ended.misbehaviour((0,))
        records = [] if finding else _records(ended.output)
        if not finding and len(records) != 2 * _MANY:
            finding = f"{len(records)} records of {2 * _MANY}"
        for record in records:
            if "-b" in record["source"]:
                outcomes[record["status"]] = outcomes.get(record["status"], 0) + 1
            elif record["pose"] != _as_ever()[record["source"][:3]]:
                finding = f"{record['source']}: its pose depends on the damaged files"
    return json.dumps([outcomes, finding and f"folder {number}: {finding}"]), None


def _records(output: bytes) -> list[Any]:
    """Return the decoded lines after the header."""
    return [json.loads(line) for line in output.splitlines()[1:]]


@cache
def _as_ever() -> dict[str, object]:
    """Return the poses of the intact files without damaged ones, by number."""
    ended = command(["run", _BUNDLE, _CLIP, "--quiet", "--threads", 1, "--max-frames", _MANY])
    records = _records(ended.output)
    return {f"{number:03d}": record["pose"] for number, record in enumerate(records)}


def _picture(path: Path) -> NDArray[Any]:
    image = cv2.imread(str(path))
    assert image is not None, path
    return image


def videos(count: int) -> Tally:
    """Change a video of 20 frames; it must be read to its end, be refused or end with an error.

    Its records must be in order in all cases.
    """

    def trial(number: int) -> tuple[str, str | None]:
        generator = np.random.default_rng([2030, number])
        with tempfile.TemporaryDirectory() as name:
            path = Path(name) / "clip.avi"
            path.write_bytes(changed_bytes(_video(), generator))
            ended = command(["run", _BUNDLE, path, "--quiet", "--threads", 1])
            finding = ended.misbehaviour((0, 6)) or _out_of_order(ended.output)
            return f"exit code {ended.code}", finding

    return in_parallel(trial, count)


def _out_of_order(output: bytes) -> str | None:
    """Return a finding if numbers, names or stamps of a video's records are out of order."""
    records = _records(output)
    if [(record["seq"], record["source"]) for record in records] != [
        (number, f"clip.avi#{number}") for number in range(len(records))
    ]:
        return "records out of order"
    stamps = [record["stamp_ns"] for record in records if record["stamp_ns"] is not None]
    if stamps != sorted(set(stamps)):
        return "stamps out of order"
    unseen = [record for record in records if record["status"] != "ok"]
    if any(record["interval"] and record["interval"]["bounded"] for record in unseen):
        return "an interval without a frame"
    return None


@cache
def _video() -> bytes:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "clip.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (320, 240))
        for image in sorted(_CLIP.glob("*.jpg"))[:20]:
            writer.write(_picture(image))
        writer.release()
        return path.read_bytes()
