"""Frames that look wrong, alone or within their stream, get no interval."""

import threading

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cvo_edge import Frame, Odometer, Reason, Status, open_source
from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.errors import ModelError
from cvo_edge.input.frame_checks import Look, StreamChecks, image_doubt
from cvo_edge.input.preprocess import model_input


@pytest.fixture(scope="module")
def images(clip_dir):
    return [frame.image for frame in open_source(str(clip_dir))][:12]


def look(image):
    return Look(model_input(image, 192, 256, "none"), image.shape[:2])


def noise(shape=(240, 320, 3), mean=0.0, deviation=3.0, seed=0):
    values = np.random.default_rng(seed).normal(mean, deviation, shape)
    return np.clip(values.round(), 0, 255).astype(np.uint8)


def blown(image, gain=6.0):
    return np.clip(image * gain, 0, 255).astype(np.uint8)


FAULTS = {
    "black": (lambda image: np.zeros_like(image), Reason.IMAGE_BLACK),
    "black with noise": (lambda image: noise(image.shape, 4), Reason.IMAGE_BLACK),
    "white": (lambda image: np.full_like(image, 255), Reason.IMAGE_SATURATED),
    "blown out": (blown, Reason.IMAGE_SATURATED),
    "grey": (lambda image: np.full_like(image, 128), Reason.IMAGE_FLAT),
    "green": (lambda image: np.zeros_like(image) + np.uint8([0, 154, 0]), Reason.IMAGE_FLAT),
    "grey with noise": (lambda image: noise(image.shape, 90), Reason.IMAGE_FLAT),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_image_that_shows_nothing_has_no_interval(bundle_dir, images, fault):
    change, reason = FAULTS[fault]
    with Odometer.load(bundle_dir, threads=1) as odometer:
        before, wrong, after = (
            odometer.step(image) for image in (images[0], change(images[1]), images[2])
        )
    assert (before.status, after.status) == (Status.OK, Status.OK)
    assert wrong.reasons[0] is reason
    assert not np.isfinite([wrong.lower, wrong.upper]).any()
    record = wrong.to_dict()
    if wrong.reasons[1:] == (Reason.POSE_IMPLAUSIBLE,):
        assert wrong.status is Status.INVALID
        assert record["pose"] is record["interval"] is None
        return
    assert wrong.status is Status.DEGRADED
    assert wrong.reasons == (reason,)
    assert record["pose"] is not None
    assert record["interval"]["lower"] == record["interval"]["upper"] == [None] * 6
    assert record["interval"]["bounded"] is False


def test_no_image_of_a_clip_is_doubted(images):
    assert [image_doubt(look(image)) for image in images] == [None] * len(images)


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_a_lamp_or_a_dark_corner_is_no_fault(images, share):
    for value in (0, 255):
        image = images[0].copy()
        image[: int(share * len(image))] = value
        assert image_doubt(look(image)) is None


def test_a_frozen_camera_is_noticed_with_its_first_repetition(bundle_dir, images):
    stream = [images[0], images[1], images[1], images[1].copy(), images[2], images[3]]
    with Odometer.load(bundle_dir, threads=1) as odometer:
        found = [estimate.reasons for estimate in odometer.stream(stream)]
    repeated = (Reason.FRAME_REPEATED,)
    assert found == [(), (), repeated, repeated, (), ()]


def test_an_image_whose_inference_failed_may_come_again(bundle_dir, images, monkeypatch):
    def fail(_feeds):
        raise ModelError("no memory")

    with Odometer.load(bundle_dir) as odometer:
        for image in images[:2]:
            with monkeypatch.context() as patch:
                patch.setattr(odometer.session, "run", fail)
                with pytest.raises(ModelError):
                    odometer.step(image)
            assert Reason.FRAME_REPEATED not in odometer.step(image).reasons
            assert Reason.FRAME_REPEATED in odometer.step(image).reasons


@pytest.mark.parametrize("buffers", [2, 4, 9])
def test_a_driver_that_hands_out_its_old_buffers_again_is_noticed(images, buffers):
    checks = StreamChecks()
    first, *again = ([checks.picture(look(image)) for image in images[:buffers]] for _ in range(3))
    assert first == [()] * buffers
    assert again == [[(Reason.FRAME_REPEATED,)] * buffers] * 2
    # The camera works again: the first new image is accepted.
    assert checks.picture(look(images[buffers])) == ()


def test_a_still_scene_without_noise_is_none_of_them_if_that_is_said(images):
    checks = StreamChecks()
    for column in range(12):
        image = images[0].copy()
        image[0, column] ^= 255
        assert checks.picture(look(image), fresh_noise=False) == ()
    assert checks.unproven == 12
    assert checks.picture(look(image)) == (Reason.FRAME_REPEATED,)


def test_a_still_scene_with_noise_of_one_grey_level_stays_ok(bundle_dir, images):
    generator = np.random.default_rng(0)
    still = images[0].astype(np.int16)
    with Odometer.load(bundle_dir, threads=1) as odometer:
        for _ in range(20):
            noisy = still + generator.normal(0, 1.0, still.shape).round().astype(np.int16)
            estimate = odometer.step(np.clip(noisy, 0, 255).astype(np.uint8))
            assert estimate.status is Status.OK


@pytest.mark.parametrize("mode", ["latency", "throughput", "live"])
def test_every_mode_sees_the_stream_in_its_order(bundle_dir, images, mode, clock):
    other = np.ascontiguousarray(images[4][:200])
    frames = [
        Frame(images[0], 100, "", 0.0),
        Frame(images[1], 200, "", 0.0),
        Frame(images[1], 300, "", 0.0),
        Frame(None, 350, "", 0.0),
        Frame(images[2], 350, "", 0.0),
        Frame(images[3], 250, "", 0.0),
        Frame(other, 400, "", 0.0),
        Frame(images[5], None, "", 0.0),
        Frame(images[6], 500, "", 0.0, queued_ms=1500.0),
        Frame(images[7], 600, "", 0.0),
    ]
    # In live mode, deliver a frame only after the previous one was processed, or it is dropped.
    wanted = threading.Semaphore(1 if mode == "live" else len(frames))

    def coming():
        for frame in frames:
            wanted.acquire()
            yield frame

    bundle = read_bundle(bundle_dir)
    # The bundle does not state the size of its images.
    calibration = msgspec.structs.replace(bundle.calibration, images=None)
    with Odometer(Bundle.of(calibration, bundle.model), threads=2, mode=mode) as odometer:
        # However slow the machine is, no frame gets old by itself.
        odometer._clock = clock
        found = []
        for estimate in odometer.stream(coming()):
            found.append((estimate.status, estimate.reasons, estimate.bounded))
            wanted.release()
    ok = (Status.OK, (), True)
    assert found == [
        ok,
        ok,
        (Status.DEGRADED, (Reason.FRAME_REPEATED,), False),
        (Status.INVALID, (Reason.IMAGE_UNREADABLE,), False),
        (Status.DEGRADED, (Reason.STAMP_NOT_LATER,), False),
        (Status.DEGRADED, (Reason.STAMP_NOT_LATER,), False),
        (Status.DEGRADED, (Reason.IMAGE_SIZE_CHANGED,), False),
        ok,
        (Status.DEGRADED, (Reason.FRAME_STALE,), False),
        ok,
    ]


def test_a_frame_with_two_faults_names_both(images, bundle_dir):
    with Odometer.load(bundle_dir, threads=1) as odometer:
        assert odometer.step(images[0], 10).status is Status.OK
        reasons = odometer.step(images[0], 10).reasons
    assert reasons == (Reason.FRAME_REPEATED, Reason.STAMP_NOT_LATER)


@given(
    stamps=st.lists(
        st.none()
        | st.integers(0, 5)
        | st.sampled_from([-1, 2**63, 2**63 - 1, 1_764_000_000_000_000_000])
    )
)
def test_a_stamp_is_doubted_exactly_where_it_is_not_after_the_last_one(stamps):
    checks, last = StreamChecks(), None
    for stamp_ns in stamps:
        doubts = checks.times(stamp_ns, 0.0)
        if stamp_ns is not None and not 0 <= stamp_ns < 2**63:
            assert doubts == (Reason.STAMP_IMPLAUSIBLE,)
            continue
        backward = stamp_ns is not None and last is not None and stamp_ns <= last
        assert doubts == ((Reason.STAMP_NOT_LATER,) if backward else ())
        # A clock set back flags only the first frame: later stamps count from the new time.
        last = last if stamp_ns is None else stamp_ns


def test_a_gap_costs_the_missing_frames_only(bundle_dir, images):
    frames = [
        Frame(images[0], 0, "", 0.0),
        Frame(images[1], 3_600_000_000_000, "", 0.0, skipped=7),
        Frame(images[2], 3_600_033_000_000, "", 0.0),
    ]
    with Odometer.load(bundle_dir, threads=1) as odometer:
        found = list(odometer.stream(frames))
    assert [(e.seq, e.status) for e in found] == [
        (0, Status.OK),
        (8, Status.OK),
        (9, Status.OK),
    ]
