"""Augmentation by camera rotation: the homography matches the label."""

import cv2
import numpy as np
import pytest

from cvo_edge import geometry
from cvo_export.data.augment import (
    AugmentConfig,
    augmented,
    change_light,
    model_intrinsics,
    rotate_camera,
)
from cvo_export.datasets import Intrinsics
from cvo_export.scene.room import room

SIZE = (320, 240)
K = Intrinsics(292.5, 292.5, 159.5, 119.5)
MATRIX = np.array([[292.5, 0, 159.5], [0, 292.5, 119.5], [0, 0, 1]])
# A camera (x right, y down, z forward) that looks along +y of the world (z up).
LOOKING = geometry.matrix_to_quaternion(np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))


@pytest.mark.parametrize("rotvec", [[0.06, 0, 0], [0, 0.08, 0], [0, 0, 0.1], [0.04, -0.06, 0.05]])
def test_the_turned_image_is_what_a_turned_camera_renders(rotvec):
    pose = np.concatenate([[0.0, 0.0, 1.3], LOOKING])
    image = room().render(pose, K, SIZE)
    q_camera = geometry.quaternion_exp(rotvec)
    turned = pose.copy()
    turned[3:] = geometry.quaternion_multiply(pose[3:], q_camera)
    expected = room().render(turned, K, SIZE).astype(int)
    found = rotate_camera(image, MATRIX, q_camera).astype(int)
    wrong = rotate_camera(image, MATRIX, geometry.quaternion_conjugate(q_camera)).astype(int)
    middle = np.s_[60:180, 80:240]
    right = np.abs(found - expected)[middle].mean()
    assert right < 4.0
    assert right < 0.35 * np.abs(image.astype(int) - expected)[middle].mean()
    assert right < 0.35 * np.abs(wrong - expected)[middle].mean()


def test_augmented_label_is_the_pose_times_the_turn_and_keeps_the_position():
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    pose = np.concatenate([[1.0, 2.0, 3.0], LOOKING])
    generator = np.random.default_rng(1)
    _, found = augmented(image, pose, MATRIX, AugmentConfig(6.0, 0.0), generator)
    np.testing.assert_array_equal(found[:3], pose[:3])
    turn = geometry.quaternion_multiply(geometry.quaternion_conjugate(pose[3:]), found[3:])
    expected = np.deg2rad(6.0) * np.random.default_rng(1).standard_normal(3)
    np.testing.assert_allclose(geometry.quaternion_log(turn), expected, atol=1e-9)


def test_no_strength_changes_nothing():
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    pose = np.concatenate([[1.0, 2.0, 3.0], LOOKING])
    config = AugmentConfig(6.0, 1.0).graded(0.0)
    found, same = augmented(image, pose, MATRIX, config, np.random.default_rng(0))
    np.testing.assert_array_equal(found, image)
    np.testing.assert_array_equal(same, pose)


def test_light_changes_more_with_strength():
    image = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8), (0, 0), 3
    )
    means = [
        np.mean(
            [
                np.abs(change_light(image, s, np.random.default_rng(k)).astype(int) - image).mean()
                for k in range(20)
            ]
        )
        for s in (0.1, 0.5, 1.0)
    ]
    assert means == sorted(means)


def test_intrinsics_follow_resize_and_crop():
    """A ray passes through corresponding places of the camera image and the model input."""
    for shape, height, width, crop in (
        ((480, 640), 192, 256, "none"),
        ((480, 800), 192, 256, "centre"),
        ((480, 640), 120, 120, "none"),
    ):
        camera = Intrinsics(585.0, 580.0, 0.5 * shape[1], 0.48 * shape[0])
        found = model_intrinsics(camera, shape, height, width, crop)
        left = (shape[1] - min(shape[1], shape[0] * width // height)) // 2 if crop != "none" else 0
        cropped = shape[1] - 2 * left
        ray = np.array([0.1, -0.05, 1.0])
        pixel = np.array([camera.fx * 0.1 + camera.cx, camera.fy * -0.05 + camera.cy])
        # Coordinates in which pixel centres are at one half scale exactly.
        scaled = (pixel + 0.5 - [left, 0]) * [width / cropped, height / shape[0]] - 0.5
        np.testing.assert_allclose((found @ ray)[:2], scaled, atol=1e-9)
