"""Evaluation: report keys, coverage bands, gates, and agreement with the odometer per frame."""

import json
import subprocess
import sys
from itertools import product

import numpy as np
import pytest
from typer.testing import CliRunner

from cvo_edge import Odometer
from cvo_edge.errors import CvoError, GateError, SourceError, UsageError
from cvo_export.bundles.figures import coverage_band
from cvo_export.bundles.online import Schedule, parse_schedule
from cvo_export.cli import app
from cvo_export.data.noise import parse_noise
from cvo_export.datasets import open_dataset
from cvo_export.evaluate import check_coverage, evaluate, find_level, table

from .conftest import DATASET

CVO_EXPORT = [sys.executable, "-c", "from cvo_export.cli import main; main()"]


@pytest.fixture(scope="module")
def report(tiny_bundle, tiny_run):
    return evaluate(tiny_bundle, tiny_run.dataset, "test")


def test_report_has_the_documented_keys(report):
    for key in ("method", "dataset", "subset", "frames", "point_error", "levels", "sequences"):
        assert key in report
    assert set(report["frames"]) == {"total", "bounded", "degraded", "invalid"}
    kinds = product(("median", "p90", "p99"), ("m", "deg"))
    assert set(report["point_error"]) == {f"{name}_{unit}" for name, unit in kinds}
    assert len(report["levels"]) == 10
    for level in report["levels"]:
        for key in (
            "confidence",
            "scope",
            "coverage",
            "coverage_bounded",
            "coverage_band",
            "joint_coverage",
            "mean_width",
            "median_width",
            "interval_score",
            "normalised_interval_score",
            "unbounded_share",
        ):
            assert key in level
    json.dumps(report, allow_nan=False)


@pytest.mark.parametrize(
    ("share", "still", "said"),
    [
        (0.5, [], None),
        (1.0, [], "position and rotation"),
        (1.0, ["rx", "ry", "rz"], "position"),
        (1.0, ["rx"], "position and rotation"),
    ],
)
def test_a_network_that_hardly_beats_one_pose_is_called_that(report, share, still, said):
    error = report["point_error"]
    mean = {"position_m": error["median_m"] / share, "rotation_deg": error["median_deg"] / share}
    text = "\n".join(table({**report, "mean_pose_error": mean, "still": still}))
    assert f"mean pose    median {100 * mean['position_m']:.2f} cm" in text
    warning = None if said is None else f"warning: in {said} the network is hardly better"
    assert warning in text if warning else "hardly better" not in text


def test_coverage_and_width_are_those_of_the_odometer(report, tiny_bundle, tiny_run):
    level = find_level(report["levels"], 0.9, "marginal")
    covered, widths = [], []
    with Odometer.load(tiny_bundle) as odometer:
        for index in tiny_run.split.roles["test"].tolist():
            estimate = odometer.step(tiny_run.dataset.read_image(index))
            covered.append(estimate.covers(tiny_run.dataset.poses[index]))
            widths.append(estimate.upper - estimate.lower)
    np.testing.assert_allclose(level["coverage"], np.mean(covered, axis=0))
    np.testing.assert_allclose(level["mean_width"], np.mean(widths, axis=0))
    assert level["joint_coverage"] == pytest.approx(np.mean(np.all(covered, axis=1)))


def test_unbounded_levels_count_the_workspace(report):
    level = find_level(report["levels"], 0.99, "marginal")
    assert level["unbounded_share"] == 1.0
    assert level["coverage"] == [1.0] * 6
    assert level["coverage_bounded"] is None
    assert level["coverage_band"] is None
    assert np.isfinite(level["interval_score"]).all()


@pytest.mark.parametrize(
    ("n", "n_test", "confidence"), [(64, 64, 0.9), (200, 200, 0.8), (19, 50, 0.9)]
)
def test_the_band_holds_ninety_nine_percent_of_simulated_coverages(n, n_test, confidence):
    generator = np.random.default_rng(n)
    k = int(np.ceil((n + 1) * confidence - 1e-9))
    q_hat = np.sort(generator.random((20_000, n)), axis=1)[:, k - 1]
    coverage = generator.binomial(n_test, q_hat) / n_test
    low, high = coverage_band(n, n_test, confidence)
    inside = np.mean((low <= coverage) & (coverage <= high))
    assert 0.987 < inside < 1.0
    assert coverage_band(8, 100, 0.9) is None


def test_another_data_set_is_refused_for_test_but_not_for_all(tiny_bundle):
    other = open_dataset("synthetic:room,flights=2,frames=10,size=64x48,seed=9")
    with pytest.raises(SourceError, match="--subset all"):
        evaluate(tiny_bundle, other, "test")
    assert evaluate(tiny_bundle, other, "all")["frames"]["total"] == 20


def test_coverage_gate(report):
    check_coverage(report, 0.3)
    with pytest.raises(GateError, match="expected coverage of at least 1"):
        check_coverage(report, 1.01)


def test_table_shows_every_level(report):
    text = "\n".join(table(report))
    # Five levels, and what the covariance at one of them is worth.
    assert text.count("marginal  ") == 6
    assert text.count("joint  ") >= 5
    assert text.count("of frames exchangeable with the calibration frames, ") == 4
    assert "at 0.99 marginal and joint: unbounded; finite from 99 calibration frames, has" in text
    assert text.count("-   ") >= 2  # unbounded sets have no band


def test_columns_stay_apart_however_large_a_number_is(report):
    level = {**report["levels"][0], "median_width": [1e7] * 6, "normalised_interval_score": 1e9}
    found = table({**report, "still": [], "levels": [level]})
    row = next(
        line for line in found if line.startswith(f"{level['confidence']:<8g}{level['scope']}")
    )
    assert row.split()[-3:] == ["1e+09", "6e+08", "1e+09"]


def test_labels_bring_coverage_back_after_a_change(tiny_bundle, tiny_run, monkeypatch):
    monkeypatch.setattr("cvo_export.bundles.online._LEAST", 400)
    schedule, dark = parse_schedule("every=5,delay=3"), parse_noise("exposure:-3")
    report = evaluate(tiny_bundle, tiny_run.dataset, "test", 1, None, schedule, dark)
    online = report["online"]
    assert (online["every"], online["delay"], online["eta"]) == (5, 3, 0.3)
    assert [row["scope"] for row in online["rows"]] == ["marginal"] * 2 + ["joint"] * 2
    for plain, adapted in zip(online["rows"][::2], online["rows"][1::2], strict=True):
        assert [stage["stage"] for stage in plain["stages"]] == ["clean", str(dark), "clean"]
        assert {stage["width_ratio"] for stage in plain["stages"]} == {1.0}
        later = [
            [stage["windows"][2]["coverage"] for stage in row["stages"]] for row in (plain, adapted)
        ]
        assert later[0][1] < 0.8
        assert abs(later[1][1] - 0.9) < 0.05
        assert abs(adapted["labelled_missed"] - 0.1) <= adapted["bound"]
    level = find_level(report["levels"], 0.9, "joint")["joint_coverage"]
    clean = online["rows"][2]["stages"][0]["windows"]
    total = sum(window["frames"] * window["coverage"] for window in clean)
    assert total / online["frames"] == pytest.approx(level)
    text = table(report)
    assert [line.split()[:2] for line in text if "every=5,delay=3" in line] == [
        ["marginal", "every=5,delay=3"],
        ["joint", "every=5,delay=3"],
    ]
    json.dumps(report, allow_nan=False)


@pytest.mark.parametrize("text", ["every=0,delay=5", "every=5", "20,5", "every=5,delay=1024"])
def test_a_schedule_that_cannot_be_kept_is_refused(text):
    with pytest.raises(UsageError) as caught:
        parse_schedule(text)
    assert str(caught.value) == (
        "online: expected every=K,delay=D with K of at least 1 and D of at most 1023, found "
        f"{text!r}"
    )
    assert parse_schedule("every=20,delay=0") == Schedule(20, 0)


def test_noise_and_then_are_told_apart(tiny_bundle, tiny_run):
    noise = parse_noise("occlusion")
    for arguments in ((None, None, noise), (noise, Schedule(5, 5), None)):
        with pytest.raises(UsageError, match="then: expected --online every=K,delay=D with --then"):
            evaluate(tiny_bundle, tiny_run.dataset, "test", 1, *arguments)


def cvo_export(*arguments):
    command = [*CVO_EXPORT, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


# Two of eight recordings calibrate.
PROVEN = (
    "at 0.5 marginal and joint: over new recordings, on average at most 50 % of frames are missed, "
    "where a recording that misses more than half counts as half (in full: 66.7 %)",
    "at 0.9 marginal and joint: unbounded; finite from 4 calibration recordings, has 2",
    "at 0.9 marginal and joint: over new recordings of equal length, on average at most 40 % of "
    "frames are missed",
)
MEASURED = "coverage of a calibration recording left out, at 0.9: marginal "


def in_process(*arguments):
    """Run a command here: torch is loaded already."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_command_line_trains_publishes_and_evaluates(tmp_path):
    run, bundle = tmp_path / "run", tmp_path / "bundle"
    trained = in_process(
        *("train", "cjp", DATASET, run, "--split", "sequence", "--weights", "none"),
        *("--backbone", "test_efficientnet", "--size", "64x48", "--copies", 1, "--steps", 100),
    )
    assert trained.exit_code == 0, trained.stderr
    assert trained.stdout == ""
    assert trained.stderr.startswith("synthetic-room 320 frames in 8 sequences; none skipped\n")
    assert "best        val score" in trained.stderr
    published = in_process("publish", run, bundle)
    assert published.exit_code == 0, published.stderr
    assert "(seed 0), capped at 0.5" in " ".join(published.stdout.split())
    evaluated = in_process("evaluate", bundle, DATASET, "--json", tmp_path / "report.json")
    assert evaluated.exit_code == 0, evaluated.stderr
    assert "pooled rule" in evaluated.stdout
    found = json.loads((tmp_path / "report.json").read_text())
    assert found["other_rule"]["rule"] == "pooled"
    lines = evaluated.stdout.splitlines()
    for line in PROVEN:
        assert line in lines
    # Without one of two recordings, only the pooled rule has a finite threshold at 0.9.
    assert sum(line.startswith(MEASURED) for line in lines) == 1
    assert find_level(found["levels"], 0.9, "joint")["left_out"] is None
    assert find_level(found["levels"], 0.5, "joint")["left_out"]["standard_error"] > 0.0


def test_a_failed_gate_is_exit_8_with_the_report_still_written(tiny_bundle):
    gated = cvo_export("evaluate", tiny_bundle, DATASET, "--min-coverage", 1.0, "--json", "-")
    assert gated.returncode == 8
    assert json.loads(gated.stdout)["method"] == "cjp"
    read, complaint = gated.stderr.splitlines()
    assert read == "synthetic-room 320 frames in 8 sequences; none skipped"
    assert complaint.startswith("cvo-export: evaluate: expected coverage of at least 1")


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ("train cjp nowhere RUN", 2),
        ("train cjp 7scenes:/no/such RUN", 6),
        ("train cjp DATASET RUN --weights /no/such/file", 2),
        ("train cjp DATASET RUN --weights none --size 64", 2),
        ("train cjp DATASET RUN --weights none --stages 7", 2),
        ("train cjp DATASET RUN --weights none --grid 99x99", 2),
        ("train cjp DATASET TINY --weights none", 2),
        ("publish RUN BUNDLE", 2),
        ("evaluate RUN DATASET", 3),
        ("render DATASET RUN --sequence flight-99", 2),
        ("render DATASET TINY --sequence flight-01", 7),
    ],
)
def test_a_refusal_is_one_line_with_its_exit_code(tmp_path, run_dir, tiny_run, arguments, code):
    named = {"DATASET": DATASET, "RUN": tmp_path / "run", "TINY": run_dir, "BUNDLE": tmp_path / "b"}
    with pytest.raises(CvoError) as caught:
        app([str(named.get(word, word)) for word in arguments.split()], standalone_mode=False)
    assert caught.value.exit_code == code
    assert "\n" not in str(caught.value)
