"""Drives: a camera on a car that goes round the block, lap after lap."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from cvo_export.scene.recording import RATES_RAD_S, SHARES, Recording, looking
from cvo_export.scene.renderer import Floats, Scene
from cvo_export.scene.sensor import Light
from cvo_export.scene.street import HALF_M, street

HEIGHT_M = 1.6
_STEP_M = 0.02
_CORNER_M = 22.0  # length of the path on which the car turns by 90 degrees
_SPEED_M_S, _CORNER_SPEED_M_S = 9.0, 4.5
_RATE = 0.85, 1.15  # of a drive's speed, to these
_LANE_M, _WEAVE_M = 0.7, 0.35  # largest offset from the middle line, and of the weaving about it
_WEAVE_LENGTH_M = 25.0, 60.0
_SHAKE = np.radians([0.6, 0.8, 0.6])  # largest yaw, pitch and roll of the camera on the car


class _Lap(NamedTuple):
    """The middle line of the street at every second centimetre, from the middle of its south side.

    ``place`` (n, 2) metres, ``heading`` (n,) rad from x, ``curvature`` (n,) 1/m, ``time_s`` (n,) at
    the usual speed, ``distance`` (n,) metres. The last row is the first one, a full turn later.
    """

    place: Floats
    heading: Floats
    curvature: Floats
    time_s: Floats
    distance: Floats


@functools.cache
def lap() -> _Lap:
    """Return the closed path; its curvature and speed change smoothly."""
    steps = round(_CORNER_M / _STEP_M)
    step_m = _CORNER_M / steps
    bend = 1 - np.cos(2 * math.pi * (np.arange(steps) + 0.5) / steps)  # of mean 1
    bend *= math.pi / 2 / _CORNER_M
    before = np.cumsum(bend) * step_m - bend * step_m / 2
    # How far before the crossing of the middle lines the car begins to turn.
    cut_m = float(np.cos(before).sum() * step_m)
    half = [round((side - cut_m) / step_m) for side in HALF_M]
    straight = [np.zeros(count) for count in (half[0], 2 * half[1], 2 * half[0], 2 * half[1])]
    parts = [part for line in straight for part in (line, bend)]
    curvature = np.concatenate([*parts, np.zeros(half[0])])
    heading = np.concatenate([[0.0], np.cumsum(curvature) * step_m])
    middle = (heading[1:] + heading[:-1]) / 2
    ahead = np.stack([np.cos(middle), np.sin(middle)], axis=1) * step_m
    place = np.concatenate([[[0.0, -HALF_M[1]]], ahead]).cumsum(axis=0)
    speed = _SPEED_M_S - (_SPEED_M_S - _CORNER_SPEED_M_S) * curvature / bend.max()
    time_s = np.concatenate([[0.0], np.cumsum(step_m / speed)])
    curvature = np.append(curvature, curvature[0])
    distance = np.arange(len(heading), dtype=np.float64) * step_m
    return _Lap(place, heading, curvature, time_s, distance)


class Drive(Recording):
    """A drive of any length; it starts anywhere on the lap, in a lane of its own."""

    frame_time_s = 1 / 5

    def __init__(self, seed: int, number: int) -> None:
        super().__init__(seed, number)
        rng = self.rng(0)
        self._start = rng.uniform()
        self._speed = rng.uniform(*_RATE)
        self._lane = rng.uniform(-_LANE_M, _LANE_M)
        self._weave = 2 * math.pi / rng.uniform(*_WEAVE_LENGTH_M)
        self._weave_phase = rng.uniform(0, 2 * math.pi)
        self._shake_rate = RATES_RAD_S * rng.uniform(0.8, 1.25, (3, 3))
        self._shake_phase = rng.uniform(0, 2 * math.pi, (3, 3))
        self._light = Light(rng)

    @property
    def light(self) -> Light:
        """The light of this drive."""
        return self._light

    def scene(self) -> Scene:
        """Return the street."""
        return street()

    def poses(self, times_s: Floats) -> Floats:
        """Return ``T_world_camera`` at n times, shape (n, 7): tx ty tz, qx qy qz qw."""
        path = lap()
        laps = self._start + self._speed * times_s / path.time_s[-1]
        at = (laps % 1.0) * path.time_s[-1]
        x, y, heading, curvature, distance = (
            np.interp(at, path.time_s, values)
            for values in (*path.place.T, path.heading, path.curvature, path.distance)
        )
        # The car swings about its lane; it faces the way it goes, which differs from the street's.
        swing = self._weave * (distance + np.floor(laps) * path.distance[-1]) + self._weave_phase
        left = self._lane + _WEAVE_M * np.sin(swing)
        leftwards = _WEAVE_M * self._weave * np.cos(swing)
        place = (x - left * np.sin(heading), y + left * np.cos(heading), np.full_like(x, HEIGHT_M))
        shake = self._shake_rate * times_s[:, None, None] + self._shake_phase
        angles = _SHAKE * (np.sin(shake) @ SHARES)
        angles[:, 0] += heading + np.arctan2(leftwards, 1 - curvature * left) - math.pi / 2
        return np.concatenate([np.stack(place, axis=1), looking(angles)], axis=1)
