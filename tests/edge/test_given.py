"""Callers of the API give paths and numbers of any type that means them; the rest is one line."""

import copy
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from cvo_edge import (
    Frame,
    FrontEnd,
    ModelCache,
    Odometer,
    open_source,
    read_bundle,
    read_camera,
    read_records,
)
from cvo_edge.errors import CvoError, UsageError
from cvo_edge.motion.intervals import MotionCalibration
from cvo_edge.record import Reason


@pytest.fixture(scope="module")
def images(clip_dir):
    return [cv2.imread(str(path)) for path in sorted(clip_dir.glob("*.color.jpg"))[:3]]


PATHS = [read_bundle, Odometer.load, read_records, read_camera, ModelCache, MotionCalibration.load]


@pytest.mark.parametrize("call", [*PATHS, open_source])
def test_a_path_may_be_text_or_a_path(call, tmp_path):
    told = set()
    for path in (str(tmp_path / "none"), tmp_path / "none"):
        try:
            call(path)
        except CvoError as error:
            told.add(str(error))
    assert len(told) == (call is not ModelCache)
    for given in (None, 1.5, b"a", True):
        with pytest.raises(UsageError, match=r"expected a path.*, found"):
            call(given)


def test_numbers_of_numpy_are_numbers(bundle_dir, images):
    exact = {"threads": 1, "confidence": 0.9}
    with (
        Odometer.load(bundle_dir, threads=np.int64(1), confidence=np.float32(0.9)) as found,
        Odometer.load(bundle_dir, **exact) as wanted,
    ):
        given = (np.int64(5), Path("a"), np.float32(1.5))
        one = found.step(images[0], *given).to_dict()
        two = wanted.step(images[0], 5, "a", 1.5).to_dict()
        assert found.confidence == 0.9
    del one["latency_ms"], two["latency_ms"]
    assert one == two
    for wrong in ({"threads": 1.0}, {"confidence": "much"}, {"scope": "Joint"}, {"mode": "Live"}):
        with pytest.raises(UsageError, match=f"{next(iter(wrong))}: expected"):
            Odometer.load(bundle_dir, **wrong)
    for stamp_ns, read_ms in ((5.0, 0.0), ("5", 0.0), (5, "soon")):
        with pytest.raises(UsageError, match="expected a"):
            Frame(images[0], stamp_ns, "a", read_ms)
    with pytest.raises(UsageError, match="fps: expected a number, found"):
        open_source(bundle_dir, fps="fast")


def test_a_copy_has_the_settings_and_starts_a_stream(bundle_dir, images):
    with Odometer.load(bundle_dir, scope="joint", confidence=0.8) as odometer:
        first = odometer.step(images[0])
        with copy.deepcopy(odometer) as second, pickle.loads(pickle.dumps(odometer)) as third:
            for each in (second, third):
                copied = each.step(images[0])
                assert (copied.seq, copied.confidence, copied.scope) == (0, 0.8, "joint")
                np.testing.assert_array_equal(copied.lower, first.lower)
    refused = pytest.raises(UsageError, match=r"copy: expected an odometer of Odometer\.load")
    with Odometer(read_bundle(bundle_dir)) as odometer, refused:
        pickle.dumps(odometer)


@pytest.mark.parametrize("frames", ["frames", b"frames", Path("frames"), None, 5])
def test_a_stream_is_of_frames_and_not_of_a_path(bundle_dir, frames):
    front_end = FrontEnd(read_camera("640x480,500,500,320,240"))
    with Odometer.load(bundle_dir) as odometer:
        for each in (odometer, front_end):
            with pytest.raises(UsageError, match=r"stream: expected frames or a source, found"):
                next(each.stream(frames))


@pytest.mark.parametrize("stamp_ns", [-1, 2**63, 10**30])
def test_a_stamp_that_no_clock_gives_is_a_doubt_and_is_forgotten(bundle_dir, images, stamp_ns):
    with Odometer.load(bundle_dir) as odometer:
        assert odometer.step(images[0], 10).status == "ok"
        assert odometer.step(images[1], stamp_ns).reasons == (Reason.STAMP_IMPLAUSIBLE,)
        assert odometer.step(images[2], 11).status == "ok"
