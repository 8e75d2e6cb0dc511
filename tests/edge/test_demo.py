"""The demonstration: one command in an empty folder, its picture and its expected figures."""

import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.bundle.format import DEGRADATION_OUTPUT, NOVELTY_OUTPUT, AlarmSpec
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.errors import SinkError, UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.input.sources import open_source
from cvo_edge.odometer import Odometer
from cvo_edge.output.drawing import write_png
from cvo_edge.output.picture import HEIGHT, WIDTH, Span, draw_run
from cvo_edge.pose import Chart, Pose
from cvo_edge.programs.demo import EXPECTED, PACKAGED, demo, expected_coverage, what_happened
from cvo_edge.programs.hand import HAND, covered, with_hand
from cvo_edge.record import Reason, Status
from cvo_edge.sets import ConformalSet, unbounded_set

ROOT = Path(__file__).resolve().parents[2]
MOST_WHEEL_BYTES = 4_000_000

# ----------------------------------------------------------------------------- the command


def run_demo(folder, *arguments):
    return subprocess.run(
        [sys.executable, "-P", "-m", "cvo_edge", "demo", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
    )


@pytest.mark.whole_clip
def test_it_needs_nothing_but_the_package_and_leaves_nothing_but_a_picture(tmp_path):
    done = run_demo(tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert lines[0].startswith("synthetic-room-scr-int8: digests match")
    shown = [line.split()[0] for line in lines if line.startswith(("frame-", "..."))][:5]
    assert shown == [*(f"frame-{number:06}" for number in range(4)), "..."]
    (coverage,) = [line for line in lines if line.startswith("all six")]
    assert coverage.endswith("of 45 frames")
    plain, _, hand = done.stdout.partition("\nhand")
    assert hand
    plain, _, alarm = plain.partition("\nalarm")
    assert " ".join(alarm.split()) == (
        "nothing is wrong with these images: it is a false one, as in at most 24% of new recordings"
    )
    shown = " ".join(plain.partition("expected")[2].split())
    expected = expected_coverage(read_calibration(PACKAGED / "bundle").digest)
    assert shown == expected
    assert [file.name for file in tmp_path.iterdir()] == [lines[-1]]
    assert cv2.imread(str(tmp_path / lines[-1])).shape == (HEIGHT, WIDTH, 3)


def test_a_bad_argument_ends_with_the_documented_exit_code(tmp_path):
    no_bundle = run_demo(tmp_path, "nowhere")
    no_png = run_demo(tmp_path, "--picture", "picture.jpg")
    assert (no_bundle.returncode, no_png.returncode) == (3, 2)
    assert no_bundle.stderr == (
        "cvo-edge: nowhere: no such folder; "
        "expected a bundle with calibration.json and model.onnx\n"
    )
    assert "expected a name that ends in .png, found picture.jpg" in no_png.stderr
    assert not list(tmp_path.iterdir())


def test_the_wheel_holds_what_the_demonstration_needs_and_stays_small():
    with (ROOT / "pyproject.toml").open("rb") as stream:
        patterns = tomllib.load(stream)["tool"]["setuptools"]["package-data"]["cvo_edge"]
    package = PACKAGED.parent
    packed = {file for pattern in patterns for file in package.glob(pattern) if file.is_file()}
    needed = {file for file in PACKAGED.rglob("*") if file.is_file()}
    assert len(needed) == 2 + 2 * 50 + 1
    assert needed <= packed
    # The model and the JPEG files hardly compress; Python sources do.
    sources = sum(file.stat().st_size for file in package.rglob("*.py"))
    assert sum(file.stat().st_size for file in packed) + sources / 3 < MOST_WHEEL_BYTES


# ------------------------------------------------------------------------- what to expect


def report():
    return msgspec.json.decode(EXPECTED.read_bytes())


def test_every_demonstration_bundle_was_measured_and_no_other(artifacts_dir):
    measured = {digest: entry["name"] for digest, entry in report()["bundles"].items()}
    bundles = [file.parent for file in artifacts_dir.glob("*/calibration.json")]
    calibrations = [read_calibration(folder) for folder in bundles]
    assert len(calibrations) == 10
    assert measured == {each.digest: each.name for each in calibrations}


def test_figures_are_in_order_and_of_flights_enough():
    assert report()["flights"] >= 100
    assert report()["frames"] == 50
    for entry in report()["bundles"].values():
        for key in ("one_dof", "mean_of_dof", "all_six"):
            low, median, high, mean = (entry[key][k] for k in ("q05", "median", "q95", "mean"))
            assert 0 < low <= median <= high <= 1
            assert low < mean < high
        # Joint coverage of all six is lower than coverage of one degree of freedom.
        assert entry["all_six"]["mean"] < entry["one_dof"]["mean"]
        # At most 12.4 % of the frames of new flights are missed, from 20 calibration flights.
        assert entry["one_dof"]["mean"] > 0.876


def test_the_sentence_has_the_figures_of_its_bundle_and_there_is_none_for_others():
    for digest, entry in report()["bundles"].items():
        sentence = expected_coverage(digest)
        for key in ("one_dof", "all_six"):
            figures = entry[key]
            assert f"{figures['q05']:.2f} to {figures['q95']:.2f}" in sentence
            assert f"(mean {figures['mean']:.2f})" in sentence
        assert f"new flights ({report()['flights']} measured)" in sentence
    assert expected_coverage("0" * 64) is None


# ----------------------------------------------------------------------------------- the hand


@cache
def clip():
    return [frame.image for frame in open_source(str(PACKAGED / "clip"))]


def test_a_hand_covers_some_frames_of_the_clip_and_changes_no_other():
    images = clip()
    shown = [frame.image for frame in covered(open_source(str(PACKAGED / "clip")))]
    changed = [(a != b).any(axis=2).mean() for a, b in zip(images, shown, strict=True)]
    assert [number for number, share in enumerate(changed) if share] == list(HAND)
    # It comes, stays and goes again; it hides a part, and comes from below.
    assert 0 < changed[HAND.start] < changed[HAND.start + 1] < changed[HAND.start + 2]
    assert 0.2 < max(changed) < 0.5
    assert changed[HAND.stop - 1] == pytest.approx(changed[HAND.start], abs=0.01)
    top = images[HAND.start].shape[0] // 2
    assert (images[HAND.start][:top] == shown[HAND.start][:top]).all()


@pytest.mark.parametrize("shape", [(240, 320, 3), (97, 50, 3)])
def test_a_hand_is_the_same_for_the_same_arguments(shape):
    image = np.full(shape, 40, np.uint8)
    drawn = with_hand(image, 1.0, 7)
    assert (image == 40).all()
    assert (drawn.shape, drawn.dtype) == (shape, np.uint8)
    assert np.array_equal(drawn, with_hand(image, 1.0, 7))
    assert not np.array_equal(drawn, with_hand(image, 1.0, 8))
    assert np.array_equal(with_hand(image, 0.0, 7), image)


class KnowsItsClip:
    """Replaces ``Odometer.load``: an odometer with an alarm that knows the clip's own images."""

    def __init__(self, kind, load=Odometer.load):
        self.kind, self.load = kind, load

    def __call__(self, *arguments, **options):
        odometer = self.load(*arguments, **options)
        # Statistics are 0 for the clip's own images and 10 for any other; the limit is 2.
        alarm = AlarmSpec(self.kind, (0.0,) * 5, (1.0,) * 5, (2.0,) * 5, 20)
        odometer.calibration = msgspec.structs.replace(odometer.calibration, alarm=alarm)
        observer = odometer._observer
        known = {observer.prepare(image).tensor.tobytes() for image in clip()}
        infer = observer.infer

        def observed(prepared, seq):
            found = infer(prepared, seq)
            value = 0.0 if prepared.tensor.tobytes() in known else 10.0
            outputs = {
                NOVELTY_OUTPUT: np.full((1, 4), value),
                DEGRADATION_OUTPUT: np.zeros((1, 1)),
            }
            return replace(found, outputs={**found.outputs, **outputs})

        observer.infer = observed
        return odometer


@pytest.mark.whole_clip
def test_an_alarm_notices_the_hand_and_the_intervals_come_back(
    bundle_dir, capfd, tmp_path, monkeypatch
):
    monkeypatch.setattr(Odometer, "load", KnowsItsClip("recordings"))
    demo(bundle_dir, tmp_path / "hand.png")
    plain, _, hand = capfd.readouterr().out.partition("\nhand ")
    # The part without a hand stays as it is.
    assert "50 ok, 0 degraded" in plain
    assert "drift       clear: no alarm" in plain
    rows = [line.split()[:2] for line in hand.splitlines() if line.startswith("frame-")]
    assert [status for _, status in rows] == ["ok", "degraded", "degraded", "ok"]
    lost, back = int(rows[1][0][-6:]), int(rows[3][0][-6:])
    assert lost in HAND
    assert HAND.stop < back < 40
    assert f"(image_unfamiliar), intervals are back in frame {back}" in " ".join(hand.split())
    picture = cv2.imread(str(tmp_path / "hand.png"))
    assert count(picture, MARKED) > 1000
    assert count(picture, (225, 225, 225)) > 1000


def test_what_happened_is_told_whatever_it_is():
    estimates, _ = flight(50)

    def told(lost):
        changed = list(estimates)
        for number in lost:
            changed[number] = replace(
                changed[number],
                conformal_set=unbounded_set(),
                status=Status.DEGRADED,
                reasons=(Reason.IMAGE_UNFAMILIAR,),
            )
        return what_happened(changed)

    assert told([]) == "all these frames have an interval, the hand is not noticed"
    assert told(range(HAND.stop, 50)) == told([])
    some = "no interval in 2 of 12 frames (image_unfamiliar)"
    assert told([14, 15]) == f"{some}, intervals are back in frame 24"
    assert told([14, 15, *range(24, 31), 40]) == f"{some}, intervals are back in frame 31"
    assert told([14, 15, *range(24, 50)]) == f"{some}, nor in any later one"


# --------------------------------------------------------------------------------- the picture

MARKED, ESTIMATE = (167, 121, 204), (178, 114, 0)
MISSED = (0, 94, 213)
ABOUT_THE_PREDICTION = Chart("tangent_predicted")


def flight(frames=12, shift_m=0.0, rotation=(0.0, 0.0, 0.0), chart=ABOUT_THE_PREDICTION):
    """Straight flight along x; estimates are ``shift_m`` and ``rotation`` off, half-widths 0.1."""
    estimates, truths = [], []
    turn = geometry.quaternion_exp(np.array(rotation))
    for seq in range(frames):
        t = np.array([0.05 * seq, 1.0, 2.0])
        truths.append(np.array([*t, 0, 0, 0, 1.0]))
        pose = Pose(np.array([t[0], t[1] + shift_m, t[2]]), turn)
        point = chart.point(pose.to_array())
        estimates.append(
            PoseInterval(
                seq=seq,
                stamp_ns=None,
                source="",
                status=Status.OK,
                reasons=(),
                pose=pose,
                conformal_set=ConformalSet(point - 0.1, point + 0.1),
                confidence=0.9,
                scope="marginal",
                chart=chart,
            )
        )
    return estimates, truths


def count(picture, colour):
    """Count the pixels of a colour, within rounding."""
    return int((np.abs(picture.astype(int) - colour) <= 8).all(axis=2).sum())


def test_the_picture_changes_with_the_estimates_and_with_nothing_else():
    picture = draw_run(*flight(), "title")
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert picture.dtype == np.uint8
    assert np.array_equal(picture, draw_run(*flight(), "title"))
    assert not np.array_equal(picture, draw_run(*flight(shift_m=0.02), "title"))
    assert not np.array_equal(picture, draw_run(*flight(rotation=(0, 0, 0.02)), "title"))


def test_offsets_and_absolute_numbers_look_alike():
    reference = Chart("tangent_reference", geometry.quaternion_exp(np.array([0.0, 0.0, -0.7])))
    pictures = [
        draw_run(*flight(rotation=(0.0, 0.0, 0.04), chart=chart), "title")
        for chart in (ABOUT_THE_PREDICTION, reference)
    ]
    assert np.abs(pictures[0].astype(int) - pictures[1]).mean() < 0.01


def test_a_truth_outside_its_interval_is_marked():
    inside, outside = (draw_run(*flight(shift_m=shift), "title") for shift in (0.09, 0.11))
    # The legend shows one mark; each of the twelve frames adds one on either side.
    assert count(inside, MISSED) > 0
    assert count(outside, MISSED) > 12 * count(inside, MISSED)


def test_a_set_in_two_pieces_shows_its_gap():
    estimates, truths = flight(frames=4)
    whole = draw_run(estimates, truths, "title")
    found = estimates[1].conformal_set
    bands = tuple(
        ((low, low + 0.05), (high - 0.05, high))
        for low, high in zip(found.lower.tolist(), found.upper.tolist(), strict=True)
    )
    estimates[1] = replace(estimates[1], conformal_set=replace(found, bands=bands))
    assert count(draw_run(estimates, truths, "title"), (255, 255, 255)) > count(whole, (255,) * 3)


def test_a_frame_without_interval_or_truth_is_grey_and_a_run_of_them_no_picture():
    estimates, truths = flight()
    grey = (225, 225, 225)
    full = count(draw_run(estimates, truths, "title"), grey)
    degraded = [*estimates[:-1], replace(estimates[-1], conformal_set=unbounded_set())]
    assert count(draw_run(degraded, truths, "title"), grey) > full
    assert count(draw_run(estimates, [*truths[:-1], None], "title"), grey) > full
    with pytest.raises(UsageError, match="none of the 12 frames has finite bounds"):
        draw_run(estimates, [None] * 12, "title")
    with pytest.raises(UsageError, match="found 11 for 12 estimates"):
        draw_run(estimates, truths[1:], "title")


def test_a_span_is_marked_with_an_image_beside_the_path():
    estimates, truths = flight()
    image = np.full((30, 40, 3), (8, 248, 8), np.uint8)

    def drawn(span):
        return draw_run(estimates, truths, "title", span=span)

    plain, short, wide = map(
        drawn, (None, Span(3, 8, "hand", 5, image), Span(3, 11, "x", 5, image))
    )
    assert count(plain, MARKED) == 0
    assert 0 < count(short, MARKED) < count(wide, MARKED)
    # The image is in the left panel and hides no estimate there.
    shown = (np.abs(short.astype(int) - (8, 248, 8)) <= 8).all(axis=2)
    assert 0.9 * 140 * 105 < shown.sum() <= 140 * 105
    assert shown[128:715, 75:505].sum() == shown.sum()
    assert (np.abs(plain[shown].astype(int) - ESTIMATE) > 8).any(axis=1).all()


@pytest.mark.parametrize("frames", [1, 2, 2000])
def test_a_run_of_any_length_is_drawn(frames):
    estimates, truths = flight(frames=frames)
    assert draw_run(estimates, truths, "title").shape == (HEIGHT, WIDTH, 3)


def test_an_estimate_without_error_or_width_is_drawn():
    estimates, truths = flight(frames=1)
    point = estimates[0].chart.point(estimates[0].pose.to_array())
    exact = replace(estimates[0], conformal_set=ConformalSet(point, point))
    assert count(draw_run([exact], truths, "title"), MISSED) == count(
        draw_run(estimates, truths, "title"), MISSED
    )


def test_a_file_that_cannot_be_written_is_a_sink_error(tmp_path):
    picture = draw_run(*flight(), "title")
    write_png(tmp_path / "a.png", picture)
    assert np.array_equal(cv2.imread(str(tmp_path / "a.png")), picture)
    for target in (tmp_path / "missing" / "a.png", tmp_path, f"{tmp_path}/a\0.png"):
        with pytest.raises(SinkError, match="cannot be written"):
            write_png(target, picture)


@pytest.mark.whole_clip
def test_a_bundle_that_was_not_measured_says_nothing_of_what_to_expect(
    rewrite, bundle, capfd, tmp_path
):
    folder = rewrite(msgspec.structs.replace(bundle.calibration, name="another"))
    demo(folder, tmp_path / "a.png")
    lines = capfd.readouterr().out.splitlines()
    assert lines[0].startswith("another: digests match")
    assert not any(line.startswith("expected") for line in lines)
    assert lines[-1] == str(tmp_path / "a.png")


def test_the_documented_output_has_the_form_of_the_real_one(tmp_path):
    page = (ROOT / "docs/first-run.md").read_text("utf-8")
    documented = page.partition("```text\n")[2].partition("```")[0]

    def form(text):
        return [
            re.sub(r"[\d.]+(e-\d+)?", "0", " ".join(line.split())) for line in text.splitlines()
        ]

    assert form(run_demo(tmp_path).stdout) == form(documented)
