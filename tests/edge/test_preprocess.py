"""The resize is exact; conversions are defined."""

import hashlib

import cv2
import numpy as np
import pytest

from cvo_edge.input import preprocess


def noise(height, width, channels=3, dtype=np.uint8):
    shape = (height, width, channels) if channels else (height, width)
    return np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape).astype(dtype)


def test_halving_is_the_rounded_mean_of_two_by_two():
    image = noise(64, 96)
    blocks = image.reshape(32, 2, 48, 2, 3).astype(int).sum(axis=(1, 3))
    np.testing.assert_array_equal(preprocess.halved(image, 32, 48), (blocks + 2) // 4)


def test_resize_gives_these_very_bytes_on_every_machine():
    image = preprocess.selftest_image(480, 640)
    assert hashlib.sha256(image.tobytes()).hexdigest()[:16] == "530ba5de5ff67b36"
    found = preprocess.model_input(image, 192, 256, "none")
    assert found.shape == (1, 192, 256, 3)
    assert found.flags.c_contiguous
    assert hashlib.sha256(found.tobytes()).hexdigest()[:16] == "f69fc097e2dd4112"


@pytest.mark.parametrize("size", [(240, 320), (241, 319), (130, 500), (64, 64)])
def test_the_linear_step_is_the_exact_one_of_opencv(size):
    image = noise(*size)
    found = preprocess.model_input(image, 192, 256, "none")[0, ..., ::-1]
    expected = cv2.resize(image, (256, 192), interpolation=cv2.INTER_LINEAR_EXACT)
    np.testing.assert_array_equal(found, expected)


def test_a_constant_image_stays_constant():
    image = np.full((301, 407, 3), (10, 20, 30), dtype=np.uint8)
    found = preprocess.model_input(image, 48, 64, "none")
    assert (found == [30, 20, 10]).all()  # RGB of BGR


def test_defined_conversions():
    grey = noise(40, 50, 0)
    np.testing.assert_array_equal(preprocess.to_bgr8(grey), np.repeat(grey[..., None], 3, axis=2))
    np.testing.assert_array_equal(preprocess.to_bgr8(grey[..., None]), preprocess.to_bgr8(grey))
    bgra = noise(40, 50, 4)
    np.testing.assert_array_equal(preprocess.to_bgr8(bgra), bgra[..., :3])
    deep = noise(40, 50, 3, np.uint16)
    np.testing.assert_array_equal(preprocess.to_bgr8(deep), deep >> 8)


@pytest.mark.parametrize(
    "bad",
    [
        None,
        "image",
        np.zeros((40, 50, 3), np.float32),
        np.zeros((40, 50, 2), np.uint8),
        np.zeros((0, 0, 3), np.uint8),
        np.zeros((8, 50, 3), np.uint8),
        np.zeros(7, np.uint8),
    ],
)
def test_what_is_no_image_is_none(bad):
    assert preprocess.to_bgr8(bad) is None
