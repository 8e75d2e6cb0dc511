"""The demonstration bundles: each runs here as it did where it was made."""

import json
from pathlib import Path

import numpy as np
import pytest

from cvo_edge import Odometer, open_source
from cvo_edge.engine.selftest import check_selftest
from cvo_edge.errors import GateError
from cvo_edge.ground_truth import open_ground_truth
from cvo_edge.pose_solver import PoseSolver

ARTIFACTS = Path(__file__).resolve().parents[2] / "calibration_artifacts"
METHODS = ["scr", "cjp", "cqr", "csp", "mcqr"]
NAMES = [f"{method}{suffix}" for method in METHODS for suffix in ("", "-int8")]


@pytest.fixture(params=NAMES)
def demonstration(request):
    return ARTIFACTS / f"synthetic-room-{request.param}"


def test_it_passes_its_self_test_and_is_of_its_method(demonstration):
    with Odometer.load(demonstration) as odometer:
        assert check_selftest(odometer) < odometer.calibration.selftest.tolerance
        assert odometer.calibration.name == demonstration.name
        method, _, precision = demonstration.name.removeprefix("synthetic-room-").partition("-")
        assert odometer.calibration.method == method
        assert odometer.calibration.model.precision == (precision or "fp32")


def test_a_machine_whose_solver_rounds_to_seven_digits_fails_the_self_test(monkeypatch):
    solve = PoseSolver.solve

    def rounded(*arguments):
        found = solve(*arguments)
        return found._replace(pose=found.pose.astype(np.float32).astype(np.float64))

    monkeypatch.setattr(PoseSolver, "solve", rounded)
    with (
        Odometer.load(ARTIFACTS / "synthetic-room-scr") as odometer,
        pytest.raises(GateError, match="self-test: expected the pose of exact points within 1e-09"),
    ):
        check_selftest(odometer)


@pytest.mark.parametrize("method", METHODS)
def test_eight_bits_cost_little_and_the_file_is_smaller(method, clip_dir):
    plain, int8 = (ARTIFACTS / f"synthetic-room-{method}{suffix}" for suffix in ("", "-int8"))
    sizes = [(folder / "model.onnx").stat().st_size for folder in (plain, int8)]
    assert sizes[0] - sizes[1] > 2**20
    frames = list(open_source(str(clip_dir)))
    with Odometer.load(plain) as first, Odometer.load(int8) as second:
        widths = [
            np.array([e.conformal_set.width() for e in odometer.stream(frames)])
            for odometer in (first, second)
        ]
    bounded = np.isfinite(widths).all(axis=(0, 2))
    assert bounded.mean() >= 0.9
    widths = [each[bounded].mean(axis=0) for each in widths]
    # Rounding shows in intervals of half a centimetre.
    assert np.mean(widths[1] / widths[0]) < {"scr": 1.3}.get(method, 1.1)


def test_it_is_small_enough_for_a_repository(demonstration):
    assert (demonstration / "model.onnx").stat().st_size <= 8 * 2**20
    assert (demonstration / "calibration.json").stat().st_size <= 64 * 1024


@pytest.mark.whole_clip
@pytest.mark.parametrize("scope", ["marginal", "joint"])
def test_the_clip_is_covered_about_as_often_as_stated(demonstration, clip_dir, scope):
    # A new flight of the training scene: exchangeability does not hold, coverage is only close.
    truth = open_ground_truth(clip_dir)
    with Odometer.load(demonstration, scope=scope) as odometer:
        estimates = list(odometer.stream(open_source(str(clip_dir))))
    given = [estimate for estimate in estimates if estimate.bounded]
    # An alarm may be false, at most in 24 % of such flights.
    assert len(given) >= 0.9 * len(estimates)
    covered = np.array([estimate.covers(truth.pose_of(estimate)) for estimate in given])
    assert covered.mean() > 0.75


@pytest.mark.parametrize("precision", ["", "-int8"])
def test_a_solver_gives_the_same_bits_again_and_with_more_threads(precision, clip_dir):
    frames = list(open_source(str(clip_dir)))[:20]
    runs = []
    for threads in (1, 2, 1):
        with Odometer.load(
            ARTIFACTS / f"synthetic-room-scr{precision}", threads=threads
        ) as odometer:
            runs.append(
                [
                    (each.pose.to_array().tolist(), each.lower.tolist(), each.upper.tolist())
                    for each in odometer.stream(frames)
                ]
            )
    assert runs[0] == runs[1] == runs[2]


@pytest.mark.whole_clip
def test_every_record_is_json_and_bands_are_ordered_and_disjoint(demonstration, clip_dir):
    given = 0
    with Odometer.load(demonstration) as odometer:
        for estimate in odometer.stream(open_source(str(clip_dir))):
            record = json.loads(json.dumps(estimate.to_dict(), default=list, allow_nan=False))
            bands = record["interval"]["bands"]
            given += bands is not None
            assert bands is None or odometer.calibration.method == "csp"
            for dof, row in enumerate(bands or []):
                flat = [end for band in row for end in band]
                assert flat == sorted(set(flat))
                assert flat[0] == record["interval"]["lower"][dof]
                assert flat[-1] == record["interval"]["upper"][dof]
    assert (given >= 45) is (odometer.calibration.method == "csp")
