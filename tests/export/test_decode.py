"""Bundles of ``decode: half``: calibrated and run on JPEG files that are decoded at half size."""

import dataclasses
import shutil

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from cvo_edge import Odometer, UsageError
from cvo_edge.bundle.reading import encode_calibration, read_calibration
from cvo_edge.errors import CalibrationFileError
from cvo_edge.input.frame import Frame
from cvo_edge.input.half import halve
from cvo_edge.input.preprocess import halved
from cvo_edge.input.sources import open_source
from cvo_edge.record import Reason, Status
from cvo_export.calibrate import calibrate
from cvo_export.datasets import open_dataset
from cvo_export.evaluate import evaluate
from cvo_export.publish import publish

HALF = cv2.IMREAD_REDUCED_COLOR_2 | cv2.IMREAD_IGNORE_ORIENTATION


@pytest.fixture(scope="module")
def recording(tiny_run, tmp_path_factory):
    """The frames of the tiny run as JPEG files of twice the size, in the layout of 7-Scenes."""
    root, scene = tmp_path_factory.mktemp("room"), tiny_run.dataset
    (root / "camera-intrinsics.txt").write_text("117 0 63.5\n0 117 47.5\n0 0 1\n")
    for index, pose in enumerate(scene.poses):
        folder = root / f"seq-{scene.sequence[index] + 1:02d}"
        folder.mkdir(exist_ok=True)
        T = np.eye(4)
        T[:3] = np.column_stack([matrix_of(pose[3:]), pose[:3]])
        np.savetxt(folder / f"frame-{index:06d}.pose.txt", T)
        image = cv2.resize(scene.read_image(index), (128, 96), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"frame-{index:06d}.color.jpg"), image)
    return root


def matrix_of(q_xyzw):
    x, y, z, w = q_xyzw
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


@pytest.fixture(scope="module")
def bundle(tiny_run, recording, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bundles") / "half"
    run = dataclasses.replace(tiny_run, dataset=open_dataset(f"7scenes:{recording}"))
    publish(run, folder, "half", decode="half")
    return folder


def test_the_bundle_states_the_files_and_how_they_are_read(bundle):
    calibration = read_calibration(bundle)
    assert calibration.schema_version == 3
    assert calibration.preprocess.decode == "half"
    assert (calibration.images.width, calibration.images.height) == (128, 96)
    assert (calibration.camera.width, calibration.camera.fx) == (128, 117.0)


def test_files_are_decoded_at_half_size_wherever_they_come_from(bundle, recording):
    """A folder, and ``cv2.imread`` at half size, give the same poses; calibration saw them, too."""
    files = sorted((recording / "seq-02").glob("*.jpg"))[:5]
    dataset = open_dataset(f"7scenes:{recording}").decoded("half")
    frames = open_source(recording / "seq-02")
    with Odometer.load(bundle) as odometer:
        for path, found in zip(files, odometer.stream(frames), strict=False):
            image = cv2.imread(str(path), HALF)
            observation = odometer.observe(image, found.seq)
            np.testing.assert_array_equal(found.pose.to_array(), observation.pose)
            assert (observation.doubt, Reason.IMAGE_RESIZED in found.reasons) == (None, False)
        np.testing.assert_array_equal(dataset.read_image(40), cv2.imread(str(files[0]), HALF))


def test_a_whole_picture_has_a_pose_without_bounds(bundle, recording):
    path = str(next((recording / "seq-02").glob("*.jpg")))
    whole = cv2.imread(path)
    with Odometer.load(bundle) as odometer:
        for image in (whole, cv2.resize(whole, (32, 24)), cv2.resize(whole, (256, 192))):
            estimate = odometer.step(image)
            assert (estimate.status, estimate.reasons) == (
                Status.DEGRADED,
                (Reason.IMAGE_NOT_HALF,),
            )
            assert not estimate.bounded


def test_sources_without_jpeg_images_are_refused_in_one_line(bundle, tmp_path, recording):
    image = cv2.imread(str(next((recording / "seq-02").glob("*.jpg"))), HALF)
    (tmp_path / "png").mkdir()
    cv2.imwrite(str(tmp_path / "png" / "a.png"), image)
    video = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for _ in range(3):
        writer.write(image)
    writer.release()
    with Odometer.load(bundle) as odometer:
        for source, found in ((tmp_path / "png", "found a.png"), (video, "found a video")):
            frames = open_source(source)
            with pytest.raises(UsageError, match=found):
                next(odometer.stream(frames))
    halve([Frame(image, None, "", 0.0)])  # those of a caller, who decodes them


@pytest.mark.parametrize("size", [(126, 96), (127, 96), (128, 95)])
def test_too_few_or_odd_pixels_are_refused(bundle, size):
    calibration = read_calibration(bundle)
    images = replace(calibration.images, width=size[0], height=size[1])
    with pytest.raises(
        CalibrationFileError, match=r"preprocess\.decode: expected images with even"
    ):
        encode_calibration(replace(calibration, images=images, camera=None))


def test_another_cameras_images_must_have_halves(bundle):
    camera = read_calibration(bundle).camera
    Odometer.load(bundle, camera=camera.scaled(256, 192)).close()
    with pytest.raises(UsageError, match="decode: expected images with even sides"):
        Odometer.load(bundle, camera=camera.scaled(255, 191))


def test_what_is_no_jpeg_cannot_be_published_at_half_size(tiny_run, tmp_path):
    with pytest.raises(UsageError, match="decode: expected images with even sides"):
        publish(tiny_run, tmp_path / "new", "new", decode="half")
    with pytest.raises(UsageError, match="expected JPEG files"):
        tiny_run.dataset.decoded("half")
    assert not (tmp_path / "new").exists()


def test_another_calibration_keeps_or_changes_how_files_are_read(bundle, recording, tmp_path):
    data = open_dataset(f"7scenes:{recording}")
    calibrate(bundle, data, tmp_path / "same", "same")
    again = calibrate(bundle, data, tmp_path / "full", "full", decode="full")
    assert read_calibration(tmp_path / "same").preprocess.decode == "half"
    assert (again.preprocess.decode, again.schema_version) == ("full", 2)
    # Thresholds are those of other pixels.
    assert again.thresholds != read_calibration(bundle).thresholds


def test_evaluation_reads_files_as_the_bundle_does(bundle, recording, tmp_path):
    found = evaluate(bundle, open_dataset(f"7scenes:{recording}"), "test")
    assert found["frames"]["degraded"] == found["frames"]["invalid"] == 0
    shutil.copytree(recording, tmp_path / "png")
    for path in (tmp_path / "png").rglob("*.jpg"):
        cv2.imwrite(str(path.with_suffix(".png")), cv2.imread(str(path)))
        path.unlink()
    with pytest.raises(UsageError, match="expected JPEG files"):
        evaluate(bundle, open_dataset(f"7scenes:{tmp_path / 'png'}"), "test")


def test_changes_act_on_the_whole_picture(recording):
    """A change of nothing gives the half picture, one to a constant the constant."""
    data = open_dataset(f"7scenes:{recording}").decoded("half")
    generator = np.random.default_rng(0)
    image, whole = data.read_image(3), data.read_whole(3)
    np.testing.assert_array_equal(data.read_changed(3, lambda each, _: each, generator), image)
    darker = data.read_changed(3, lambda each, _: each // 2, generator).astype(int)
    expected = image + (halved(whole // 2, 48, 64).astype(int) - halved(whole, 48, 64))
    np.testing.assert_array_equal(darker, np.clip(expected, 0, 255))
