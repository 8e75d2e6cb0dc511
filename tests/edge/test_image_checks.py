"""Images of another shape, size or colour than those of the calibration."""

import cv2
import msgspec
import numpy as np
import pytest

from cvo_edge import CalibrationFileError, Odometer, Reason, Status, UsageError, open_source
from cvo_edge.bundle.format import ImageSpec
from cvo_edge.bundle.rules import check_rules
from cvo_edge.camera import Camera, read_camera
from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.input.frame_checks import Look
from cvo_edge.input.image_checks import has_colour, similar
from cvo_edge.input.preprocess import model_input
from cvo_edge.programs.inspect import inspect_lines

CAMERA = Camera(width=320, height=240, fx=292.5, fy=292.5, cx=159.5, cy=119.5)
COLOUR = ImageSpec(width=320, height=240, colour=True)
GREY = ImageSpec(width=320, height=240, colour=False)


@pytest.fixture(scope="module")
def images(clip_dir):
    return [frame.image for frame in open_source(str(clip_dir))][:20]


@pytest.fixture(scope="module")
def stated(bundle_dir):
    """Build the demonstration bundle with a description of its images and a camera."""
    bundle = read_bundle(bundle_dir)

    def build(images=COLOUR, camera=None, **values):
        values |= {"images": images, "camera": camera}
        return Bundle.of(msgspec.structs.replace(bundle.calibration, **values), bundle.model)

    return build


@pytest.fixture(scope="module")
def odometer(stated):
    with Odometer(stated(), threads=1) as odometer:
        yield odometer


def resized(image, width, height):
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def grey(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def i420(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420)


def nv12(image):
    planes = i420(image)
    chroma = planes[240:].reshape(2, -1).T.reshape(120, 320)
    return np.concatenate([planes[:240], chroma])


def yuyv(image):
    luma, chroma = grey(image), cv2.cvtColor(image, cv2.COLOR_BGR2YUV)[:, ::2, 1:]
    return np.dstack([luma, chroma.reshape(240, 320)])


CAMERA_DIFFERS = (Status.DEGRADED, (Reason.CAMERA_DIFFERS,))
IMAGE_GREY = (Status.DEGRADED, (Reason.IMAGE_GREY,))
TOLD = (Status.OK, (Reason.IMAGE_RESIZED,))
CHANGES = {
    "wide, rows cut": (lambda i: resized(i, 1280, 960)[120:840], CAMERA_DIFFERS),
    "square": (lambda i: resized(i, 640, 640), CAMERA_DIFFERS),
    "turned": (lambda i: np.rot90(i), CAMERA_DIFFERS),
    "thumbnail": (lambda i: resized(i, 32, 24), (Status.DEGRADED, (Reason.IMAGE_TOO_SMALL,))),
    "twice the size": (lambda i: resized(i, 640, 480), TOLD),
    "the model's size": (lambda i: resized(i, 256, 192), TOLD),
    "a row cut in rounding": (lambda i: resized(i, 640, 479), TOLD),
    "I420": (i420, CAMERA_DIFFERS),
    "NV12": (nv12, CAMERA_DIFFERS),
    "YUYV": (yuyv, (Status.INVALID, (Reason.IMAGE_UNSUPPORTED,))),
    "YUYV, bytes": (lambda i: yuyv(i).reshape(240, 640), CAMERA_DIFFERS),
    "YUYV, words": (lambda i: yuyv(i).view(np.uint16)[..., 0], IMAGE_GREY),
    "Bayer": (lambda i: i[:, :, 1], IMAGE_GREY),
    "grey": (grey, IMAGE_GREY),
    "grey, repeated": (lambda i: np.dstack([grey(i)] * 3), IMAGE_GREY),
    "black": (np.zeros_like, (Status.DEGRADED, (Reason.IMAGE_BLACK,))),
    "its own": (lambda i: i, (Status.OK, ())),
}


@pytest.mark.parametrize("change", CHANGES)
def test_an_image_unlike_those_of_the_calibration_is_named(odometer, images, change):
    convert, (status, reasons) = CHANGES[change]
    (found,) = odometer.stream([np.ascontiguousarray(convert(images[0]))])
    # A distorted image may also give an implausible pose.
    if status is Status.DEGRADED and Reason.POSE_IMPLAUSIBLE in found.reasons:
        status, reasons = Status.INVALID, (*reasons, Reason.POSE_IMPLAUSIBLE)
    assert (found.status, found.reasons) == (status, reasons)
    assert found.bounded == (status is Status.OK)


def test_grey_images_suit_a_bundle_of_grey_images(stated, images):
    # Without an alarm: this bundle was calibrated on images with colour.
    with Odometer(stated(GREY, alarm=None), threads=1) as odometer:
        assert odometer.step(grey(images[0])).reasons == ()
        assert odometer.step(i420(images[1])).reasons[0] is Reason.CAMERA_DIFFERS


def test_the_bundle_s_size_is_the_reference_not_the_first_frame_s(stated, images):
    odd = resized(images[0], 640, 360)
    with Odometer(stated(), threads=1) as odometer:
        first, *others = odometer.stream([odd, *images[1:5]])
    assert first.reasons[0] is Reason.CAMERA_DIFFERS
    assert [other.reasons for other in others] == [()] * 4
    # A bundle that does not state its size has nothing but the first frame.
    with Odometer(stated(None), threads=1) as odometer:
        first, *others = odometer.stream([odd, *images[1:5]])
    assert first.status is Status.OK
    assert [other.reasons for other in others] == [(Reason.IMAGE_SIZE_CHANGED,)] * 4


def test_another_size_is_told_once_a_stream(odometer, images):
    twice = [resized(image, 640, 480) for image in images[:3]]
    half = resized(images[5], 256, 192)
    told, none = (Reason.IMAGE_RESIZED,), ()
    stream = [*twice, images[3], images[4], half, resized(images[6], 640, 480)]
    for _ in range(2):
        found = list(odometer.stream(stream))
        assert [each.reasons for each in found] == [told, none, none, none, none, told, none]
        assert all(each.bounded for each in found)


def test_resizing_keeps_the_pose(odometer, images):
    # In one stream the second would be a repetition.
    (small,) = odometer.stream([images[0]])
    (large,) = odometer.stream([resized(images[0], 480, 360)])
    width = small.upper - small.lower
    assert (np.abs(small.lower - large.lower) < 0.2 * width).all()


@pytest.mark.parametrize("quality", [20, 95])
def test_colour_survives_the_dark_and_grey_survives_an_encoder(images, quality):
    def coloured(image):
        jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        image = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        return has_colour(Look(model_input(image, 192, 256, "none"), image.shape[:2]))

    for image in images[:5]:
        assert coloured(image)
        assert coloured((0.15 * image).astype(np.uint8))
        assert not coloured(np.dstack([grey(image)] * 3))


@pytest.mark.parametrize(
    ("size", "same"),
    [((480, 640), True), ((241, 321), True), ((238, 320), True), ((236, 320), False)],
)
def test_shapes_are_the_same_but_for_two_pixels(size, same):
    assert similar(size, (240, 320), 2.0) == similar((240, 320), size, 2.0) == same


# A wider camera, 1.4 mm against 2.0 mm, of which the middle shows what the bundle's camera shows.
WIDE = Camera(width=914, height=686, fx=585.0, fy=585.0, cx=456.5, cy=342.5)


def test_the_middle_of_a_wider_camera_is_the_bundle_s_view(stated, images):
    wide = np.zeros((686, 914, 3), np.uint8)
    rows, columns = slice(103, 583), slice(137, 777)
    bundle = stated(camera=CAMERA)
    with Odometer(bundle, threads=1) as own, Odometer(bundle, threads=1, camera=WIDE) as other:
        for image in images[:5]:
            wide[rows, columns] = large = resized(image, 640, 480)
            expected, found = own.step(large), other.step(wide)
            assert found.reasons == ()
            width = expected.upper - expected.lower
            assert (np.abs(found.lower - expected.lower) < 0.1 * width).all()
        # The stated size is the reference, and so are the pixels that the model's input needs.
        sizes = {
            (1371, 1029): Reason.IMAGE_RESIZED,
            (320, 240): Reason.IMAGE_TOO_SMALL,
            (914, 514): Reason.CAMERA_DIFFERS,
        }
        for size, reason in sizes.items():
            wide[rows, columns] = resized(images[7], 640, 480)
            (found,) = other.stream([resized(wide, *size)])
            assert found.reasons == (reason,)


@pytest.mark.parametrize(
    "camera",
    [
        CAMERA.zoomed(0.8).zoomed(1.6),
        msgspec.structs.replace(CAMERA, cx=170.0),
        msgspec.structs.replace(
            CAMERA, distortion="radial_tangential", coefficients=(-0.3, 0.1, 0.0, 0.0)
        ),
        CAMERA.scaled(64, 48),
        WIDE.scaled(320, 240),
    ],
    ids=["narrower", "off-centre", "distorted", "small", "enlarged"],
)
def test_a_camera_that_does_not_show_the_bundle_s_view_is_refused(stated, camera):
    with pytest.raises(UsageError, match=r"^camera: expected one whose .*, 320x240 with fx 292\.5"):
        Odometer(stated(camera=CAMERA), camera=camera)


def test_a_bundle_without_intrinsics_takes_no_other_camera(stated):
    with pytest.raises(UsageError, match=r"^camera: expected a bundle that states the intrinsics"):
        Odometer(stated(), camera=CAMERA)


def test_a_camera_is_a_word_or_a_file(tmp_path):
    assert read_camera("320x240,292.5,292.5,159.5,119.5") == CAMERA
    path = tmp_path / "320x240,292.5,292.5,159.5,119.5"
    path.write_bytes(msgspec.json.encode(WIDE))
    assert read_camera(path) == WIDE
    with pytest.raises(UsageError, match=r"expected WIDTHxHEIGHT,FX,FY,CX,CY in pixels, found 3"):
        read_camera("320x240,wide,292.5,159.5,119.5")
    with pytest.raises(UsageError, match=r"found .*nan"):
        read_camera("320x240,nan,292.5,159.5,119.5")


SENSOR = """%YAML:1.0
# General sensor definitions.
T_BS:
  data: [0.0, 1.0,
         2.0, 3.0]
resolution: [320, 240]
camera_model: pinhole
intrinsics: [292.5, 293.0, 159.5, 119.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]
"""


def test_a_camera_is_a_sensor_yaml(tmp_path):
    path = tmp_path / "sensor.yaml"
    path.write_text(SENSOR)
    assert read_camera(path) == Camera(
        width=320,
        height=240,
        fx=292.5,
        fy=293.0,
        cx=159.5,
        cy=119.5,
        distortion="radial_tangential",
        coefficients=(-0.28, 0.07, 0.0002, 1.8e-05),
    )
    for old, new in (
        ("resolution", "size"),
        ("pinhole", "omni"),
        ("radial-tangential", "fov"),
        ("292.5, ", ""),
        ("-0.28, 0.07, ", ""),
        ("320", "wide"),
    ):
        path.write_text(SENSOR.replace(old, new))
        with pytest.raises(UsageError, match=r"sensor.yaml: expected a sensor.yaml with res"):
            read_camera(path)


def test_the_sizes_of_images_and_camera_agree(stated):
    calibration = stated(camera=CAMERA).calibration
    check_rules(calibration)
    other = msgspec.structs.replace(
        calibration, images=ImageSpec(width=640, height=480, colour=True)
    )
    with pytest.raises(CalibrationFileError, match=r"images: expected .* 320x240, found 640x480"):
        check_rules(other)


@pytest.mark.parametrize(("images", "line"), [(COLOUR, "320x240, colour"), (GREY, "320x240, grey")])
def test_inspect_shows_the_images(stated, images, line):
    assert f"images       {line}" in "\n".join(inspect_lines(stated(images).calibration))
    assert "images " not in "\n".join(inspect_lines(stated(None).calibration))
