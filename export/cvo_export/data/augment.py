"""Augmentation with exact labels: rotations and zooms of the camera, light and motion blur.

When a camera only rotates, the same rays pass through other pixels. With ``R' = R A`` (R the
camera-to-world rotation, A a rotation in the camera frame), the new image is the old one warped by
the homography K A^T K^-1, independently of the scene's depth; the pixels of a lens with distortion
follow its model. Position cannot be augmented this way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.camera import Camera
from cvo_export.data.noise import KINDS, drawn
from cvo_export.scene.sensor import streak

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class AugmentConfig:
    """Greatest strength of the changes to a training image.

    The strength grows from copy to copy, up to the full strength in the last one. Weak changes
    keep a network precise between neighbouring frames; strong changes help it generalise to new
    sequences. Data sets differ in which they need, and graded copies provide both.

    Attributes
    ----------
    rotation_deg
        Standard deviation of the rotation vector, per axis of the camera.
    light
        Scale of the changes of gain, gamma, colour, blur and noise; 0 disables them, 1 is normal.
    motion_blur
        Greatest length of the blur of every third copy, in percent of the image's width.
    zoom
        Greatest change of the focal length, as a logarithm; copies alternate between longer and
        shorter ones. Only for methods that know each copy's camera.
    """

    rotation_deg: float = 6.0
    light: float = 1.0
    motion_blur: float = 0.0
    zoom: float = 0.0

    def graded(self, share: float) -> AugmentConfig:
        """Return a configuration with this share, 0 to 1, of the strength."""
        return AugmentConfig(
            share * self.rotation_deg,
            share * self.light,
            share * self.motion_blur,
            share * self.zoom,
        )

    def zooms(self, copies: int) -> tuple[float, ...]:
        """Return the focal length of each copy as a multiple; the first, unchanged, has 1.

        Every second copy keeps 1, too, for networks that learn one camera.
        """
        logs = [
            0.0 if n % 2 else (n % 4 - 1.0) * self.zoom * n / max(1, copies)
            for n in range(copies + 1)
        ]
        return tuple(math.exp(value) for value in logs)


def rotate_camera(
    image: Image, camera: Camera, q_camera: NDArray[np.float64], zoom: float = 1.0
) -> Image:
    """Return the image (height, width, 3) that the camera would see rotated by ``q_camera`` (4,).

    ``R_new = R @ A``, where A is the quaternion's rotation in the camera frame; the new camera has
    ``zoom`` times the focal length. Pixels outside the original image are filled by reflection at
    its border.
    """
    A = geometry.quaternion_to_matrix(q_camera)
    new = camera.zoomed(zoom)
    if camera.distortion != "none":
        # A ray d in the new camera is A d in the old one.
        x, y = camera.project(_rays(new) @ A.T).astype(np.float32).T
        shape = image.shape[:2]
        turned = cv2.remap(
            image,
            x.reshape(shape),
            y.reshape(shape),
            cv2.INTER_LINEAR,
            None,
            cv2.BORDER_REFLECT_101,
        )
        return np.asarray(turned, dtype=np.uint8)
    new_to_old = camera.matrix @ A @ np.linalg.inv(new.matrix)
    size = (image.shape[1], image.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    turned = cv2.warpPerspective(
        image, new_to_old, size, flags=flags, borderMode=cv2.BORDER_REFLECT_101
    )
    return np.asarray(turned, dtype=np.uint8)


@lru_cache(maxsize=64)
def _rays(camera: Camera) -> NDArray[np.float64]:
    """Return the rays (height * width, 3) through all pixels of a camera."""
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.column_stack([x.ravel(), y.ravel()]))
    # Pixels beyond the lens model show what is seen straight ahead.
    return np.column_stack([np.nan_to_num(rays), np.ones(len(rays))])


def change_light(image: Image, strength: float, generator: np.random.Generator) -> Image:
    """Apply random gain, gamma, colour balance, blur and noise; keeps shape and type."""
    gamma = np.exp(generator.normal(0.0, 0.15 * strength))
    gain = np.exp(generator.normal(0.0, 0.15 * strength)) * np.exp(
        generator.normal(0.0, 0.04 * strength, 3)
    )
    offset = generator.normal(0.0, 4.0 * strength)
    curve = 255.0 * (np.arange(256)[:, None] / 255.0) ** gamma * gain + offset
    changed = cv2.LUT(image, np.clip(curve, 0, 255).astype(np.uint8)[None])
    if generator.random() < 0.3 * strength:
        changed = cv2.GaussianBlur(changed, (0, 0), generator.uniform(0.3, 1.2))
    sigma = generator.uniform(0.0, 8.0 * strength)
    noise = generator.standard_normal(image.shape, dtype=np.float32) * np.float32(sigma)
    return np.asarray(cv2.add(changed, noise, dtype=cv2.CV_8U), dtype=np.uint8)


def blur(image: Image, longest_px: float, generator: np.random.Generator) -> Image:
    """Blur every third image, by chance, along a straight path of at most ``longest_px``."""
    if generator.random() > 1.0 / 3.0:
        return image
    length, angle = generator.uniform(0.0, longest_px), generator.uniform(0.0, math.pi)
    shift = length * np.array([math.cos(angle), math.sin(angle)])
    kernel = streak(shift, 2 * math.ceil(length) + 1)
    blurred = cv2.filter2D(image, cv2.CV_8U, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=np.uint8)


def noisy_copy(image: Image, pixels: float, generator: np.random.Generator) -> Image:
    """Degrade a model input (height, width, 3) by one of the study's noises, at a drawn strength.

    ``pixels`` is the number of pixels of the camera image per pixel of the input along a side: the
    noise is added to an image of the camera's size, as resizing averages part of it out.
    """
    names = tuple(KINDS)
    noise = drawn(names[generator.integers(len(names))], generator)
    height, width = image.shape[:2]
    size = round(max(1.0, pixels) * width), round(max(1.0, pixels) * height)
    large = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
    degraded = noise.degrade(large, generator)
    small = cv2.resize(degraded, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def augmented(
    image: Image,
    pose: NDArray[np.float64],
    camera: Camera | None,
    config: AugmentConfig,
    generator: np.random.Generator,
    zoom: float = 1.0,
) -> tuple[Image, NDArray[np.float64]]:
    """Return one changed copy of a model input (height, width, 3) and its exact pose (7,).

    Without a camera, only light and blur change. ``zoom`` is the copy's focal length as a multiple
    of the camera's.
    """
    turned_pose = pose.copy()
    if camera is not None and (config.rotation_deg > 0 or zoom != 1.0):
        rotvec = np.deg2rad(config.rotation_deg) * generator.standard_normal(3)
        q_camera = geometry.quaternion_exp(rotvec)
        image = rotate_camera(image, camera, q_camera, zoom)
        turned_pose[3:] = geometry.quaternion_normalise(
            geometry.quaternion_multiply(pose[3:], q_camera)
        )
    if config.motion_blur > 0:
        image = blur(image, 0.01 * config.motion_blur * image.shape[1], generator)
    if config.light > 0:
        image = change_light(image, config.light, generator)
    return image, turned_pose
