"""Virtual places as data sets: recordings with exact poses, for demonstration and tests.

The places are the same for every seed; ``cvo_export.scene.room`` and ``cvo_export.scene.street``
describe them and their world frames. The seed determines the recordings, their light and their
noise. The principal point is the image centre, ((width - 1) / 2, (height - 1) / 2). Motion blur is
centred on the pose of its frame.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from cvo_edge.errors import UsageError
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
    options = _parse(spec, items, place)
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


def _parse(spec: str, items: list[str], place: _Place) -> _Options:
    values: dict[str, int] = {}
    still: tuple[str, ...] = ()
    tag_m: float | None = None
    for item in items:
        key, _, text = item.partition("=")
        if key not in place.keys or (key == "still" and still) or (key == "tag" and tag_m):
            raise UsageError(
                f"expected an option {'=, '.join(place.keys[:-1])}= or {place.keys[-1]}=, each "
                f"once, found {item!r} in {spec!r}"
            )
        if key == "size":
            width, _, height = text.partition("x")
            found = {"width": width, "height": height}
        elif key == "still":
            still, found = tuple(text.split("+")), {}
            if not set(still) <= set(DEGREES_OF_FREEDOM):
                raise UsageError(
                    f"expected still= with names among {'+'.join(DEGREES_OF_FREEDOM)}, found "
                    f"{item!r}"
                )
        elif key == "tag":
            found, tag_m = {}, _edge(text)
            if tag_m is None:
                raise UsageError(f"expected tag=0.02..0.3 in metres, found {item!r} in {spec!r}")
        else:
            found = {"recordings" if key == f"{place.recording}s" else key: text}
        for field, digits in found.items():
            if field in values:
                raise UsageError(f"expected {key} once, found it twice in {spec!r}")
            low, high = _RANGES[field]
            if not (digits.isascii() and digits.isdigit() and low <= int(digits) <= high):
                expected = _SIZES if key == "size" else f"{key}={low}..{high}"
                raise UsageError(f"expected {expected}, found {item!r} in {spec!r}")
            values[field] = int(digits)
    return place.default._replace(**values, still=still, tag_m=tag_m or 0.0)


def _edge(text: str) -> float | None:
    """Return the edge length of a tag that fits on the wall, or None."""
    try:
        edge = float(text)
    except ValueError:
        return None
    return edge if 0.02 <= edge <= 0.3 else None


_RANGES = {
    "recordings": (1, 1000),
    "frames": (1, 10000),
    "width": (64, 1920),
    "height": (48, 1080),
    "seed": (0, 2**32 - 1),
    "turn": (0, 1),
}
_SIZES = "size=WIDTHxHEIGHT between 64x48 and 1920x1080"
