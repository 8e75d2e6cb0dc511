"""Augmentation by camera rotation: the homography matches the label."""

import dataclasses
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.camera import Camera
from cvo_export.data.augment import (
    AugmentConfig,
    augmented,
    blur,
    change_light,
    noisy_copy,
    rotate_camera,
)
from cvo_export.datasets import Intrinsics, PoseDataset, open_dataset
from cvo_export.scene.room import room
from cvo_export.training.features import ModelImages, cached_copies
from cvo_export.training.material import shared_folder
from cvo_export.training.run import decode_config

from .conftest import DATASET, tiny_config

SIZE = (320, 240)
K = Intrinsics(292.5, 292.5, 159.5, 119.5)
CAMERA = Camera(width=320, height=240, **K._asdict())
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
    found = rotate_camera(image, CAMERA, q_camera).astype(int)
    wrong = rotate_camera(image, CAMERA, geometry.quaternion_conjugate(q_camera)).astype(int)
    middle = np.s_[60:180, 80:240]
    right = np.abs(found - expected)[middle].mean()
    assert right < 4.0
    assert right < 0.35 * np.abs(image.astype(int) - expected)[middle].mean()
    assert right < 0.35 * np.abs(wrong - expected)[middle].mean()


def test_augmented_label_is_the_pose_times_the_turn_and_keeps_the_position():
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    pose = np.concatenate([[1.0, 2.0, 3.0], LOOKING])
    generator = np.random.default_rng(1)
    _, found = augmented(image, pose, CAMERA, AugmentConfig(6.0, 0.0), generator)
    np.testing.assert_array_equal(found[:3], pose[:3])
    turn = geometry.quaternion_multiply(geometry.quaternion_conjugate(pose[3:]), found[3:])
    expected = np.deg2rad(6.0) * np.random.default_rng(1).standard_normal(3)
    np.testing.assert_allclose(geometry.quaternion_log(turn), expected, atol=1e-9)


def test_no_strength_changes_nothing():
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    pose = np.concatenate([[1.0, 2.0, 3.0], LOOKING])
    config = AugmentConfig(6.0, 1.0).graded(0.0)
    found, same = augmented(image, pose, CAMERA, config, np.random.default_rng(0))
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


def test_a_turned_lens_sees_what_the_turned_rays_meet():
    """With distortion, each pixel of the turned image shows the old pixel on its turned ray."""
    lens = msgspec.structs.replace(
        CAMERA, distortion="radial_tangential", coefficients=(-0.25, 0.06, 1e-3, -5e-4)
    )
    # The image of coordinates: its value is where a pixel was.
    y, x = np.mgrid[: lens.height, : lens.width]
    image = np.stack([x / 2, y, np.zeros_like(x)], axis=-1).astype(np.uint8)
    q_camera = geometry.quaternion_exp([0.03, -0.04, 0.05])
    found = rotate_camera(image, lens, q_camera, zoom=1.1).astype(float)
    pixels = np.array([[160.0, 120.0], [200.0, 90.0], [120.0, 150.0]])
    rays = lens.zoomed(1.1).rays(pixels)
    ahead = np.column_stack([rays, np.ones(3)]) @ geometry.quaternion_to_matrix(q_camera).T
    expected = lens.project(ahead)
    for (column, row), (old_x, old_y) in zip(pixels.astype(int), expected, strict=True):
        assert found[row, column, 0] == pytest.approx(old_x / 2, abs=1.0)
        assert found[row, column, 1] == pytest.approx(old_y, abs=1.0)


def test_a_zoomed_image_is_what_a_zoomed_camera_renders():
    pose = np.concatenate([[0.0, 0.0, 1.3], LOOKING])
    image = room().render(pose, K, SIZE)
    zoomed = Intrinsics(1.2 * K.fx, 1.2 * K.fy, K.cx, K.cy)
    expected = room().render(pose, zoomed, SIZE).astype(int)
    found = rotate_camera(image, CAMERA, np.array([0.0, 0.0, 0.0, 1.0]), 1.2).astype(int)
    assert np.abs(found - expected).mean() < 0.35 * np.abs(image.astype(int) - expected).mean()


def test_every_second_copy_has_the_cameras_own_focal_length():
    zooms = AugmentConfig(zoom=0.2).zooms(8)
    assert zooms[0::4] == pytest.approx([1.0, np.exp(-0.1), np.exp(-0.2)])
    assert zooms[1::2] == (1.0,) * 4
    assert zooms[2] == pytest.approx(np.exp(0.05))
    assert set(AugmentConfig().zooms(5)) == {1.0}


def test_blur_keeps_the_mean_and_every_third_image_has_it():
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    blurred = [blur(image, 6.0, np.random.default_rng(seed)) for seed in range(300)]
    changed = [not np.array_equal(each, image) for each in blurred]
    assert 70 < sum(changed) < 130
    assert np.mean(blurred) == pytest.approx(image.mean(), rel=0.02)


# -- noise --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model_images():
    """Model inputs of a quarter of the camera's pixels."""
    generator = np.random.default_rng(0)
    coarse = generator.integers(60, 190, (12, 6, 8, 3)).astype(np.uint8)
    frames = [cv2.resize(each, (64, 48), interpolation=cv2.INTER_CUBIC) for each in coarse]
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (12, 1))
    names = tuple(map(str, range(12)))
    dataset = PoseDataset("noise", poses, np.zeros(12, int), ("one",), names, frames.__getitem__)
    return ModelImages(dataset, np.arange(12), 24, 32, "none")


def copies_of(images, folder, noise, copies=4, seed=3):
    still = AugmentConfig(rotation_deg=0.0, light=0.0)
    found, _ = cached_copies(
        folder, images, lambda image: image, still, copies, seed, lambda *_: None, noise
    )
    return found.astype(int)


def test_a_share_of_the_copies_has_noise_and_the_first_copy_none(model_images, tmp_path):
    clean = model_images.images.astype(int)
    without = copies_of(model_images, tmp_path / "without", 0.0)
    np.testing.assert_array_equal(without, np.broadcast_to(clean, without.shape))
    half = copies_of(model_images, tmp_path / "half", 0.5, copies=20)
    np.testing.assert_array_equal(half[0], clean)
    changed = (half[1:] != clean).any(axis=(2, 3, 4))
    # Four deviations of a binomial of 240.
    assert abs(changed.mean() - 0.5) < 0.13
    again = copies_of(model_images, tmp_path / "again", 0.5)
    np.testing.assert_array_equal(again, half[:5])
    whole = copies_of(model_images, tmp_path / "whole", 1.0)
    assert (whole[1:] != clean).any(axis=(2, 3, 4)).all()
    other = copies_of(model_images, tmp_path / "other", 1.0, seed=4)
    assert (other[1:] != whole[1:]).any()


def test_noise_has_the_size_of_the_cameras_pixels():
    grey = np.full((120, 160, 3), 128, np.uint8)
    spread = []
    for pixels in (1.0, 4.0):
        copies = [noisy_copy(grey, pixels, np.random.default_rng(seed)) for seed in range(40)]
        assert {each.shape for each in copies} == {grey.shape}
        spread.append([np.diff(each.astype(float), axis=1).std() for each in copies])
    # Averages of 16 camera pixels have a quarter of their deviation; the kinds are the same.
    fine, coarse = np.array(spread)
    grainy = (fine > 10.0) & (coarse < 0.5 * fine)
    assert grainy.sum() >= 10
    np.testing.assert_allclose(coarse[grainy] / fine[grainy], 0.25, atol=0.08)


def test_features_with_noise_are_cached_apart_and_configurations_without_it_are_as_before():
    plain = tiny_config()
    changed = dataclasses.replace(plain, noise=0.5)
    assert "noise" not in msgspec.json.decode(msgspec.json.encode(plain))
    assert decode_config(msgspec.json.encode(changed)).noisy == 0.5
    assert plain.noisy == 0.0
    images = ModelImages(open_dataset(DATASET), np.arange(2), 48, 64, "none")
    assert shared_folder(Path(), plain, "0", images) != shared_folder(Path(), changed, "0", images)
