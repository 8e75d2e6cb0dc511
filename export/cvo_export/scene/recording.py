"""One recording of a virtual camera: its path over time, its light and its noise."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from cvo_edge.geometry import quaternion_exp, quaternion_multiply
from cvo_export.scene.renderer import Floats, Image, Pinhole, Scene, as_image
from cvo_export.scene.sensor import Light, add_noise, motion_blur

_EXPOSURE_S = 1 / 200
# A hand's or a car's unrest: three sinusoids, whose amplitudes add up to one.
SHARES = np.array([0.5, 0.35, 0.15])
RATES_RAD_S = np.array([1.28, 2.72, 4.8])
_LEVEL = quaternion_exp([-math.pi / 2, 0, 0])  # looks along world y, with z up in the image
_AXES = np.array([[0, 0, 1], [1, 0, 0], [0, 0, 1]])


class Recording(ABC):
    """A path through a scene; all its random numbers follow from ``seed`` and ``number``."""

    frame_time_s: ClassVar[float]

    def __init__(self, seed: int, number: int) -> None:
        self._entropy = (seed, number)

    def rng(self, stream: int) -> np.random.Generator:
        """Return one of several independent generators: 0 for the path, n + 1 for frame n."""
        return np.random.default_rng((*self._entropy, stream))

    @property
    @abstractmethod
    def light(self) -> Light:
        """The light of this recording."""

    @abstractmethod
    def scene(self) -> Scene:
        """Return what the camera sees; painted at the first call."""

    @abstractmethod
    def poses(self, times_s: Floats) -> Floats:
        """Return ``T_world_camera`` at n times, shape (n, 7): tx ty tz, qx qy qz qw."""

    def photograph(self, frame: int, intrinsics: Pinhole, size: tuple[int, int]) -> Image:
        """Render a frame with this recording's blur, light and noise, (height, width, 3), BGR."""
        time_s = frame * self.frame_time_s
        opening, pose, closing = self.poses(time_s + _EXPOSURE_S * np.array([-0.5, 0.0, 0.5]))
        sharp = self.scene().render(pose, intrinsics, size)
        image = motion_blur(sharp, opening, pose, closing, intrinsics)
        self.light.shade(image, time_s, intrinsics)
        add_noise(image, self.rng(frame + 1))
        return as_image(image)


def looking(angles: Floats) -> Floats:
    """Return the rotations (n, 4), qx qy qz qw, of yaw, pitch and roll (n, 3) in rad.

    From right to left: roll about the optical axis, pitch about the camera's x axis (positive looks
    up), the level camera looking along world y, yaw about world z.
    """
    yaw, pitch, roll = (quaternion_exp(angles[:, [k]] * axis) for k, axis in enumerate(_AXES))
    tilt = quaternion_multiply(pitch, roll)
    return quaternion_multiply(yaw, quaternion_multiply(_LEVEL, tilt))
