"""``motion.json``, trajectories in files, and the commands on them."""

import json
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, get_args

import cv2
import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

from cvo_edge import geometry
from cvo_edge.errors import CalibrationFileError, SourceError, UsageError
from cvo_edge.motion.adaptation import MotionAdaptation
from cvo_edge.motion.annotation import annotate
from cvo_edge.motion.audit import audit
from cvo_edge.motion.conformalize import conformalize
from cvo_edge.motion.files import OPENVINS_FORM, read_poses
from cvo_edge.motion.fitting import Scale
from cvo_edge.motion.format import (
    BIAS_WIDTH,
    MotionFile,
    decode_motion_file,
    encode_motion_file,
)
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.intervals import MotionCalibration
from cvo_edge.motion.pairs import Pair
from cvo_edge.motion.records import MotionHeader, MotionReason, MotionRecord
from cvo_edge.motion.rounding import coefficients_of, scale_of
from cvo_edge.motion.trace import scale_width
from cvo_edge.motion.tracker import MotionTracker
from cvo_edge.programs.cli import app
from cvo_edge.record import Status
from cvo_edge.spread import Here
from cvo_edge.trajectories.interpolation import Track
from cvo_edge.vocabulary import MOTION_RULES, MotionCovariance

from .simulated_drives import PERIOD_NS, drive

HORIZONS = tuple(map(Horizon.parse, ("1f", "1s", "5m")))
WINDOWS = (Horizon.parse("5s"),)


@pytest.fixture(scope="module")
def file() -> MotionFile:
    drives = [drive(seed, noise=1.0 + seed % 3) for seed in range(6)]
    return conformalize(Here(drives), "test", HORIZONS, WINDOWS)


@pytest.fixture(scope="module")
def calibration(file: MotionFile) -> MotionCalibration:
    return MotionCalibration(file)


def written(pair: Pair, folder: Path) -> tuple[Path, Path]:
    """Write a pair as two TUM files."""
    paths = folder / f"{pair.name}.tum", folder / f"{pair.name}-truth.tum"
    for path, poses in zip(paths, (pair.estimate, pair.track.poses), strict=True):
        table = np.column_stack([1e-9 * pair.stamps_ns, poses])
        np.savetxt(path, table, fmt="%.9f")
    return paths


def run(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=True)
    error = result.exception
    code = getattr(error, "exit_code", result.exit_code)
    return code, f"{result.output}{error if code else ''}"


def test_a_file_comes_back(file: MotionFile) -> None:
    content = encode_motion_file(file)
    again = decode_motion_file(content)
    assert msgspec.structs.replace(again, digest=file.digest) == file
    assert encode_motion_file(again) == content


def test_twelve_horizons_fit_into_a_file(file: MotionFile) -> None:
    generator = np.random.default_rng(0)
    width = scale_width(0)
    ranges = np.ones(width) / 3.0
    full = msgspec.structs.replace(
        file.horizons[0],
        bias=coefficients_of(generator.normal(scale=1e-3, size=(BIAS_WIDTH, 6))),
        scale=scale_of(Scale(generator.normal(size=(1 + width, 8)), -ranges, ranges)),
    )
    horizons = tuple(msgspec.structs.replace(full, horizon=f"{n}s") for n in range(10, 22))
    windows = tuple(msgspec.structs.replace(file.windows[0], window=f"{n}s") for n in (10, 20))
    content = encode_motion_file(msgspec.structs.replace(file, horizons=horizons, windows=windows))
    assert len(content) <= 64 * 1024


def test_the_order_of_recordings_does_not_change_the_file(file: MotionFile) -> None:
    pairs = [drive(seed, noise=1.0 + seed % 3) for seed in reversed(range(6))]
    again = conformalize(Here(pairs), "test", HORIZONS, WINDOWS)
    assert encode_motion_file(again) == encode_motion_file(file)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("schema_version", 2, "schema_version: expected 1, found 2"),
        ("kind", "bundle", "kind"),
        ("extra", 1, "extra"),
        ("groups", 0, "groups"),
        ("horizons", [], "horizons: expected each once"),
    ],
)
def test_a_changed_file_is_refused(file: MotionFile, key: str, value: object, message: str) -> None:
    document = msgspec.to_builtins(file) | {key: value}
    with pytest.raises(CalibrationFileError, match=r"motion\.json: .*"):
        decode_motion_file(json.dumps(document).encode())
    # The same with a digest that fits.
    document["digest"] = "0" * 64
    plain = json.dumps(document).encode()
    signed = plain.replace(b"0" * 64, sha256(plain).hexdigest().encode(), 1)
    with pytest.raises(CalibrationFileError, match=message):
        decode_motion_file(signed)


def thresholds_changed(file: MotionFile, change: Callable[[Any, int, float], Any]) -> MotionFile:
    """The file with other thresholds: ``change`` is given the entry, the column and the number."""

    def entries(of: Any) -> Any:
        return tuple(
            msgspec.structs.replace(
                each, q=tuple(q and change(each, i, q) for i, q in enumerate(each.q))
            )
            for each in of.thresholds
        )

    return msgspec.structs.replace(
        file,
        horizons=tuple(
            msgspec.structs.replace(each, thresholds=entries(each)) for each in file.horizons
        ),
    )


def counted(file: MotionFile, recordings: int) -> MotionFile:
    horizons = tuple(msgspec.structs.replace(each, recordings=recordings) for each in file.horizons)
    return msgspec.structs.replace(file, horizons=horizons, groups=max(recordings, file.groups))


MOTION_LIES = {
    "zero widths": (lambda f: thresholds_changed(f, lambda *_: 0.0), "> 0.0"),
    "no widths": (
        lambda f: thresholds_changed(f, lambda *_: None),
        "expected a number for mean at 0.5 from 6 drives, found None at [0]",
    ),
    "one unbounded number": (
        lambda f: thresholds_changed(
            f, lambda e, i, q: None if (e.rule, e.confidence, i) == ("tolerance", 0.99, 6) else q
        ),
        "expected a number for tolerance at 0.99 from 6 drives, found None at [6]",
    ),
    "more drives": (lambda f: counted(f, 60), "expected a number for capped at 0.95 from 60"),
    "fewer drives": (lambda f: counted(f, 3), "expected null for capped at 0.9 from 3 drives"),
    "more drives than there are": (
        lambda f: msgspec.structs.replace(f, groups=5),
        "expected at most 5 drives, each with motions, found 6 with ",
    ),
    "confidences swapped": (
        lambda f: thresholds_changed(f, lambda e, i, q: q / e.confidence**9),
        "that do not fall from",
    ),
    "rules swapped": (
        lambda f: thresholds_changed(f, lambda e, i, q: q * (0.1 if e.rule == "capped" else 1.0)),
        "expected capped to be at least mean at 0.5",
    ),
    "all six narrower than one": (
        lambda f: thresholds_changed(f, lambda e, i, q: q * (0.1 if i == 8 else 1.0)),
        "expected joint thresholds of at least those of ",
    ),
}


@pytest.mark.parametrize("lie", MOTION_LIES)
def test_numbers_that_contradict_each_other_are_refused(file: MotionFile, lie: str) -> None:
    tell, words = MOTION_LIES[lie]
    with pytest.raises(CalibrationFileError) as caught:
        encode_motion_file(tell(file))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_horizon_has_one_name(file: MotionFile) -> None:
    twice = msgspec.structs.replace(file.horizons[0], horizon=f"0{file.horizons[0].horizon}")
    with pytest.raises(CalibrationFileError, match=r"expected e\.g\. 1f"):
        encode_motion_file(msgspec.structs.replace(file, horizons=(twice, *file.horizons)))


def test_a_drive_without_a_whole_second_does_not_spoil_others() -> None:
    pairs = [drive(seed, 100) for seed in range(3)]
    gaps = 10**10 * (np.arange(101) // 10)
    short = [
        replace(
            pair,
            stamps_ns=pair.stamps_ns + gaps,
            track=Track(pair.track.stamps_ns + gaps, pair.track.poses),
        )
        for pair in pairs
    ]
    file = conformalize(Here([*pairs, short[0]]), "test", [Horizon.parse("1f")], [])
    assert np.isfinite(file.familiar.mean).all()
    with pytest.raises(SourceError, match="expected a drive with a second of poses"):
        conformalize(Here(short), "test", [Horizon.parse("1f")], [])


def test_every_changed_byte_is_noticed(file: MotionFile) -> None:
    content = encode_motion_file(file)
    for place in range(0, len(content), 997):
        altered = bytearray(content)
        altered[place] ^= 1
        with pytest.raises(CalibrationFileError):
            decode_motion_file(bytes(altered))


@pytest.mark.parametrize("covariance", [None, *get_args(MotionCovariance)])
def test_a_stream_gives_the_records_of_a_file(
    calibration: MotionCalibration, covariance: MotionCovariance | None
) -> None:
    """To the last bit."""
    pair = drive(1, 150)
    poses, stamps = pair.estimate.copy(), pair.stamps_ns.copy()
    poses[40] = np.nan
    poses[80:, :3] += 50.0
    stamps[110:] += 10**9
    turn = geometry.quaternion_exp(np.array([0.0, 0.0, 2.0]))
    poses[130:, 3:] = geometry.quaternion_multiply(poses[130:, 3:], turn)
    level = calibration.level()
    whole = list(annotate(calibration, level, stamps, poses, {}, covariance=covariance))
    tracker = MotionTracker(calibration, covariance=covariance)
    for stamp, pose, expected in zip(stamps.tolist(), poses, whole, strict=True):
        assert tracker.step(stamp, pose) == expected
    assert [(record.seq, *record.reasons) for record in whole if record.reasons] == [
        (0, MotionReason.TRAJECTORY_STARTED),
        (40, MotionReason.POSE_MISSING),
        (41, MotionReason.GAP),
        (80, MotionReason.JUMP),
        (110, MotionReason.GAP),
        (130, MotionReason.JUMP),
    ]
    assert {record.status for record in whole if not record.reasons} == {Status.OK}
    for seq in (0, 40, 41, 80, 110, 130):
        assert whole[seq].status != Status.OK
        assert not any(each.bounded for each in whole[seq].motion)


def test_a_stream_forgets_what_no_horizon_needs(
    calibration: MotionCalibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = drive(1, 400)
    whole = annotate(calibration, calibration.level(), pair.stamps_ns, pair.estimate, {})
    monkeypatch.setattr("cvo_edge.motion.kept.KEPT", 150)
    tracker = MotionTracker(calibration)
    for stamp, pose, expected in zip(pair.stamps_ns.tolist(), pair.estimate, whole, strict=True):
        assert tracker.step(stamp, pose).motion == expected.motion
    with pytest.raises(UsageError, match=r"^stamp: expected that of a pose"):
        tracker.anchor(int(pair.stamps_ns[100]))


def test_a_stamp_that_goes_back_changes_nothing(calibration: MotionCalibration) -> None:
    pair = drive(21, 60)
    plain, disturbed = MotionTracker(calibration), MotionTracker(calibration)
    for place, (stamp, pose) in enumerate(zip(pair.stamps_ns.tolist(), pair.estimate, strict=True)):
        expected = plain.step(stamp, pose)
        found = disturbed.step(stamp, pose)
        assert found.motion[0].lower == expected.motion[0].lower
        if place % 10 == 5:
            late = disturbed.step(stamp, pair.estimate[0])
            assert late.status == Status.INVALID
            assert late.reasons == (MotionReason.STAMP_NOT_LATER,)


def test_a_faster_robot_is_not_like_those_of_the_calibration(
    calibration: MotionCalibration,
) -> None:
    pair = drive(1, 300)
    faster = pair.estimate.copy()
    faster[:, :3] *= 3.0
    limits = calibration.limits
    # Below the limits that would make it jump.
    assert np.linalg.norm(np.diff(faster[:, :3], axis=0), axis=1).max() < limits.speed * 0.05
    level = calibration.level()
    plain, fast = (
        list(annotate(calibration, level, pair.stamps_ns, poses, {}))
        for poses in (pair.estimate, faster)
    )
    assert not any(MotionReason.MOTION_UNFAMILIAR in record.reasons for record in plain)
    last = fast[-1]
    assert last.novelty is not None
    assert last.novelty > 1.0
    assert (last.status, last.reasons) == (Status.DEGRADED, (MotionReason.MOTION_UNFAMILIAR,))
    assert not any(each.bounded for each in (*last.motion, *last.since_anchor))


@pytest.fixture(scope="module")
def plain() -> MotionCalibration:
    drives = [drive(80 + seed, 300) for seed in range(4)]
    return MotionCalibration(conformalize(Here(drives), "plain", HORIZONS[:2], [], learned=False))


@pytest.mark.parametrize("delay", [0, 40, 150])
def test_late_labels_bring_back_what_is_stated(plain: MotionCalibration, delay: int) -> None:
    """A drive with three times the calibrated errors, whose truth comes late."""
    pair = drive(90, 1200, noise=3.0)
    tracker = MotionTracker(plain, adapt=True)
    inside = []
    for place, (stamp, pose) in enumerate(zip(pair.stamps_ns.tolist(), pair.estimate, strict=True)):
        tracker.step(stamp, pose)
        if (late := place - delay) >= 0:
            update = tracker.observe(int(pair.stamps_ns[late]), pair.track.poses[late])
            if update.covered[0] is not None:
                inside.append(update.covered[0][:6])
    assert np.mean(inside[:5]) < 0.7
    assert abs(np.mean(inside[-500:]) - 0.9) < 0.05
    assert 1.8 < np.mean(update.factor[0]) < 5.0


def test_lone_labels_move_nothing(plain: MotionCalibration) -> None:
    """Over one frame, a truth every fifth pose tells nothing: motions need one at both ends."""
    pair = drive(90, 100, noise=3.0)
    tracker = MotionTracker(plain, adapt=True)
    for place, (stamp, pose) in enumerate(zip(pair.stamps_ns.tolist(), pair.estimate, strict=True)):
        tracker.step(stamp, pose)
        if place % 5 == 0:
            update = tracker.observe(stamp, pair.track.poses[place])
            assert update.covered[0] is None
            # Over a second it does: twenty poses, or at least sixteen at the start.
            assert (update.covered[1] is None) == (place < 16)


def test_truths_without_errors_leave_a_twentieth() -> None:
    """As of a robot that stands; the next error is not missed for long."""
    adaptation = MotionAdaptation(0.1, joint=False)
    for row in range(1100):
        adaptation.update(row, row, 1, np.zeros(8))
    assert np.exp(adaptation.x) == pytest.approx([1 / 20] * 8)


@pytest.mark.parametrize("delay", [0, 10])
def test_a_burst_of_errors_widens_little_and_a_lasting_change_is_followed(delay: int) -> None:
    generator = np.random.default_rng(7)
    scores = np.abs(generator.normal(size=(4000, 8))) / 1.645
    scores[500:600] *= 1000.0
    scores[1000:] *= 6.0
    adaptation = MotionAdaptation(0.1, joint=False)
    factors = []
    for row in range(len(scores)):
        factors.append(np.exp(adaptation.x))
        if row >= delay:
            adaptation.update(row - delay, row, 1, scores[row - delay])
    assert np.max(factors[:700]) < 2.5 * 1.6
    assert abs(np.mean(scores[-1000:] <= factors[-1000:]) - 0.9) < 0.03


def test_labels_need_a_tracker_that_adapts(calibration: MotionCalibration) -> None:
    pair = drive(1, 30)
    tracker = MotionTracker(calibration)
    tracker.step(0, pair.estimate[0])
    with pytest.raises(UsageError, match="adapt=True"):
        tracker.observe(0, pair.estimate[0])
    adapting = MotionTracker(calibration, adapt=True)
    adapting.step(0, pair.estimate[0])
    with pytest.raises(UsageError, match=r"^stamp: expected that of a pose"):
        adapting.observe(1, pair.estimate[0])


def test_a_tube_starts_at_its_anchor(calibration: MotionCalibration) -> None:
    pair = drive(24, 300)
    level = calibration.level()
    anchor_ns = int(pair.stamps_ns[150])
    records = list(annotate(calibration, level, pair.stamps_ns, pair.estimate, {}, [anchor_ns]))
    tracker = MotionTracker(calibration)
    for place, record in enumerate(records):
        if place == 151:
            tracker.anchor(anchor_ns)
        found = tracker.step(int(pair.stamps_ns[place]), pair.estimate[place])
        if place != 150:  # in the stream, this pose became the anchor later
            assert found == record
    tube = [record.since_anchor[0] for record in records]
    assert [each.anchor_seq for each in tube] == [0] * 150 + [150] * 151
    # Five seconds are a hundred steps; then the tube ends until the next anchor.
    assert [each.bounded for each in tube] == [True] * 101 + [False] * 49 + [True] * 101 + [
        False
    ] * 50
    radii = [each.position for each in tube[:101]]
    assert radii == sorted(radii)
    for each in tube:
        assert (each.upper is None) == (each.lower is None) == (not each.bounded)
        assert each.upper is None or each.lower == tuple(-value for value in each.upper)
    with pytest.raises(UsageError, match=r"^stamp: expected"):
        tracker.anchor(anchor_ns + 1)


def test_another_rate_ends_horizons_in_frames(calibration: MotionCalibration) -> None:
    """As long as it lasts; a single frame that was dropped does not."""
    pair = drive(22, 200)
    used = np.delete(np.arange(201), [20, *range(61, 141, 2)])
    stamps, poses = pair.stamps_ns[used], pair.estimate[used]
    records = list(annotate(calibration, calibration.level(), stamps, poses, {}))
    differs = [MotionReason.RATE_DIFFERS in record.reasons for record in records]
    assert [stamps[k] // PERIOD_NS for k in np.flatnonzero(np.diff(differs))] == [74, 147]
    for record, other in zip(records[101:], differs[101:], strict=True):
        assert [each.bounded for each in record.motion] == [not other, True, True]
    tracker = MotionTracker(calibration)
    assert [tracker.step(*each) for each in zip(stamps.tolist(), poses, strict=True)] == records
    *_, record = annotate(
        calibration, calibration.level(), pair.stamps_ns[:3], pair.estimate[[0, 2, 4]], {}
    )
    assert not record.reasons


@pytest.mark.parametrize("kind", ["faster", "slower rate"])
def test_an_audit_counts_what_is_stated(calibration: MotionCalibration, kind: str) -> None:
    pair = drive(1, 400)
    if kind == "faster":
        # From the middle on; the truth drives the same.
        for poses in (pair.estimate, pair.track.poses):
            poses[200:, :3] = poses[200, :3] + 3.0 * (poses[200:, :3] - poses[200, :3])
    else:
        every = slice(None, None, 2)
        pair = replace(pair, stamps_ns=pair.stamps_ns[every], estimate=pair.estimate[every])
    level = calibration.level()
    records = list(
        annotate(calibration, level, pair.stamps_ns, pair.estimate, {}, covariance="integrated")
    )
    (found,) = audit(calibration, level, [pair]).recordings
    for place, each in enumerate(found.horizons):
        assert each.motions == sum(record.motion[place].bounded for record in records)
    unfamiliar = [MotionReason.MOTION_UNFAMILIAR in record.reasons for record in records]
    rate = [MotionReason.RATE_DIFFERS in record.reasons for record in records]
    assert (found.withheld, found.other_rate) == pytest.approx((np.mean(unfamiliar), np.mean(rate)))
    assert max(found.withheld, found.other_rate) > 0.1
    # Sums over 10 s need a covariance at each of 200 steps.
    sums = [each.sums for each in found.integrated]
    assert sums[-1:] == ([unfamiliar.index(True) - 200] if kind == "faster" else [])
    assert bool(sums) == any(record.covariance for record in records)


def test_wrong_poses_are_refused(calibration: MotionCalibration) -> None:
    tracker = MotionTracker(calibration)
    wrong = ([0.0] * 6, "pose", {}, [True] * 7, [1j] * 7, [[0.0] * 7])
    for pose in wrong:
        with pytest.raises(UsageError, match=r"^pose: expected 7 numbers"):
            tracker.step(0, pose)
    for stamp in (0.5, None, True, 2**63, "5", float("nan")):
        with pytest.raises(UsageError, match=r"^stamp: expected"):
            tracker.step(stamp, None)
    # What an estimator that is lost may send, and no number of it was used up above.
    for seq, lost in enumerate(
        (None, [0.0] * 7, [np.nan] * 7, [1e200] * 3 + [0, 0, 0, 1], [0, 0, 0, 0, 0, 0, 3])
    ):
        record = tracker.step(seq + 1, lost)
        assert (record.seq, record.status) == (seq, Status.INVALID)
        assert record.reasons == (MotionReason.POSE_MISSING,)
    for level in ({"confidence": 0.7}, {"rule": "best"}, {"scope": "all"}, {"covariance": "full"}):
        with pytest.raises(UsageError, match=r": expected "):
            MotionTracker(calibration, **level)
    assert MotionTracker(calibration, np.float32(0.9)).level == calibration.level(0.9)


def test_a_clock_that_is_set_back_begins_anew(calibration: MotionCalibration) -> None:
    pair = drive(1, 60)
    tracker = MotionTracker(calibration)
    tracker.step(9 * 10**18, pair.estimate[0])
    records = [
        tracker.step(int(stamp), pose)
        for stamp, pose in zip(pair.stamps_ns, pair.estimate, strict=True)
    ]
    assert records[0].reasons == (MotionReason.TRAJECTORY_STARTED,)
    assert all(record.motion[0].bounded for record in records[1:])


def test_a_planar_robot_that_stands_at_times_is_calibrated() -> None:
    pairs = []
    for seed in range(3):
        pair = drive(200 + seed, 300)
        for poses in (pair.estimate, pair.track.poses):
            poses[:, 2] = poses[:, 3] = poses[:, 4] = 0.0
            poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
            poses[100:120] = poses[100]
        pairs.append(pair)
    file = conformalize(Here(pairs), "wheels", HORIZONS, WINDOWS)
    assert decode_motion_file(encode_motion_file(file)).horizons[0].horizon == "1f"
    report = audit(MotionCalibration(file), MotionCalibration(file).level(), pairs)
    assert report.calibrated_on == tuple(pair.name for pair in pairs)
    assert all(np.isfinite(each.nees) for one in report.recordings for each in one.horizons)


def test_an_estimator_that_turns_evenly_and_without_errors_is_calibrated() -> None:
    """Numbers that vary by rounding alone are no reason for a bias, a scale or a doubt."""
    generator, time = np.random.default_rng(1), 0.1 * np.arange(200.0)
    pairs = []
    for number in range(2):
        turn = np.stack([np.sin(0.1 * time), np.cos(0.1 * time)], axis=1)
        true = np.stack([time, 0.1 * number * time, 0.0 * time], axis=1)
        true = np.concatenate([true + np.sin(time)[:, np.newaxis], 0.0 * turn, turn], axis=1)
        estimate = true + np.pad(0.01 * generator.normal(size=(200, 3)), ((0, 0), (0, 4)))
        stamps = np.round(1e9 * time).astype(np.int64)
        name = f"even-{number}"
        pairs.append(Pair(name, name, stamps, estimate, {}, Track(stamps, true)))
    file = conformalize(Here(pairs), "even", HORIZONS, [])
    calibration = MotionCalibration(decode_motion_file(encode_motion_file(file)))
    given = pairs[0].stamps_ns, pairs[0].estimate, {}
    records = list(annotate(calibration, calibration.level(), *given, covariance="integrated"))
    assert all(record.status == "ok" and record.covariance for record in records[1:])


def test_a_column_that_is_no_number_is_a_pose_that_is_missing(tmp_path: Path) -> None:
    pairs = [drive(210 + seed, 200) for seed in range(3)]
    for pair in pairs:
        pair.columns["inliers"] = np.random.default_rng(0).uniform(20.0, 80.0, 201)
    calibration = MotionCalibration(
        conformalize(Here(pairs), "test", HORIZONS[:2], [], columns=["inliers"])
    )
    values = pairs[0].columns["inliers"].copy()
    values[[50, 90]] = np.nan, np.inf
    level = calibration.level()
    given = pairs[0].stamps_ns, pairs[0].estimate, {"inliers": values}
    records = list(annotate(calibration, level, *given))
    lost = [record.seq for record in records if MotionReason.POSE_MISSING in record.reasons]
    assert lost == [50, 90]
    tracker = MotionTracker(calibration)
    stamps, poses = pairs[0].stamps_ns.tolist(), pairs[0].estimate
    for record, stamp, pose, value in zip(records, stamps, poses, values.tolist(), strict=True):
        assert tracker.step(stamp, pose, {"inliers": value}) == record
    assert records[-1].motion[1].bounded
    tracker = MotionTracker(calibration)
    for columns in (None, {}, {"inliers": "many"}, 5):
        with pytest.raises(UsageError, match=r"^columns: expected numbers for inliers"):
            tracker.step(0, pairs[0].estimate[0], columns)
    assert tracker.step(1, None).status == Status.INVALID
    # A comment before the first row names columns, in a file as in a pipe.
    motion, estimate = tmp_path / "motion.json", tmp_path / "a.tum"
    motion.write_bytes(encode_motion_file(calibration.file))
    table = np.column_stack([1e-9 * pairs[0].stamps_ns, pairs[0].estimate, values])
    np.savetxt(estimate, table, fmt="%.9f", header="timestamp tx ty tz qx qy qz qw inliers")
    whole, piped = tmp_path / "a.jsonl", tmp_path / "b.jsonl"
    assert run("annotate", estimate, motion, "-o", whole)[0] == 0
    words = ["annotate", "-", str(motion), "-o", str(piped)]
    for mark in ("", "\ufeff"):
        assert CliRunner().invoke(app, words, input=mark + estimate.read_text()).exit_code == 0
    assert piped.read_bytes() == whole.read_bytes()
    refused = CliRunner().invoke(app, words, input=estimate.read_text().partition("\n")[2])
    assert "found no column inliers" in str(refused.exception)


def test_intervals_hold_what_they_state() -> None:
    """New drives, whose noise differs from drive to drive as that of the calibration."""
    noise = np.random.default_rng(0).uniform(0.5, 2.0, 36)
    drives = [drive(100 + index, 200, each) for index, each in enumerate(noise)]
    calibration = MotionCalibration(
        conformalize(Here(drives[:18]), "test", HORIZONS[:2], [Horizon.parse("2s")])
    )
    shares, tubes = {}, {}
    for rule in MOTION_RULES:
        report = audit(calibration, calibration.level(0.9, rule), drives[18:])
        shares[rule] = np.mean([x.position for each in report.recordings for x in each.horizons])
        whole = [(x.position, x.six) for each in report.recordings for x in each.windows]
        tubes[rule] = np.mean(whole, axis=0)
    assert 0.85 <= shares["mean"] <= 0.95
    assert all(0.8 <= share <= 0.97 for share in tubes["mean"])
    assert (tubes["hierarchical"] >= tubes["mean"]).all()
    assert shares["hierarchical"] >= shares["capped"] >= shares["mean"]
    assert shares["tolerance"] >= 0.93


def test_formats_are_told_by_their_lines(tmp_path: Path) -> None:
    pair = drive(23, 30)
    table = np.column_stack([1e-9 * pair.stamps_ns, pair.estimate])
    np.savetxt(tmp_path / "a.tum", table, fmt="%.9f")
    variances = np.tile([4.0, 0, 0, 4, 0, 1, 9, 0, 0, 0, 0, 0], (31, 1))
    np.savetxt(tmp_path / "b.txt", np.column_stack([table, variances]), fmt="%.9f")
    names = "timestamp tx ty tz qx qy qz qw inliers"
    np.savetxt(
        tmp_path / "c.txt", np.column_stack([table, np.arange(31)]), fmt="%.9f", header=names
    )
    plain = read_poses(tmp_path / "a.tum")
    assert plain.format == "tum"
    openvins = read_poses(tmp_path / "b.txt")
    assert openvins.format == "openvins"
    assert {name: values[0] for name, values in openvins.columns.items()} == {
        "position_deviation": 3.0,
        "rotation_deviation": 3.0,
    }
    more = read_poses(tmp_path / "c.txt")
    np.testing.assert_array_equal(more.columns["inliers"], np.arange(31))
    for each in (openvins, more):
        np.testing.assert_array_equal(each.poses, plain.poses)
    (tmp_path / "d.txt").write_text("1 2 3\n")
    with pytest.raises(SourceError, match="found 3 columns in line 1"):
        read_poses(tmp_path / "d.txt")
    assert len(OPENVINS_FORM.split()) == 20


def test_from_files_to_intervals_and_an_audit(tmp_path: Path) -> None:
    drives = [drive(30 + seed) for seed in range(4)]
    files = [written(pair, tmp_path) for pair in drives]
    motion = tmp_path / "motion.json"
    given = [path for two in files[:3] for path in two]
    code, text = run("conformalize", *given, "-o", motion, "--horizon", "1f,1s", "--window", "5s")
    assert code == 0, text
    assert "drive-30" in text
    output = tmp_path / "a.jsonl"
    assert run("annotate", files[3][0], motion, "-o", output)[0] == 0
    header, *lines = output.read_bytes().splitlines()
    assert msgspec.json.decode(header, type=MotionHeader).horizons == ("1f", "1s")
    records = [msgspec.json.decode(line, type=MotionRecord) for line in lines]
    assert len(records) == 401
    assert [each.bounded for each in records[-1].motion] == [True, True]
    assert run("audit", *files[3], motion, "--min-coverage", 0.5)[0] == 0
    assert run("audit", *files[3], motion, "--min-coverage", 1)[0] == 8


def test_every_format_has_every_pose(tmp_path: Path, file: MotionFile) -> None:
    motion, pair = tmp_path / "motion.json", drive(1, 60)
    motion.write_bytes(encode_motion_file(file))
    estimate, _ = written(pair, tmp_path)
    rows = tmp_path / "a.csv"
    assert run("annotate", estimate, motion, "-o", rows)[0] == 0
    lines = [line for line in rows.read_text().splitlines() if not line.startswith("#")]
    assert len(lines) == 1 + 61 * len(HORIZONS)
    assert {len(line.split(",")) for line in lines} == {len(lines[0].split(","))}
    poses = tmp_path / "a.tum"
    assert run("annotate", estimate, motion, "-o", poses)[0] == 0
    np.testing.assert_allclose(read_poses(poses).poses, read_poses(estimate).poses, atol=1e-8)
    whole, piped = tmp_path / "a.jsonl", tmp_path / "b.jsonl"
    assert run("annotate", estimate, motion, "-o", whole, "--covariance", "integrated")[0] == 0
    words = ["annotate", "-", str(motion), "-o", str(piped), "--covariance", "integrated"]
    done = CliRunner().invoke(app, words, input=estimate.read_text())
    assert done.exit_code == 0, done.output
    assert piped.read_bytes() == whole.read_bytes()
    # And in Python, with quaternions of any norm near one.
    tracker = MotionTracker(MotionCalibration(file), covariance="integrated")
    numbers = np.loadtxt(estimate)
    stamps = read_poses(estimate).stamped().stamps_ns.tolist()
    records = [tracker.step(*each) for each in zip(stamps, numbers[:, 1:], strict=True)]
    assert [msgspec.json.encode(each) for each in records] == whole.read_bytes().splitlines()[1:]
    last = whole.read_bytes().splitlines()[-1]
    assert msgspec.json.decode(last, type=MotionRecord).covariance


def test_a_picture_shows_path_errors_and_coverage(tmp_path: Path, file: MotionFile) -> None:
    pytest.importorskip("matplotlib")
    motion, pair = tmp_path / "motion.json", drive(1, 200)
    motion.write_bytes(encode_motion_file(file))
    estimate, truth = written(pair, tmp_path)
    picture = tmp_path / "a.png"
    assert run("audit", estimate, truth, motion, "--picture", picture)[0] == 0
    image = cv2.imread(str(picture))
    assert image is not None
    # Not one colour: something was drawn in each of the three panels.
    assert all(panel.std() > 5.0 for panel in np.array_split(image, 3, axis=1))


def test_the_schema_accepts_the_file_and_nothing_else(file: MotionFile) -> None:
    code, text = run("schema", "motion")
    assert code == 0
    document = json.loads(encode_motion_file(file))
    properties = json.loads(text)["$defs"]["MotionFile"]
    assert set(properties["properties"]) == set(document)
    assert properties["additionalProperties"] is False


def test_bad_input_is_one_line_with_its_code(tmp_path: Path, file: MotionFile) -> None:
    motion = tmp_path / "motion.json"
    motion.write_bytes(encode_motion_file(file))
    one, other = (written(drive(seed), tmp_path) for seed in (40, 41))
    apart = np.loadtxt(one[1])
    apart[:, 0] += 1000.0
    np.savetxt(tmp_path / "apart.tum", apart, fmt="%.9f")
    moved = np.loadtxt(one[1])
    moved[:, 1] += 7.0
    np.savetxt(tmp_path / "moved.tum", moved, fmt="%.9f")
    large = np.loadtxt(one[0])
    large[:, 1:4] *= 1000.0
    np.savetxt(tmp_path / "mm.tum", large, fmt="%.9f")
    (tmp_path / "at.txt").write_text("# s\n5.001\n")
    (tmp_path / "no.txt").write_text("# nothing yet\n")
    (tmp_path / "corrupt.json").write_bytes(motion.read_bytes()[:-40])
    output = ["-o", tmp_path / "out.json"]
    cases = [
        (["conformalize", *one, *output], 2, "at least two drives, found 1"),
        (["conformalize", one[0], *output], 2, "expected pairs EST GT, found 1"),
        (["conformalize", *output], 2, "expected EST GT"),
        (["conformalize", one[0], tmp_path / "apart.tum", *other, *output], 6, "found 0 of 401"),
        (["conformalize", tmp_path / "mm.tum", one[1], *other, *output], 6, "expected metres"),
        (["conformalize", *one, *other, *output, "--horizon", "9m,1000m"], 2, "horizon 1000m"),
        (["conformalize", *one, *other, *output, "--horizon", "7x"], 2, "horizon: expected"),
        (["conformalize", *one, *other, *output, "--window", "1000s"], 2, "window 1000s"),
        (["conformalize", *one, *other, *output, "--scale", "inliers"], 2, "column inliers"),
        (["conformalize", *one, *other, "-o", one[0]], 2, "among the inputs"),
        (["conformalize", *one, *other, "-o", ""], 2, "--output: expected"),
        (["conformalize", *one, *other, *output, "--name", ""], 2, "--name: expected"),
        (["conformalize", *one, *other, *output, "--scale", "auto,x"], 2, "--scale: expected"),
        (["conformalize", one[0], other[1], *other, *output], 6, "that do not fit"),
        (["conformalize", one[1], one[1], *other, *output], 6, "the same poses in"),
        (["conformalize", one[1], tmp_path / "moved.tum", *other, *output], 6, "the same motions"),
        (["audit", one[1], one[1], motion], 6, "the same poses in"),
        (["audit", *one, motion, "--picture", "a.jpg"], 2, "--picture: expected"),
        (["audit", *one, motion, "--picture", "a.png", "--json", "a.png"], 2, "among the inputs"),
        (["conformalize", "--pairs", tmp_path / "no.txt", *output], 2, "no line in"),
        (["annotate", one[0], motion, "-o", "a.csv", "--covariance", "interval"], 2, "jsonl"),
        (["audit", *one, tmp_path / "corrupt.json"], 3, "corrupt.json"),
        (["audit", *one, tmp_path / "none.json"], 3, "no such file"),
        (["annotate", one[0], motion, "--confidence", "0.7"], 2, "confidence: expected"),
        (["annotate", tmp_path / "none.tum", motion], 6, "none.tum"),
        (["annotate", one[0], motion, "--fps", "10"], 2, "--fps: expected poses without times"),
        (
            ["annotate", one[0], motion, "--anchors", tmp_path / "at.txt"],
            6,
            "found 5.001 in line 2",
        ),
        (["annotate", "-", motion, "--fps", "10"], 2, "--fps: expected poses without times"),
        (["audit", *one, motion, "--times", one[0]], 2, "--times: expected poses without times"),
        (["audit", *one, motion, "--times", one[0], "--fps", "9"], 2, "expected one of them"),
    ]
    for words, code, message in cases:
        found, text = run(*words)
        assert (found, message in text) == (code, True), (words, text)
    assert not (tmp_path / "out.json").exists()
    code, text = run("annotate", tmp_path / "mm.tum", motion, "-o", tmp_path / "mm.jsonl")
    assert (code, "mm.tum: no interval at" in text) == (0, True)
