"""Augmentation with exact labels: camera rotations and changes of light.

When a camera only rotates, the same rays pass through other pixels. With ``R' = R A`` (R the
camera-to-world rotation, A a rotation in the camera frame), the new image is the old one warped by
the homography K A^T K^-1, independently of the scene's depth. Position cannot be augmented this
way.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.input import preprocess
from cvo_export.datasets import Intrinsics

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
    """

    rotation_deg: float = 6.0
    light: float = 1.0

    def graded(self, share: float) -> AugmentConfig:
        """Return a configuration with this share, 0 to 1, of the strength."""
        return AugmentConfig(share * self.rotation_deg, share * self.light)


def model_intrinsics(
    intrinsics: Intrinsics, image_shape: tuple[int, ...], height: int, width: int, crop: str
) -> NDArray[np.float64]:
    """Return the camera matrix K (3, 3) of the model input, from the camera image's intrinsics.

    Pixel centres have integer coordinates, so scaling shifts the principal point by half pixels.
    """
    top, bottom, left, right = preprocess.crop_box(
        image_shape[0], image_shape[1], height, width, "centre" if crop == "centre" else "none"
    )
    sx, sy = width / (right - left), height / (bottom - top)
    K = np.eye(3)
    K[0] = sx * intrinsics.fx, 0.0, sx * (intrinsics.cx - left + 0.5) - 0.5
    K[1] = 0.0, sy * intrinsics.fy, sy * (intrinsics.cy - top + 0.5) - 0.5
    return K


def rotate_camera(image: Image, K: NDArray[np.float64], q_camera: NDArray[np.float64]) -> Image:
    """Return the image (height, width, 3) that the camera would see rotated by ``q_camera`` (4,).

    ``R_new = R @ A``, where A is the quaternion's rotation in the camera frame. Pixels outside the
    original image are filled by reflection at its border.
    """
    A = geometry.quaternion_to_matrix(q_camera)
    # A ray d in the new camera is A d in the old one, so this maps new pixels to old pixels.
    new_to_old = K @ A @ np.linalg.inv(K)
    size = (image.shape[1], image.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    turned = cv2.warpPerspective(
        image, new_to_old, size, flags=flags, borderMode=cv2.BORDER_REFLECT_101
    )
    return np.asarray(turned, dtype=np.uint8)


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


def augmented(
    image: Image,
    pose: NDArray[np.float64],
    K: NDArray[np.float64] | None,
    config: AugmentConfig,
    generator: np.random.Generator,
) -> tuple[Image, NDArray[np.float64]]:
    """Return one changed copy of a model input (height, width, 3) and its exact pose (7,).

    Without a camera matrix, only the light changes.
    """
    turned_pose = pose.copy()
    if K is not None and config.rotation_deg > 0:
        rotvec = np.deg2rad(config.rotation_deg) * generator.standard_normal(3)
        q_camera = geometry.quaternion_exp(rotvec)
        image = rotate_camera(image, K, q_camera)
        turned_pose[3:] = geometry.quaternion_normalise(
            geometry.quaternion_multiply(pose[3:], q_camera)
        )
    if config.light > 0:
        image = change_light(image, config.light, generator)
    return image, turned_pose
