"""The martingale across recordings, and the command that bets with it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

from cvo_edge.bundle.format import FAMILIARITY, AlarmSpec, TensorSpec
from cvo_edge.bundle.reading import encode_calibration, read_calibration
from cvo_edge.errors import (
    BundleMismatchError,
    CalibrationFileError,
    GateError,
    SourceError,
    UsageError,
)
from cvo_edge.monitor import martingale
from cvo_edge.monitor.martingale import ALARM, RecordingMartingale, mean_novelty, mixture, p_value
from cvo_edge.output.records import header_of
from cvo_edge.pose import Chart
from cvo_edge.programs.cli import app
from cvo_edge.programs.drift import drift_lines, drift_of
from cvo_edge.record import Record, Status

_FIVE = (1.0,) * 5
REFERENCE = (0.31, 0.29, 0.35, 0.3, 0.33, 0.28, 0.32, 0.34, 0.27, 0.36, 0.26)


@pytest.mark.parametrize("count", [1, 2, 7, 40])
@pytest.mark.parametrize("surprise", [0.0, 1e-3, 0.7, 5.0, 60.0])
def test_the_mixture_is_the_integral_over_power_martingales(count, surprise):
    integrate = pytest.importorskip("scipy.integrate")
    expected, _ = integrate.quad(
        lambda e: e**count * math.exp(surprise * (1.0 - e)), 0.0, 1.0, epsrel=1e-12, epsabs=0.0
    )
    assert mixture(count, surprise) == pytest.approx(expected, rel=1e-9)


def test_a_capital_beyond_floats_stays_finite():
    assert math.isfinite(mixture(1000, 5000.0))
    assert mixture(1000, 5000.0) > 1e300


def test_p_values_of_exchangeable_numbers_are_uniform_with_ties_and_without():
    # Averaged over the last of all rotations and over the share, P(p <= a) = a.
    shares = (np.arange(200) + 0.5) / 200
    for numbers in ([1.0, 2.0, 3.0, 4.0, 5.0], [1.0, 1.0, 1.0, 2.0, 2.0], [0.0] * 5):
        found = [
            p_value([*numbers[:k], *numbers[k + 1 :], numbers[k]], share)
            for k in range(5)
            for share in shares
        ]
        assert np.sort(found) == pytest.approx((np.arange(1000) + 0.5) / 1000, abs=3e-3)


def _ever(reference, recordings):
    """After how many recordings the martingale has passed 20, or None."""
    bets = RecordingMartingale(reference)
    return next((k for k, x in enumerate(recordings.tolist(), 1) if bets.add(x).alarm), None)


def test_exchangeable_recordings_seldom_alarm_and_drifted_ones_soon_do(monkeypatch):
    generator = np.random.default_rng(0)
    trials, alarms, delays = 300, 0, []
    for trial in range(trials):
        # The bound is over the shares of ties as well as over recordings.
        monkeypatch.setattr(martingale, "_SEED", trial)
        recordings = generator.exponential() * generator.standard_t(2, size=41)
        alarms += _ever(recordings[:11], recordings[11:]) is not None
        delays.append(_ever(recordings[:11], 1e6 + recordings[11:]) or math.inf)
    bound = 1.0 / ALARM
    assert alarms / trials <= bound + 3.0 * math.sqrt(bound * (1.0 - bound) / trials)
    assert np.median(delays) == 7


def test_an_alarm_lasts():
    bets = RecordingMartingale(np.linspace(0.2, 0.4, 50).tolist())
    drifted = [bets.add(1.0 + k) for k in range(10)]
    assert drifted[-1].alarm
    back = [bets.add(-float(k)) for k in range(500)]
    assert back[-1].martingale < ALARM
    assert back[-1].alarm


def test_the_mean_leaves_out_what_was_not_judged():
    assert mean_novelty([None, 0.25, None, 0.75]) == (2, 0.5)
    assert mean_novelty([None]) == (0, None)


@pytest.fixture
def watched(copied_bundle: Path) -> Path:
    """A bundle whose calibration recordings had the novelties of REFERENCE; no model runs."""
    return _with_alarm(copied_bundle, "recordings", REFERENCE)


def _with_alarm(folder, kind, recordings, n=11):
    calibration = read_calibration(folder)
    outputs = tuple(spec for spec in calibration.model.outputs if spec.name not in FAMILIARITY)
    outputs += tuple(TensorSpec(name=k, dtype="float32", shape=v) for k, v in FAMILIARITY.items())
    expected = dict(calibration.selftest.outputs)
    expected.update({name: (0.0,) * math.prod(shape) for name, shape in FAMILIARITY.items()})
    replace = msgspec.structs.replace
    changed = replace(
        calibration,
        model=replace(calibration.model, outputs=outputs),
        selftest=replace(calibration.selftest, outputs=expected),
        alarm=AlarmSpec(
            kind=kind, usual=(0.0,) * 5, scales=_FIVE, limits=_FIVE, n=n, recordings=recordings
        ),
    )
    (folder / "calibration.json").write_bytes(encode_calibration(changed))
    return folder


def _as_crossed(folder, folds):
    calibration = read_calibration(folder)
    replace = msgspec.structs.replace
    source, provenance = calibration.calibration, calibration.provenance
    split = replace(provenance.training_split, kind="sequence")
    options = {**provenance.options, "folds": folds}
    changed = replace(
        calibration,
        calibration=replace(source, split=split, crossed=folds),
        provenance=replace(provenance, training_split=split, options=options),
    )
    (folder / "calibration.json").write_bytes(encode_calibration(changed))


def _write(path, folder, *novelties, header=True, **changes):
    calibration = read_calibration(folder)
    first = header_of(calibration, Chart("tangent_predicted"), 0.9, "marginal")
    lines = [msgspec.structs.replace(first, **changes)] if header else []
    lines += [
        Record(seq, None, "", Status.INVALID, (), None, None, {}, novelty=novelty, drift="clear")
        for seq, novelty in enumerate(novelties)
    ]
    path.write_bytes(b"".join(msgspec.json.encode(line) + b"\n" for line in lines))
    return path


def test_recordings_are_compared_in_their_order(watched, tmp_path):
    files = [
        _write(tmp_path / "like.jsonl", watched, 0.2, None, 0.4),
        _write(tmp_path / "dark.jsonl", watched, None, None),
        *(_write(tmp_path / f"{k}.jsonl", watched, 2.0 + k, 3.0 + k) for k in range(12)),
    ]
    report = drift_of(watched, files)
    assert report.calibration_recordings == len(REFERENCE)
    like, dark, *strange = report.recordings
    assert (like.frames, like.judged, like.novelty) == (3, 2, 0.3)
    bets = RecordingMartingale(REFERENCE)
    assert (like.p, like.martingale, like.alarm) == bets.add(0.3)
    assert 5 / 12 < like.p <= 7 / 12
    # Nothing is bet on a recording of which no frame was judged.
    assert (dark.frames, dark.novelty, dark.p) == (2, None, None)
    assert dark.martingale == like.martingale
    for k, each in enumerate(strange):
        assert (each.p, each.martingale, each.alarm) == bets.add(2.5 + k)
    assert strange[-1].alarm
    assert drift_of(watched, files) == report
    last = drift_lines(report)[-1]
    assert last.startswith("alarm: the martingale reached 20 at ")
    assert last.endswith(
        "if all recordings are exchangeable with the calibrated ones, it ever does so with "
        "probability at most 0.05"
    )
    assert drift_lines(drift_of(watched, files[:1]))[-1] == "clear: the martingale stayed below 20"
    assert drift_lines(drift_of(watched, files[:2]))[-1] == (
        "clear: the martingale stayed below 20; 1 recordings without a judged frame count for "
        "nothing"
    )
    with pytest.raises(SourceError, match="found none in 1 recordings"):
        drift_of(watched, [files[1]])


def test_a_recording_counts_once(watched, tmp_path):
    first, other = (_write(tmp_path / f"{name}.jsonl", watched, 0.2, 0.4) for name in "ab")
    for files in ([first, first], [first, other]):
        with pytest.raises(UsageError, match=r"found that of .*a.jsonl again in .*.jsonl"):
            drift_of(watched, files)


@pytest.mark.parametrize("novelty", [1e308, -1e16])
def test_a_novelty_that_no_alarm_gives_is_refused(watched, tmp_path, novelty):
    with pytest.raises(SourceError, match="novelty"):
        drift_of(watched, [_write(tmp_path / "a.jsonl", watched, novelty, novelty)])


def test_nothing_is_proven_for_a_crossed_calibration(watched, tmp_path):
    files = [_write(tmp_path / f"{k}.jsonl", watched, 2.0 + k) for k in range(12)]
    report = drift_of(watched, files)
    assert not report.crossed
    _as_crossed(watched, 5)
    files = [_write(tmp_path / f"{k}.jsonl", watched, 2.0 + k) for k in range(12)]
    crossed = drift_of(watched, files)
    assert crossed.crossed
    assert crossed.recordings == report.recordings
    last = drift_lines(crossed)[-1]
    assert "nothing is proven" in last
    assert "probability" not in last


def test_the_command_prints_json_and_gates(watched, tmp_path):
    files = [str(_write(tmp_path / f"{k}.jsonl", watched, 2.0 + k)) for k in range(12)]
    run = CliRunner().invoke
    done = run(app, ["drift", str(watched), *files, "--json"])
    assert done.exit_code == 0
    report = drift_of(watched, files)
    assert json.loads(done.stdout) == json.loads(msgspec.json.encode(report))
    gated = run(app, ["drift", str(watched), *files, "--max-martingale", "20"])
    assert isinstance(gated.exception, GateError)
    assert "expected a martingale of at most 20, found " in str(gated.exception)
    assert len(gated.stdout.splitlines()) == len(files) + 3
    assert run(app, ["drift", str(watched), files[0], "--max-martingale", "20"]).exit_code == 0
    for limit in ("nan", "-1"):
        refused = run(app, ["drift", str(watched), files[0], "--max-martingale", limit])
        assert isinstance(refused.exception, UsageError)
        assert refused.stdout == ""


def test_records_of_another_bundle_are_refused_wherever_they_stand(watched, tmp_path):
    other = _write(tmp_path / "other.jsonl", watched, 0.3, digest="0" * 64, bundle="attic")
    text = r"other.jsonl: expected records of .* \(\w{16}\), found records of attic \(0{16}\)"
    with pytest.raises(BundleMismatchError, match=text):
        drift_of(watched, [other])
    own = _write(tmp_path / "own.jsonl", watched, 0.3)
    other.write_bytes(own.read_bytes() + other.read_bytes())
    with pytest.raises(BundleMismatchError, match=text):
        drift_of(watched, [own, other])
    bare = _write(tmp_path / "bare.jsonl", watched, 0.3, header=False)
    with pytest.raises(SourceError, match="expected a header that names the bundle, found none"):
        drift_of(watched, [bare])


def test_a_bundle_without_recordings_is_refused(copied_bundle, tmp_path):
    cases = {"frames": "an alarm of single frames", "recordings": "of an earlier release"}
    for kind, found in cases.items():
        _with_alarm(copied_bundle, kind, None)
        file = _write(tmp_path / "a.jsonl", copied_bundle, 0.3)
        with pytest.raises(CalibrationFileError, match=found):
            drift_of(copied_bundle, [file])


@pytest.mark.parametrize(("kind", "n"), [("frames", 11), ("recordings", 12)])
def test_a_bundle_has_one_number_for_each_recording(copied_bundle, kind, n):
    with pytest.raises(CalibrationFileError, match=r"alarm.recordings: expected one number"):
        _with_alarm(copied_bundle, kind, REFERENCE, n)
