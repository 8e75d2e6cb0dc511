"""The synthetic room as a data set: flights with exact poses, for demonstration and tests.

The scene is the same for every seed; ``cvo_export.scene.room`` describes it and its world frame.
The seed determines the flights, their light and their noise. The principal point is the image
centre, ((width - 1) / 2, (height - 1) / 2). Motion blur is centred on the pose of its frame.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cvo_edge.errors import UsageError
from cvo_edge.geometry import quaternion_exp, quaternion_multiply
from cvo_export.datasets.base import Intrinsics, PoseDataset
from cvo_export.scene.renderer import Floats, Image, Scene, as_image
from cvo_export.scene.room import room, tagged_room
from cvo_export.scene.sensor import Light, add_noise, motion_blur

# ------------------------------------------------------------------------------- specification

_FOCAL_PER_WIDTH = 0.9140625  # Kinect: 585 px at 640 px, a horizontal field of view of 57 degrees


class _Options(NamedTuple):
    flights: int = 48
    frames: int = 50
    width: int = 320
    height: int = 240
    seed: int = 0
    turn: int = 0
    still: tuple[str, ...] = ()
    tag_m: float = 0.0


def open_room(spec: str = "room") -> PoseDataset:
    """Open the synthetic room; ``read_image`` renders the images.

    Parameters
    ----------
    spec
        ``room``, then any of ``,flights=48`` (1..1000), ``,frames=50`` (per flight, 1..10000),
        ``,size=320x240`` (64x48..1920x1080) and ``,seed=0`` (0..4294967295). ``,turn=1`` lets the
        camera turn round and round; ``,still=z+pitch+roll`` holds any of x y z yaw pitch roll, here
        those of a wheeled robot; ``,tag=0.2`` (0.02..0.3) hangs an AprilTag with edges of so many
        metres on the front wall. Frame j of flight i depends only on these, the size, the seed, i
        and j, so more flights or frames do not change the earlier ones.

    Returns
    -------
    PoseDataset
        Named ``synthetic-room``, with one sequence per flight. ``read_image`` may be called from
        several threads, in any order, and raises ``IndexError`` past the last frame.

    Raises
    ------
    UsageError
        The specification does not name ``room``, or an option is unknown, repeated or out of range.
    """
    options = _parse(spec)
    fx = _FOCAL_PER_WIDTH * options.width
    intrinsics = Intrinsics(fx, fx, (options.width - 1) / 2, (options.height - 1) / 2)
    flights = [_Flight(options, number) for number in range(options.flights)]
    times_s = np.arange(options.frames, dtype=np.float64) * _FRAME_TIME_S
    names = tuple(f"flight-{number:02d}" for number in range(1, options.flights + 1))

    def read_image(index: int) -> Image:
        flight, frame = divmod(range(options.flights * options.frames)[index], options.frames)
        return flights[flight].photograph(frame, intrinsics, (options.width, options.height))

    return PoseDataset(
        name="synthetic-room",
        poses=np.concatenate([flight.poses(times_s) for flight in flights]),
        sequence=np.repeat(np.arange(options.flights), options.frames),
        sequence_names=names,
        frame_names=tuple(f"{name}/frame-{j:06d}" for name in names for j in range(options.frames)),
        read_image=read_image,
        image_size=lambda _: (options.height, options.width),
        intrinsics=intrinsics,
    )


def _parse(spec: str) -> _Options:
    name, *items = spec.split(",")
    if name != "room":
        raise UsageError(f"expected a synthetic scene named room, found {name!r} in {spec!r}")
    values: dict[str, int] = {}
    still: tuple[str, ...] = ()
    tag_m: float | None = None
    for item in items:
        key, _, text = item.partition("=")
        if key == "size":
            width, _, height = text.partition("x")
            found = {"width": width, "height": height}
        elif key in ("flights", "frames", "seed", "turn"):
            found = {key: text}
        elif key == "still" and not still:
            still, found = tuple(text.split("+")), {}
            if not set(still) <= set(_NAMES):
                raise UsageError(
                    f"expected still= with names among {'+'.join(_NAMES)}, found {item!r}"
                )
        elif key == "tag" and tag_m is None:
            found, tag_m = {}, _edge(text)
            if tag_m is None:
                raise UsageError(f"expected tag=0.02..0.3 in metres, found {item!r} in {spec!r}")
        else:
            raise UsageError(
                "expected an option flights=, frames=, size=, seed=, turn=, still= or tag=, each "
                "once, found "
                f"{item!r} in {spec!r}"
            )
        for field, digits in found.items():
            if field in values:
                raise UsageError(f"expected {key} once, found it twice in {spec!r}")
            low, high = _RANGES[field]
            if not (digits.isascii() and digits.isdigit() and low <= int(digits) <= high):
                raise UsageError(f"expected {_EXPECTED[key]}, found {item!r} in {spec!r}")
            values[field] = int(digits)
    return _Options(**values, still=still, tag_m=tag_m or 0.0)


def _edge(text: str) -> float | None:
    """Return the edge length of a tag that fits on the wall, or None."""
    try:
        edge = float(text)
    except ValueError:
        return None
    return edge if 0.02 <= edge <= 0.3 else None


_RANGES = {
    "flights": (1, 1000),
    "frames": (1, 10000),
    "width": (64, 1920),
    "height": (48, 1080),
    "seed": (0, 2**32 - 1),
    "turn": (0, 1),
}
_EXPECTED = {
    "flights": "flights=1..1000",
    "frames": "frames=1..10000",
    "size": "size=WIDTHxHEIGHT between 64x48 and 1920x1080",
    "seed": "seed=0..4294967295",
    "turn": "turn=0..1",
}

# ------------------------------------------------------------------------------------- flights

_FRAME_TIME_S = 1 / 30
_EXPOSURE_S = 1 / 200

# Every degree of freedom is a sum of three sinusoids whose amplitudes add up to its reach: it is
# smooth, stays within centre +- reach, and has a standard deviation of 0.44 times the reach. The
# volume is small enough for a small network to learn; the speed is that of a hand-held camera.
_CENTRE = np.array([0.0, -0.4, 1.3, 0.0, 0.0, 0.0])  # x y z in metres; yaw pitch roll in radians
_REACH = np.array([0.4, 0.3, 0.15, *np.radians([17.5, 7.5, 4.0])])
_NAMES = ("x", "y", "z", "yaw", "pitch", "roll")
# Of a camera that turns round, in rad/s, either way.
_TURN_RAD_S = 0.6, 1.2
_TURN_STREAM = 2**20
_TURNS = {3: np.array([0, 0, 1]), 4: np.array([1, 0, 0]), 5: np.array([0, 0, 1])}
_LEVEL = quaternion_exp([-math.pi / 2, 0, 0])  # looks along world y, with z up in the image
_SHARES = np.array([0.5, 0.35, 0.15])
_RATES_RAD_S = np.array([1.28, 2.72, 4.8])


class _Flight:
    """One camera trajectory over continuous time, its light and its sensor noise."""

    def __init__(self, options: _Options, number: int) -> None:
        self._entropy = (options.seed, number)
        self._tag_m = options.tag_m
        self._still = [_NAMES.index(name) for name in options.still]
        # Start and rate of the turns, from a stream of their own.
        around = self._rng(_TURN_STREAM)
        rate = around.uniform(*_TURN_RAD_S) * around.choice([-1.0, 1.0])
        self._yaw = (around.uniform(0.0, 2 * math.pi), rate) if options.turn else (0.0, 0.0)
        rng = self._rng(0)
        self._rate = _RATES_RAD_S * rng.uniform(0.8, 1.25, (6, 3))
        self._phase = rng.uniform(0, 2 * math.pi, (6, 3))
        self._light = Light(rng)

    def _scene(self) -> Scene:
        return tagged_room(self._tag_m) if self._tag_m else room()

    def _rng(self, stream: int) -> np.random.Generator:
        return np.random.default_rng((*self._entropy, stream))

    def poses(self, times_s: Floats) -> Floats:
        """Return ``T_world_camera`` at n times, shape (n, 7): tx ty tz, qx qy qz qw."""
        angles = self._rate * times_s[:, None, None] + self._phase
        state = _CENTRE + _REACH * (np.sin(angles) @ _SHARES)
        state[:, self._still] = _CENTRE[self._still]
        state[:, 3] += self._yaw[0] + self._yaw[1] * times_s
        yaw, pitch, roll = (quaternion_exp(state[:, [k]] * axis) for k, axis in _TURNS.items())
        # Right to left: roll about the optical axis, pitch about the camera's x axis (positive
        # looks up), the level camera looking along world y, yaw about world z.
        tilt = quaternion_multiply(pitch, roll)
        rotation = quaternion_multiply(yaw, quaternion_multiply(_LEVEL, tilt))
        return np.concatenate([state[:, :3], rotation], axis=1)

    def photograph(self, frame: int, intrinsics: Intrinsics, size: tuple[int, int]) -> Image:
        """Render a frame with this flight's blur, light and noise, (height, width, 3), BGR."""
        time_s = frame * _FRAME_TIME_S
        opening, pose, closing = self.poses(time_s + _EXPOSURE_S * np.array([-0.5, 0.0, 0.5]))
        sharp = self._scene().render(pose, intrinsics, size)
        image = motion_blur(sharp, opening, pose, closing, intrinsics)
        self._light.shade(image, time_s, intrinsics)
        add_noise(image, self._rng(frame + 1))
        return as_image(image)
