"""Camera models: pixels and rays are inverse, and agree with OpenCV."""

import cv2
import msgspec
import numpy as np
import pytest

from cvo_edge.camera import Camera, cell_centres, checked_camera, read_camera
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


def test_a_pixel_beyond_the_fold_has_no_ray_of_the_far_branch():
    """r (1 - .4 r^2 + .05 r^4) has its first maximum, .651, at r = 1.03, and rises again."""
    folded = msgspec.structs.replace(
        PINHOLE, fx=500.0, distortion="radial_tangential", coefficients=(-0.4, 0.05, 0.0, 0.0)
    )
    radii = np.array([0.5, 0.64, 0.66, 0.9])
    rays = folded.rays(np.column_stack([320.0 + 500.0 * radii, np.full(4, 240.0)]))
    np.testing.assert_array_equal(np.isfinite(rays[:, 0]), [True, True, False, False])
    assert rays[1, 0] < 1.03


def test_lenses_that_no_camera_has_give_no_rays():
    generator = np.random.default_rng(1)
    pixels = generator.uniform((0, 0), (639, 479), (50, 2))
    for _ in range(100):
        for camera, count in ((FISHEYE, 4), (RATIONAL, 8)):
            absurd = tuple(generator.normal(0.0, 10.0 ** generator.uniform(-1, 4), count).tolist())
            rays = msgspec.structs.replace(camera, coefficients=absurd).rays(pixels)
            assert rays.shape == (50, 2)


@pytest.mark.parametrize(
    ("camera", "problem"),
    [
        ({"width": 640}, "expected a Camera, found dict"),
        (msgspec.structs.replace(PINHOLE, fx=0.0), "expected the intrinsics .* > 0"),
        (msgspec.structs.replace(PINHOLE, fx=float("nan")), "expected the intrinsics"),
        (msgspec.structs.replace(PINHOLE, width=1, height=1), "at least 16 pixels .* found 1x1"),
        (msgspec.structs.replace(PINHOLE, cx=9e5), "expected cx from -640 to 1280 pixels"),
        (
            msgspec.structs.replace(PINHOLE, width=100_000, height=100_000),
            "field of view of at most 170 degrees .* found 178.7",
        ),
    ],
)
def test_what_cannot_be_a_camera_is_refused(camera, problem):
    with pytest.raises(UsageError, match=f"camera: .*{problem}"):
        checked_camera(camera)


def test_numbers_of_numpy_are_numbers():
    values = {name: getattr(PINHOLE, name) for name in PINHOLE.__struct_fields__}
    values["width"], values["fx"] = np.int64(values["width"]), np.float32(values["fx"])
    assert checked_camera(Camera(**values)) == PINHOLE


def test_a_camera_file_may_be_a_link_and_no_folder(tmp_path):
    path = tmp_path / "camera.json"
    path.write_bytes(msgspec.json.encode(RADIAL))
    (tmp_path / "link.json").symlink_to(path)
    assert read_camera(tmp_path / "link.json") == RADIAL
    with pytest.raises(UsageError, match="expected a regular file, found a folder"):
        read_camera(tmp_path)


def test_a_camera_file_that_is_no_text_or_never_ends_is_refused(tmp_path):
    path = tmp_path / "camera.json"
    path.write_bytes(b'{"width": "\xff\xfe"}')
    with pytest.raises(UsageError, match=r"camera.json: expected JSON"):
        read_camera(path)
    path.write_bytes(b" " * 100_000)
    with pytest.raises(UsageError, match=r"camera.json: expected at most 65536 bytes"):
        read_camera(path)


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
