"""What the model sees of an image: its place and its camera agree with its pixels."""

import msgspec
import numpy as np
import pytest

from cvo_edge.camera import Camera
from cvo_edge.errors import UsageError
from cvo_edge.input.preprocess import viewed
from cvo_edge.input.view import crop_view, matched_view, seen_camera

CAMERA = Camera(width=640, height=480, fx=585.0, fy=580.0, cx=318.0, cy=241.0)
LEARNED = crop_view(480, 640, 192, 256, "none").camera(CAMERA)
RADIAL = msgspec.structs.replace(
    CAMERA, distortion="radial_tangential", coefficients=(-0.283, 0.074, 2e-4, 1.8e-5)
)
OTHERS = [
    CAMERA.zoomed(1.3),
    CAMERA.zoomed(0.7),
    CAMERA.cropped(30, 430, 10, 500),
    CAMERA.scaled(317, 211),
    msgspec.structs.replace(RADIAL, fx=700.0),
    Camera(width=1920, height=1080, fx=1500.0, fy=1500.0, cx=950.0, cy=530.0),
]


@pytest.mark.parametrize(
    ("size", "box"),
    [
        ((480, 640), (0, 480, 0, 640)),
        ((480, 800), (0, 480, 80, 720)),
        ((600, 640), (60, 540, 0, 640)),
    ],
)
def test_centre_crop_is_the_largest_of_the_inputs_shape(size, box):
    view = crop_view(*size, 192, 256, "centre")
    assert view.part == box
    assert view.place == (0, 192, 0, 256)


@pytest.mark.parametrize("camera", [CAMERA, CAMERA.scaled(320, 240), CAMERA.zoomed(1.005)])
def test_the_learned_camera_fills_the_input(camera):
    view = matched_view(camera, LEARNED, "none")
    assert view == crop_view(camera.height, camera.width, 192, 256, "none")


@pytest.mark.parametrize("camera", OTHERS)
@pytest.mark.parametrize("crop", ["none", "centre"])
def test_another_camera_gets_the_learned_focal_lengths(camera, crop):
    view = matched_view(camera, LEARNED, crop)
    seen = view.camera(camera)
    # Sides are whole pixels.
    assert seen.fx == pytest.approx(LEARNED.fx, rel=0.5 / min(view.place.shape))
    assert seen.fy == pytest.approx(LEARNED.fy, rel=0.5 / min(view.place.shape))


@pytest.mark.parametrize("camera", [CAMERA, *OTHERS])
@pytest.mark.parametrize("ray", [(0.0, 0.0), (0.2, -0.1), (-0.15, 0.18)])
def test_the_seen_camera_shows_a_ray_where_the_input_does(camera, ray):
    """The centroid of a blob in the input is where the seen camera projects it."""
    point = np.array([[*ray, 1.0]])
    x, y = camera.project(point)[0]
    columns, rows = np.arange(camera.width) - x, np.arange(camera.height) - y
    size = 0.02 * camera.fx
    blob = 255 * np.outer(np.exp(-((rows / size) ** 2)), np.exp(-((columns / size) ** 2)))
    image = np.repeat(blob.round().astype(np.uint8)[..., np.newaxis], 3, axis=2)
    view = matched_view(camera, LEARNED, "none")
    found = viewed(image, view)[..., 0].astype(float)
    v, u = np.mgrid[:192, :256]
    centroid = np.array([(u * found).sum(), (v * found).sum()]) / found.sum()
    np.testing.assert_allclose(centroid, view.camera(camera).project(point)[0], atol=0.05)


@pytest.mark.parametrize("focal", [0.5, 1e-5])
def test_a_camera_of_which_the_model_would_see_a_few_pixels_is_refused(focal):
    absurd = msgspec.structs.replace(CAMERA, fx=focal, fy=focal)
    with pytest.raises(UsageError, match="more, found 1x1 pixels with fx"):
        seen_camera(absurd, LEARNED, "none")


def test_the_padding_repeats_the_edge():
    camera = CAMERA.zoomed(2.0)
    image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    found = viewed(image, matched_view(camera, LEARNED, "none"))
    inside = found[48:144, 64:192]
    np.testing.assert_array_equal(found, np.pad(inside, ((48, 48), (64, 64), (0, 0)), mode="edge"))


def test_only_cells_that_lie_within_the_image_have_rays():
    camera = CAMERA.zoomed(1.25)
    seen = seen_camera(camera, LEARNED, "none")
    shown = np.isfinite(seen.rays((12, 16))[:, 0]).reshape(12, 16)
    # The image fills 154 of 192 rows from row 19, 205 of 256 columns from column 25.
    assert seen.place == (19, 173, 25, 230)
    np.testing.assert_array_equal(np.flatnonzero(shown.any(axis=1)), np.arange(2, 10))
    np.testing.assert_array_equal(np.flatnonzero(shown.any(axis=0)), np.arange(2, 14))
    np.testing.assert_array_equal(shown, np.outer(shown.any(axis=1), shown.any(axis=0)))


@pytest.mark.parametrize("crop", ["none", "centre"])
def test_whether_the_network_has_learned_the_camera(crop):
    own = crop_view(CAMERA.height, CAMERA.width, 192, 240, crop).camera(CAMERA)
    # The middle of a wider image is an image of the learned camera.
    for camera in (CAMERA, CAMERA.scaled(320, 240), CAMERA.zoomed(1.004), CAMERA.zoomed(0.8)):
        assert seen_camera(camera, own, crop).learned
    shifted = msgspec.structs.replace(CAMERA, cx=350.0)
    for camera in (CAMERA.zoomed(1.02), shifted, RADIAL, CAMERA.cropped(0, 400, 0, 640)):
        assert not seen_camera(camera, own, crop).learned


def test_a_narrower_camera_fills_less_of_the_input():
    learned = Camera(width=256, height=192, fx=200.0, fy=200.0, cx=127.5, cy=95.5)
    whole = seen_camera(learned, learned, "none")
    narrow = seen_camera(learned.cropped(19, 173, 26, 230), learned, "none")
    assert whole.filled == 1.0
    assert narrow.filled == pytest.approx(154 * 204 / (192 * 256))
