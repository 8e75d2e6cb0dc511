"""Camera models: pixels and rays are inverse, and agree with OpenCV."""

import cv2
import msgspec
import numpy as np
import pytest

from cvo_edge.camera import Camera, cell_centres, read_camera
from cvo_edge.errors import UsageError

PINHOLE = Camera(width=640, height=480, fx=585.0, fy=580.0, cx=320.0, cy=240.0)
RADIAL = msgspec.structs.replace(
    PINHOLE, distortion="radial_tangential", coefficients=(-0.283, 0.074, 2e-4, 1.8e-5)
)
RATIONAL = msgspec.structs.replace(
    RADIAL, coefficients=(0.2, -0.1, 1e-3, -5e-4, 0.03, 0.25, -0.08, 0.02)
)
FISHEYE = msgspec.structs.replace(
    PINHOLE, fx=300.0, fy=301.0, distortion="equidistant", coefficients=(0.01, -0.02, 0.005, -0.001)
)


def points(generator, spread):
    xy = generator.uniform(-spread, spread, (200, 2))
    return np.column_stack([xy, np.ones(200)]) * generator.uniform(0.5, 5.0, (200, 1))


@pytest.mark.parametrize("camera", [PINHOLE, RADIAL, RATIONAL])
def test_projection_is_opencvs(camera):
    p = points(np.random.default_rng(0), 0.5)
    expected, _ = cv2.projectPoints(
        p, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.coefficients or [0.0] * 4)
    )
    np.testing.assert_allclose(camera.project(p), expected[:, 0], atol=1e-9)


def test_fisheye_projection_is_opencvs():
    p = points(np.random.default_rng(0), 2.0)
    expected, _ = cv2.fisheye.projectPoints(
        p[:, np.newaxis], np.zeros(3), np.zeros(3), FISHEYE.matrix, np.array(FISHEYE.coefficients)
    )
    np.testing.assert_allclose(FISHEYE.project(p), expected[:, 0], atol=1e-6)


@pytest.mark.parametrize("camera", [PINHOLE, RADIAL, RATIONAL, FISHEYE])
def test_rays_undo_the_projection(camera):
    pixels = np.random.default_rng(0).uniform((0, 0), (639, 479), (500, 2))
    rays = camera.rays(pixels)
    assert np.isfinite(rays).all()
    again = camera.project(np.column_stack([rays, np.ones(len(rays))]))
    np.testing.assert_allclose(again, pixels, atol=1e-6)


def test_a_pixel_beyond_the_lens_model_has_no_ray():
    """r (1 - 0.28 r^2) has its maximum at r = 1.09: no ray has an image further out."""
    steep = msgspec.structs.replace(RADIAL, coefficients=(-0.28, 0.0, 0.0, 0.0))
    rays = steep.rays([[320.0, 240.0], [320.0 + 0.7 * 585.0, 240.0], [320.0 + 0.9 * 585.0, 240.0]])
    assert np.isfinite(rays[:2]).all()
    assert np.isnan(rays[2]).all()


def test_cell_centres_are_the_means_of_their_pixels():
    y, x = np.mgrid[:48, :64]
    pixels = np.stack([x, y], axis=-1).reshape(3, 16, 4, 16, 2)
    np.testing.assert_allclose(
        cell_centres(48, 64, (3, 4)), pixels.mean(axis=(1, 3)).reshape(12, 2)
    )


def test_a_camera_file_is_read(tmp_path):
    path = tmp_path / "camera.json"
    path.write_bytes(msgspec.json.encode(RADIAL))
    assert read_camera(path) == RADIAL


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"width: 640", "JSON is malformed"),
        (b'{"width": 640}', "missing required field"),
        (msgspec.json.encode({**msgspec.to_builtins(PINHOLE), "fx": -1.0}), "Expected `float` > 0"),
        (msgspec.json.encode({**msgspec.to_builtins(PINHOLE), "skew": 0.0}), "unknown field"),
        (
            msgspec.json.encode({**msgspec.to_builtins(PINHOLE), "coefficients": [0.1]}),
            "expected 0 coefficients for distortion none, found 1",
        ),
    ],
)
def test_a_wrong_camera_file_is_refused(tmp_path, content, problem):
    path = tmp_path / "camera.json"
    path.write_bytes(content)
    with pytest.raises(UsageError, match=f"camera.json: expected JSON such as .*{problem}"):
        read_camera(path)


def test_a_missing_camera_file_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"none.json: no such file"):
        read_camera(tmp_path / "none.json")
