"""Flights: a hand-held camera in the room."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cvo_export.scene.recording import RATES_RAD_S, SHARES, Recording, looking
from cvo_export.scene.renderer import Floats, Scene
from cvo_export.scene.room import room, tagged_room
from cvo_export.scene.sensor import Light

# Every degree of freedom is a sum of three sinusoids whose amplitudes add up to its reach: it is
# smooth, stays within centre +- reach, and has a standard deviation of 0.44 times the reach. The
# volume is small enough for a small network to learn; the speed is that of a hand-held camera.
_CENTRE = np.array([0.0, -0.4, 1.3, 0.0, 0.0, 0.0])  # x y z in metres; yaw pitch roll in radians
_REACH = np.array([0.4, 0.3, 0.15, *np.radians([17.5, 7.5, 4.0])])
DEGREES_OF_FREEDOM = ("x", "y", "z", "yaw", "pitch", "roll")
# Of a camera that turns round, in rad/s, either way.
_TURN_RAD_S = 0.6, 1.2
_TURN_STREAM = 2**20


class Flight(Recording):
    """A flight of any length; see ``datasets.synthetic`` for what its options mean."""

    frame_time_s = 1 / 30

    def __init__(
        self, seed: int, number: int, *, turn: bool, still: Sequence[str], tag_m: float
    ) -> None:
        super().__init__(seed, number)
        self._tag_m = tag_m
        self._still = [DEGREES_OF_FREEDOM.index(name) for name in still]
        # Start and rate of the turns, from a stream of their own.
        around = self.rng(_TURN_STREAM)
        rate = around.uniform(*_TURN_RAD_S) * around.choice([-1.0, 1.0])
        self._yaw = (around.uniform(0.0, 2 * math.pi), rate) if turn else (0.0, 0.0)
        rng = self.rng(0)
        self._rate = RATES_RAD_S * rng.uniform(0.8, 1.25, (6, 3))
        self._phase = rng.uniform(0, 2 * math.pi, (6, 3))
        self._light = Light(rng)

    @property
    def light(self) -> Light:
        """The light of this flight."""
        return self._light

    def scene(self) -> Scene:
        """Return the room, with a tag if there is one."""
        return tagged_room(self._tag_m) if self._tag_m else room()

    def poses(self, times_s: Floats) -> Floats:
        """Return ``T_world_camera`` at n times, shape (n, 7): tx ty tz, qx qy qz qw."""
        angles = self._rate * times_s[:, None, None] + self._phase
        state = _CENTRE + _REACH * (np.sin(angles) @ SHARES)
        state[:, self._still] = _CENTRE[self._still]
        state[:, 3] += self._yaw[0] + self._yaw[1] * times_s
        return np.concatenate([state[:, :3], looking(state[:, 3:])], axis=1)
