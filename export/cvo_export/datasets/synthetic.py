"""Virtual places as data sets: recordings with exact poses, for demonstration and tests.

The places are the same for every seed; ``cvo_export.scene.room`` and ``cvo_export.scene.street``
describe them and their world frames. The seed determines the recordings, their light and their
noise. The principal point is the image centre, ((width - 1) / 2, (height - 1) / 2). Motion blur is
centred on the pose of its frame.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cvo_edge.errors import UsageError
from cvo_edge.trajectories.path_options import read_options
from cvo_export.datasets.base import Intrinsics, PoseDataset
from cvo_export.scene.drive import Drive
from cvo_export.scene.flight import DEGREES_OF_FREEDOM, Flight
from cvo_export.scene.recording import Recording
from cvo_export.scene.renderer import Image


class _Options(NamedTuple):
    recordings: int
    frames: int
    width: int = 320
    height: int = 240
    seed: int = 0
    turn: int = 0
    still: tuple[str, ...] = ()
    tag_m: float = 0.0


class _Place(NamedTuple):
    """What can be seen, in which recordings, with which options by default."""

    recording: str
    record: Callable[[_Options, int], Recording]
    focal_per_width: float
    keys: tuple[str, ...]
    default: _Options


def open_synthetic(spec: str = "room") -> PoseDataset:
    """Open a virtual place; ``read_image`` renders the images.

    Parameters
    ----------
    spec
        ``room``, then any of ``,flights=48`` (1..1000), ``,frames=50`` (per flight, 1..10000),
        ``,size=320x240`` (64x48..1920x1080) and ``,seed=0`` (0..4294967295). ``,turn=1`` lets the
        camera turn round and round; ``,still=z+pitch+roll`` holds any of x y z yaw pitch roll, here
        those of a wheeled robot; ``,tag=0.2`` (0.02..0.3) hangs an AprilTag with edges of so many
        metres on the front wall.

        ``street``, then any of ``,drives=10``, ``,frames=200``, ``,size=320x240`` and ``,seed=0``,
        in the same ranges: a car that goes round a block, 265 m and about 170 frames a lap.

        Frame j of recording i depends only on these, the size, the seed, i and j, so more
        recordings or frames do not change the earlier ones.

    Returns
    -------
    PoseDataset
        Named ``synthetic-room`` or ``synthetic-street``, with one sequence per recording.
        ``read_image`` may be called from several threads, in any order, and raises ``IndexError``
        past the last frame.

    Raises
    ------
    UsageError
        The specification names no such place, or an option is unknown, repeated or out of range.
    """
    name, *items = spec.split(",")
    if name not in _PLACES:
        raise UsageError(
            f"expected a synthetic scene named room or street, found {name!r} in {spec!r}"
        )
    place = _PLACES[name]
    options = _parse(name, items, place)
    fx = place.focal_per_width * options.width
    intrinsics = Intrinsics(fx, fx, (options.width - 1) / 2, (options.height - 1) / 2)
    recordings = [place.record(options, number) for number in range(options.recordings)]
    times_s = np.arange(options.frames, dtype=np.float64) * recordings[0].frame_time_s
    names = tuple(f"{place.recording}-{number:02d}" for number in range(1, len(recordings) + 1))

    def read_image(index: int) -> Image:
        number, frame = divmod(range(len(recordings) * options.frames)[index], options.frames)
        return recordings[number].photograph(frame, intrinsics, (options.width, options.height))

    return PoseDataset(
        name=f"synthetic-{name}",
        poses=np.concatenate([recording.poses(times_s) for recording in recordings]),
        sequence=np.repeat(np.arange(len(recordings)), options.frames),
        sequence_names=names,
        frame_names=tuple(f"{name}/frame-{j:06d}" for name in names for j in range(options.frames)),
        read_image=read_image,
        image_size=lambda _: (options.height, options.width),
        intrinsics=intrinsics,
    )


def _fly(options: _Options, number: int) -> Recording:
    return Flight(
        options.seed,
        number,
        turn=bool(options.turn),
        still=options.still,
        tag_m=options.tag_m,
    )


def _drive(options: _Options, number: int) -> Recording:
    return Drive(options.seed, number)


_PLACES = {
    # Kinect: 585 px at 640 px, a horizontal field of view of 57 degrees.
    "room": _Place(
        "flight",
        _fly,
        0.9140625,
        ("flights", "frames", "size", "seed", "turn", "still", "tag"),
        _Options(48, 50),
    ),
    # Cameras on cars see more: 80 degrees.
    "street": _Place("drive", _drive, 0.6, ("drives", "frames", "size", "seed"), _Options(10, 200)),
}


def _parse(name: str, items: list[str], place: _Place) -> _Options:
    found: dict[str, Any] = {}
    for key, text in read_options(f"synthetic:{name}: expected", items, place.keys).items():
        if key == "size":
            width, _, height = text.partition("x")
            expected = f"{_SIZES}, found {key}={text}"
            found["width"] = _whole("width", width, expected)
            found["height"] = _whole("height", height, expected)
        elif key == "still":
            found["still"] = _names(text)
        elif key == "tag":
            found["tag_m"] = _edge(text)
        else:
            field = "recordings" if key == f"{place.recording}s" else key
            low, high = _RANGES[field]
            found[field] = _whole(field, text, f"{key}={low}..{high}, found {key}={text}")
    return place.default._replace(**found)


def _whole(field: str, text: str, expected: str) -> int:
    """Return the number of a field; raises UsageError with what was expected if out of range."""
    low, high = _RANGES[field]
    if not (text.isascii() and text.isdigit() and low <= int(text) <= high):
        raise UsageError(f"expected {expected}")
    return int(text)


def _names(text: str) -> tuple[str, ...]:
    """Return the degrees of freedom that are held; raises UsageError."""
    names = tuple(text.split("+"))
    if not set(names) <= set(DEGREES_OF_FREEDOM):
        raise UsageError(
            f"expected still= with names among {'+'.join(DEGREES_OF_FREEDOM)}, found still={text}"
        )
    return names


def _edge(text: str) -> float:
    """Return the edge length of a tag that fits on the wall; raises UsageError."""
    try:
        edge = float(text)
    except ValueError:
        edge = 0.0
    if not 0.02 <= edge <= 0.3:
        raise UsageError(f"expected tag=0.02..0.3 in metres, found tag={text}")
    return edge


_RANGES = {
    "recordings": (1, 1000),
    "frames": (1, 10000),
    "width": (64, 1920),
    "height": (48, 1080),
    "seed": (0, 2**32 - 1),
    "turn": (0, 1),
}
_SIZES = "size=WIDTHxHEIGHT between 64x48 and 1920x1080"
