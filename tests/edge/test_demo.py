"""The demonstration: one command in an empty folder, its picture and its expected figures."""

import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.errors import SinkError, UsageError
from cvo_edge.estimate import PoseInterval, Status
from cvo_edge.output.picture import HEIGHT, WIDTH, draw_run, write_png
from cvo_edge.pose import Chart, Pose
from cvo_edge.programs.demo import EXPECTED, PACKAGED, demo, expected_coverage
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
    shown = [line.split()[0] for line in lines if line.startswith(("frame-", "..."))]
    assert shown == [*(f"frame-{number:06}" for number in range(4)), "..."]
    (coverage,) = [line for line in lines if line.startswith("coverage")]
    assert coverage.endswith("of 50 frames")
    shown = " ".join(done.stdout.partition("expected")[2].split())
    expected = expected_coverage(read_calibration(PACKAGED / "bundle").digest)
    assert shown == f"{expected} {lines[-1]}"
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
        # The bundles state coverage for a frame of a new flight.
        assert entry["one_dof"]["mean"] > 0.9


def test_the_sentence_has_the_figures_of_its_bundle_and_there_is_none_for_others():
    for digest, entry in report()["bundles"].items():
        sentence = expected_coverage(digest)
        for key in ("one_dof", "all_six"):
            figures = entry[key]
            assert f"{figures['q05']:.2f} to {figures['q95']:.2f}" in sentence
            assert f"(mean {figures['mean']:.2f})" in sentence
        assert f"new flights ({report()['flights']} measured)" in sentence
    assert expected_coverage("0" * 64) is None


# --------------------------------------------------------------------------------- the picture

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
