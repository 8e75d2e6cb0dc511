"""The odometer's loop, on the demonstration bundle."""

import gc
import subprocess
import sys
import threading
from itertools import pairwise

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from cvo_edge import Odometer, Reason, Status, UsageError, open_source, read_bundle
from cvo_edge.engine.loading import Bundle
from cvo_edge.ground_truth import open_ground_truth
from cvo_edge.programs.inspect import inspect_lines
from cvo_edge.programs.run import RunSummary, run


@pytest.fixture(scope="module")
def frames(clip_dir):
    return list(open_source(str(clip_dir)))


def numbers(estimate):
    record = estimate.to_dict()
    return record["pose"], record["interval"]


def test_same_images_give_the_same_bits(bundle_dir, frames):
    with Odometer.load(bundle_dir) as first, Odometer.load(bundle_dir) as second:
        for frame in frames[:5]:
            assert numbers(first.step(frame.image)) == numbers(second.step(frame.image))


def test_stream_is_step_after_step(bundle_dir, frames):
    with Odometer.load(bundle_dir) as first, Odometer.load(bundle_dir) as second:
        streamed = list(first.stream(frames[:4]))
        stepped = [second.step(frame.image) for frame in frames[:4]]
        bare = list(Odometer.load(bundle_dir).stream([frame.image for frame in frames[:4]]))
    assert [numbers(e) for e in streamed] == [numbers(e) for e in stepped]
    assert [numbers(e) for e in streamed] == [numbers(e) for e in bare]
    assert [estimate.seq for estimate in streamed] == [0, 1, 2, 3]
    assert streamed[2].source == frames[2].source


def test_intervals_hold_their_point_and_grow_with_the_confidence(bundle_dir, frames):
    widths = []
    for confidence in (0.5, 0.8, 0.9, 0.95):
        with Odometer.load(bundle_dir, confidence=confidence) as odometer:
            estimate = odometer.step(frames[0].image)
        assert (estimate.lower <= estimate.upper).all()
        widths.append(estimate.upper - estimate.lower)
    assert all((a <= b).all() for a, b in pairwise(widths))


def test_joint_sets_hold_the_marginal_ones(bundle_dir, frames):
    with Odometer.load(bundle_dir) as marginal, Odometer.load(bundle_dir, scope="joint") as joint:
        inner, outer = marginal.step(frames[0].image), joint.step(frames[0].image)
    assert (outer.upper - outer.lower >= inner.upper - inner.lower).all()


@pytest.mark.whole_clip
def test_clip_is_covered_about_as_often_as_stated(bundle_dir, clip_dir, frames):
    # A new flight of the training scene: exchangeability does not hold, coverage is only close.
    truth = open_ground_truth(clip_dir)
    with Odometer.load(bundle_dir) as odometer:
        covered = [e.covers(truth.pose_of(e)) for e in odometer.stream(frames)]
    assert np.mean(covered) > 0.75


@pytest.mark.parametrize("bad", [None, np.zeros((3, 3), np.uint8), np.zeros((40, 40, 3), float)])
def test_a_bad_image_costs_that_frame_only(bundle_dir, frames, bad):
    first, second = frames[0].image, frames[1].image
    with Odometer.load(bundle_dir) as odometer:
        expected = [numbers(odometer.step(image)) for image in (first, second)]
    with Odometer.load(bundle_dir) as odometer:
        before, broken, after = (odometer.step(image) for image in (first, bad, second))
    assert [numbers(before), numbers(after)] == expected
    assert broken.status is Status.INVALID
    assert broken.pose is None
    assert not broken.bounded
    reason = Reason.IMAGE_UNREADABLE if bad is None else Reason.IMAGE_UNSUPPORTED
    assert broken.reasons == (reason,)


@pytest.mark.parametrize("threads", [0, -1, 100_000])
def test_threads_must_be_those_of_the_machine(bundle_dir, threads):
    with pytest.raises(UsageError, match="threads"):
        Odometer.load(bundle_dir, threads=threads)


def test_after_close_stepping_is_a_typed_error_and_closing_again_is_not(bundle_dir, frames):
    odometer = Odometer.load(bundle_dir)
    odometer.close()
    odometer.close()
    with pytest.raises(UsageError, match="closed"):
        odometer.step(frames[0].image)


def test_four_threads_on_one_odometer_see_the_same_bits(bundle_dir, frames):
    with Odometer.load(bundle_dir, threads=1) as odometer:
        expected = odometer.observe(frames[0].image, 0).outputs
        found = [{} for _ in range(4)]

        def work(slot):
            for _ in range(5):
                found[slot] = odometer.observe(frames[0].image, 0).outputs

        workers = [threading.Thread(target=work, args=(slot,)) for slot in range(4)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    for outputs in found:
        for name, values in expected.items():
            np.testing.assert_array_equal(outputs[name], values)


def test_results_do_not_share_memory_with_later_frames(bundle_dir, frames):
    with Odometer.load(bundle_dir) as odometer:
        first = odometer.step(frames[0].image)
        kept = first.lower.copy(), first.pose.t_m.copy()
        for frame in frames[1:6]:
            odometer.step(frame.image)
    gc.collect()
    np.testing.assert_array_equal(first.lower, kept[0])
    np.testing.assert_array_equal(first.pose.t_m, kept[1])


FORKED = """
import os, sys
from cvo_edge import Odometer, UsageError, open_source

bundle, clip, what = sys.argv[1:]
odometer = Odometer.load(bundle, threads=2)
image = next(iter(open_source(clip))).image
first = odometer.step(image)
child = os.fork()
if child == 0:
    try:
        if what == "step":
            odometer.step(image)
        elif what == "close":
            odometer.close()
        else:
            with Odometer.load(bundle, threads=2) as own:
                again = own.step(image)
            assert again.pose.to_array().tolist() == first.pose.to_array().tolist()
    except UsageError as error:
        print(error, flush=True)
        os._exit(2)
    os._exit(0)
_, status = os.waitpid(child, 0)
assert odometer.step(image).pose is not None
odometer.close()
sys.exit(os.waitstatus_to_exitcode(status))
"""


@pytest.mark.parametrize(("what", "code"), [("step", 2), ("close", 0), ("load", 0)])
def test_a_forked_process_loads_its_own(bundle_dir, clip_dir, what, code):
    done = subprocess.run(
        [sys.executable, "-c", FORKED, bundle_dir, clip_dir, what],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == code, done.stderr
    assert ("load it again in this process" in done.stdout) == (what == "step")


def test_a_path_is_no_stream(bundle_dir, clip_dir):
    with Odometer.load(bundle_dir) as odometer:
        for path in (clip_dir, str(clip_dir)):
            with pytest.raises(UsageError, match=r"a path is opened by open_source\(path\)"):
                next(odometer.stream(path))


def test_a_confidence_of_single_precision_is_the_stored_one(bundle_dir):
    with Odometer.load(str(bundle_dir), confidence=np.float32(0.9)) as odometer:
        assert odometer.confidence == 0.9
        assert type(odometer.confidence) is float


@pytest.mark.parametrize(
    ("confidence", "scope", "match"),
    [
        (0.925, "marginal", "0.925 is not stored .* nearest: 0.9 and 0.95; stored: 0.5, 0.8"),
        (0.1, "joint", "nearest: 0.5; stored"),
        (0.999, "joint", "nearest: 0.99; stored"),
        (float("nan"), "joint", "expected a number between 0 and 1, found nan"),
        (1.0, "joint", "expected a number between 0 and 1, found 1"),
        (0.0, "joint", "expected a number between 0 and 1, found 0"),
        ("high", "joint", "confidence: expected a number, found 'high'"),
        (0.42, "Joint", "scope: expected one of marginal, joint, found 'Joint'"),
    ],
)
def test_a_threshold_that_is_not_stored_is_refused(bundle_dir, confidence, scope, match):
    with pytest.raises(UsageError, match=match):
        Odometer.load(bundle_dir, confidence=confidence, scope=scope)


def test_what_is_shown_of_bundle_and_odometer_is_short(bundle_dir):
    bundle = read_bundle(str(bundle_dir))
    assert repr(bundle).startswith(f"<Bundle {bundle.calibration.name!r}: ")
    odometer = Odometer(bundle)
    assert f"{bundle.calibration.name!r}" in repr(odometer)
    assert "0.9 marginal, latency mode>" in repr(odometer)
    odometer.close()
    assert "closed" in repr(odometer)
    assert max(len(repr(bundle)), len(repr(odometer))) < 100


@pytest.mark.parametrize("scope", ["marginal", "joint"])
@pytest.mark.parametrize("method", ["cjp", "csp", "mcqr", "scr"])
def test_an_origin_moves_all_that_an_estimate_says_of_positions(
    artifacts_dir, frames, method, scope
):
    bundle = read_bundle(artifacts_dir / f"synthetic-room-{method}")
    origin_m = (512.0, 5_000_000.0, -100.0)
    pose = replace(bundle.calibration.pose, origin_m=origin_m)
    moved = Bundle.of(replace(bundle.calibration, pose=pose), bundle.model)
    assert "origin       512 5000000 -100 m in the world" in inspect_lines(moved.calibration)
    step = np.array([*origin_m, 0.0, 0.0, 0.0])
    with Odometer(bundle, scope=scope) as here, Odometer(moved, scope=scope) as there:
        near, far = (each.step(frames[10].image) for each in (here, there))
    assert far.status == near.status == "ok"
    assert (far.pose.t_m == near.pose.t_m + origin_m).all()
    assert (far.lower == near.lower + step).all()
    assert (far.upper == near.upper + step).all()
    one, other = near.conformal_set.ellipsoids, far.conformal_set.ellipsoids
    if one is not None:
        assert (other.centres == one.centres.astype(np.float64) + step).all()
        assert (other.scale == one.scale).all()
    if near.bands is not None:
        for before, after, by in zip(near.bands, far.bands, step, strict=True):
            assert (np.array(after) == np.array(before) + by).all()
    inside = near.pose.to_array()
    inside[:3] += origin_m
    assert far.contains(inside) == near.contains(near.pose)
    inside[1] = near.pose.t_m[1]
    assert not far.contains(inside)


def test_the_summary_counts_images_that_are_no_frames(bundle_dir, frames, tmp_path):
    for mark in ("color", "depth"):
        assert cv2.imwrite(str(tmp_path / f"1-{mark}.png"), frames[0].image)
    with Odometer.load(bundle_dir) as odometer:
        summary = RunSummary(odometer.chart.dof, 0.9, "marginal")
        run(odometer, open_source(tmp_path), lambda _: None, summary=summary)
    assert summary.frames == 1
    assert "left out    1 file: marked depth 1" in summary.lines()
