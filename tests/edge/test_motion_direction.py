"""Intervals on the motion of an estimator without a scale: rotation, and direction."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

from cvo_edge import geometry
from cvo_edge.errors import UsageError
from cvo_edge.motion.annotation import annotate
from cvo_edge.motion.audit import audit
from cvo_edge.motion.conformalize import conformalize
from cvo_edge.motion.direction import angles
from cvo_edge.motion.format import decode_motion_file, encode_motion_file
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.intervals import Level, MotionCalibration
from cvo_edge.motion.pairs import Pair
from cvo_edge.motion.relative import motion, rotated
from cvo_edge.motion.tracker import MotionTracker
from cvo_edge.programs.cli import app
from cvo_edge.spread import Here

from .simulated_drives import drive

ONE = (Horizon.parse("1f"),)


def without_scale(seed: int, poses: int = 300) -> Pair:
    """A drive whose estimate has steps of length 1, or 0 in a tenth of them."""
    pair = drive(seed, poses)
    rng = np.random.default_rng(seed)
    step = motion(pair.estimate[:-1], pair.estimate[1:])
    step[:, :3] /= np.linalg.norm(step[:, :3], axis=1, keepdims=True)
    off = geometry.quaternion_exp(np.deg2rad(2.0 + seed % 3) * rng.normal(size=(len(step), 3)))
    step[:, :3] = rotated(off, step[:, :3])
    step[rng.random(len(step)) < 0.1, :3] = 0.0
    moved = rotated(pair.estimate[:-1, 3:], step[:, :3])
    estimate = pair.estimate.copy()
    estimate[:, :3] = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
    return replace(pair, estimate=estimate, unscaled=True)


@pytest.fixture(scope="module")
def calibration() -> MotionCalibration:
    file = conformalize(Here([without_scale(seed) for seed in range(8)]), "camera", ONE)
    again = decode_motion_file(encode_motion_file(file))
    assert again.translation == "direction"
    return MotionCalibration(again)


def test_new_drives_are_covered_where_there_is_a_direction(calibration: MotionCalibration) -> None:
    report = audit(calibration, Level(), [without_scale(seed) for seed in range(20, 26)])
    found = report.over("1f")
    assert np.mean([each.position for each in found]) == pytest.approx(0.9, abs=0.04)
    assert np.mean([each.rotation for each in found]) == pytest.approx(0.9, abs=0.04)
    assert np.mean([each.dof for each in found]) == pytest.approx(0.9, abs=0.04)
    for each in found:
        assert 0.8 * each.motions < (each.directions or 0) < 0.98 * each.motions
    assert 2.0 < np.rad2deg(np.mean([each.radii[0] for each in found])) < 12.0
    assert report.failure(0.8) is None
    assert report.failure(0.99) is not None


def test_a_record_has_a_direction_instead_of_metres(calibration: MotionCalibration) -> None:
    pair = without_scale(30)
    records = list(annotate(calibration, Level(), pair.stamps_ns, pair.estimate, {}))
    pointed = 0
    for record in records[1:]:
        (found,) = record.motion
        assert found.t_m is None
        assert found.position is None
        assert found.metres is None
        if record.reasons:
            continue
        assert found.bounded
        assert found.lower is not None
        assert found.lower[:3] == (None,) * 3
        assert None not in found.lower[3:]
        step = motion(pair.estimate[record.seq - 1], pair.estimate[record.seq])[:3]
        assert (found.direction is not None) == bool(step.any())
        if isinstance(found.direction, msgspec.Struct):
            pointed += 1
            assert np.allclose(found.direction.xyz, step, atol=1e-9)
            assert 0.0 < found.direction.radius < np.pi
    assert pointed > 50
    tracker = MotionTracker(calibration)
    stream = [tracker.step(int(s), p) for s, p in zip(pair.stamps_ns, pair.estimate, strict=True)]
    assert stream == records


def test_an_angle_is_that_between_the_translations() -> None:
    moved, true = np.zeros((4, 7)), np.zeros((4, 7))
    moved[:, :3] = (1, 0, 0), (1, 0, 0), (0, 0, 0), (0, 1, 0)
    true[:, :3] = (0.2, 0, 0), (0, 0.1, 0), (1, 0, 0), (1e-4, 0, 0)
    assert np.allclose(angles(moved, true), [0.0, np.pi / 2, np.nan, np.nan], equal_nan=True)


def test_what_needs_a_scale_is_refused(calibration: MotionCalibration) -> None:
    pairs = [without_scale(seed) for seed in range(2)]
    with pytest.raises(UsageError, match="horizon 10m: expected frames or seconds"):
        conformalize(Here(pairs), "camera", [Horizon.parse("10m")])
    with pytest.raises(UsageError, match="window 10s: expected none"):
        conformalize(Here(pairs), "camera", ONE, [Horizon.parse("10s")])
    with pytest.raises(UsageError, match="expected steps without a scale"):
        conformalize(Here([pairs[0], drive(1)]), "camera", ONE)
    with pytest.raises(UsageError, match="expected steps without a scale"):
        audit(calibration, Level(), [drive(1)])
    with pytest.raises(UsageError, match="covariance: expected a calibration in metres"):
        MotionTracker(calibration, covariance="interval")
    with pytest.raises(UsageError, match="adapt: expected a calibration in metres"):
        MotionTracker(calibration, adapt=True)


def written(pair: Pair, folder: Path) -> tuple[Path, Path]:
    paths = folder / f"{pair.name}.tum", folder / f"{pair.name}-truth.tum"
    for path, poses, header in zip(
        paths, (pair.estimate, pair.track.poses), ("scale: none", ""), strict=True
    ):
        table = np.column_stack([1e-9 * pair.stamps_ns, poses])
        np.savetxt(path, table, fmt="%.9f", header=header)
    return paths


def run(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=True)
    error = result.exception
    code = getattr(error, "exit_code", result.exit_code)
    return code, f"{result.output}{error if code else ''}"


def test_files_say_that_they_have_no_scale(tmp_path: Path) -> None:
    files = [path for seed in range(3) for path in written(without_scale(seed), tmp_path)]
    motion_file = tmp_path / "motion.json"
    code, text = run("conformalize", *files, "-o", motion_file, "--horizon", "1f,1s")
    assert (code, "direction in deg" in text) == (0, True)
    code, text = run("audit", *files, motion_file)
    assert (code, "directions count where there is one" in text) == (0, True)
    assert run("annotate", files[0], motion_file, "-o", tmp_path / "a.jsonl")[0] == 0
    code, text = run("annotate", files[1], motion_file)
    assert (code, "expected steps without a scale" in text) == (2, True)
    code, text = run("conformalize", files[1], files[0], "-o", tmp_path / "b.json")
    assert (code, "expected a truth in metres" in text) == (2, True)
    longer = np.loadtxt(files[0])
    longer[:, 1:4] *= 3.0
    np.savetxt(tmp_path / "long.tum", longer, fmt="%.9f", header="scale: none")
    code, text = run("annotate", tmp_path / "long.tum", motion_file)
    assert (code, "after # scale: none, found a median of 3" in text) == (6, True)
    code, text = run("annotate", files[0], motion_file, "--format", "csv")
    assert (code, "expected jsonl or tum" in text) == (2, True)
