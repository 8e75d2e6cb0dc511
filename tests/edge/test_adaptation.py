"""Thresholds that adapt to labels: the law, its limits, refusals, and the state file."""

import csv
import math
import os
import re
import shutil
from collections import deque
from itertools import islice
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from cvo_edge import Odometer, UsageError, open_source, read_records
from cvo_edge.bundle.format import CONFIDENCES, Threshold
from cvo_edge.engine.observation import Observation
from cvo_edge.errors import BundleMismatchError, CalibrationFileError, CvoError, SinkError
from cvo_edge.ground_truth import open_ground_truth
from cvo_edge.monitor.adaptation import KEPT, Adaptation
from cvo_edge.monitor.state import State, StateFile
from cvo_edge.monitor.steps import error_bound
from cvo_edge.pose import Chart
from cvo_edge.programs.cli import app
from cvo_edge.programs.options import MOST_DELAY

FLOOR = {"half_width_floor": (0.001,) * 6}
LEVELS = dict(zip(CONFIDENCES, (0.4, 0.7, 1.0, 1.3, 2.0), strict=True))
IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])


def entries(scope, q=LEVELS, sides=1):
    return [
        Threshold(
            confidence=level,
            scope=scope,
            q_hat=(value,) * 6,
            q_hat_upper=(value,) * 6 if sides == 2 else None,
        )
        for level, value in q.items()
    ]


@pytest.fixture(scope="module")
def adapting(make_head, bundle):
    """Return an adaptation of a score |y - m| or of a signed one, whose threshold is 1 at 0.9."""

    def make(
        scope="joint", score="residual", sides="symmetric", state=None, q=LEVELS, origin_m=None
    ):
        unbounded = ((None,) * 6,) * (1 if sides == "symmetric" else 2)
        head = make_head("cqr", score, {**FLOOR, "sides": sides}, *unbounded)
        found = entries(scope, q, 1 if sides == "symmetric" else 2)
        start = next(entry for entry in found if entry.confidence == 0.9)
        pose = replace(bundle.calibration.pose, origin_m=origin_m)
        calibration = replace(bundle.calibration, thresholds=tuple(found), pose=pose)
        return Adaptation(head, Chart("tangent_predicted"), calibration, start, state)

    return make


def show(adaptation, seq, *, interval=True):
    """Let a frame pass whose prediction is the origin, with bounds at the origin."""
    zero = np.zeros((1, 6))
    outputs = {"pose": IDENTITY[np.newaxis], "lower": zero, "upper": zero}
    observation = Observation(outputs, IDENTITY, np.zeros(6)) if interval else None
    adaptation.remember(seq, adaptation.level, observation)


def pose_at(tx):
    return np.array([tx, 0.0, 0, 0, 0, 0, 1])


def play(adaptation, scores, every, delay):
    """Play a stream; returns the factor of every frame and whether each label was missed."""
    factors, missed, coming = [], [], deque()
    for seq, score in enumerate(scores):
        factors.append(adaptation.level.factor[0])
        show(adaptation, seq)
        if every(seq):
            coming.append((seq, pose_at(score)))
        while coming and coming[0][0] <= seq - delay:
            missed.append(not adaptation.update(*coming.popleft()).covered[0])
    return np.array(factors), np.array(missed)


def by_the_law(scores, labelled, delay, shift=None):
    """The law in plain numbers: x of every frame, for a threshold of 1 and alpha .1."""
    xs, x, last = [], 0.0, None
    for seq in range(len(scores)):
        xs.append(x)
        if (label := seq - delay) in labelled:
            gap = 1 if last is None else label - last
            eta = min(0.5 if gap > 20 else 0.3, gap / delay if delay else 1.0)
            used = 1.0 + shift * xs[label] if shift else math.exp(xs[label])
            new = x + eta * ((scores[label] > used) - 0.1)
            new = max(min(new, max(x, xs[label] + 1.5)), min(x, xs[label] - 1.5))
            x, last = max(-8.4077552789821, min(8.4077552789821, new)), label
    return xs


@pytest.mark.parametrize("delay", [0, 5, 40])
@pytest.mark.parametrize(("score", "shift"), [("residual", None), ("additive", 2 * (1.3 - 0.4))])
@pytest.mark.parametrize("share", [1.0, 0.3, 0.03])
def test_the_thresholds_follow_the_law(adapting, delay, score, shift, share):
    generator = np.random.default_rng(delay)
    scores = generator.lognormal(np.repeat([0.0, 2.0, -2.0], 60)).tolist()
    labelled = set(np.flatnonzero(generator.random(180) < share).tolist())
    factors, _ = play(adapting(score=score), scores, labelled.__contains__, delay)
    expected = np.exp(by_the_law(scores, labelled, delay, shift))
    np.testing.assert_allclose(factors, expected, rtol=1e-9)
    assert len(set(factors.tolist())) > 3


def test_each_degree_of_freedom_and_each_side_has_its_own(adapting):
    adaptation = adapting("marginal", "additive", "asymmetric")
    show(adaptation, 0)
    update = adaptation.update(0, [-5.0, 5.0, 0, 0, 0, 0, 1])
    assert update.covered == (False, False, True, True, True, True)
    # alpha is .05 a side: below misses raise, all others lower.
    up, down = math.exp(0.3 * 0.95), math.exp(-0.3 * 0.05)
    assert update.factor == pytest.approx((up, *(down,) * 5, down, up, *(down,) * 4))
    entry = adaptation.level.threshold
    assert entry.q_hat[0] == pytest.approx(1.0 + 1.8 * 0.3 * 0.95)
    assert entry.q_hat_upper[1] == entry.q_hat[0]


def test_an_unbounded_threshold_stays_and_alone_is_refused(adapting):
    adaptation = adapting("marginal", "residual", "lower", q={**LEVELS, 0.99: None})
    show(adaptation, 0)
    assert len(adaptation.update(0, pose_at(9)).factor) == 12
    with pytest.raises(UsageError) as caught:
        adapting(q={0.5: 0.4, 0.8: 0.7, 0.9: None})
    assert str(caught.value) == (
        "adapt: expected a finite threshold to start from, found none at 0.9 joint; choose a lower "
        "confidence or calibrate on more data"
    )


@pytest.mark.parametrize("score", ["lac", "aps", "raps"])
@pytest.mark.parametrize("scope", ["marginal", "joint"])
def test_thresholds_of_classes_stay_in_their_range(make_head, bundle, score, scope):
    edges = (tuple(range(-4, 5)),) * 6
    head = make_head("csp", score, {"edges": edges, "penalty": 0.1, "free_ranks": 2})
    q = dict(zip(CONFIDENCES, (0.5, 0.7, 0.8, 0.9, 0.95), strict=True))
    found = entries(scope, q)
    calibration = replace(bundle.calibration, thresholds=tuple(found))
    adaptation = Adaptation(head, Chart("tangent_predicted"), calibration, found[2])
    top = 1.6 if score == "raps" else 1.0
    outputs = {"pose": IDENTITY[None], "probabilities": np.full((1, 6, 8), 0.125, np.float32)}
    for outside in (True, False):
        for seq in range(0, 400, 2):
            observation = Observation(outputs, IDENTITY, np.zeros(6))
            adaptation.remember(seq + outside, adaptation.level, observation)
            adaptation.update(seq + outside, [*(99.0 if outside else -3.9,) * 3, 0, 0, 0, 1])
            used = [q for q in adaptation.level.threshold.q_hat if q is not None]
            assert 0.0 <= min(used) <= max(used) <= top + 1e-3 + 1e-9
        if outside:
            # At the top, sets hold every class.
            assert (
                head.conformal_set(outputs, np.zeros(6), adaptation.level.threshold).width()[0] == 8
            )


@pytest.mark.parametrize("delay", [5, 100, 500])
@pytest.mark.parametrize("gap", [1, 7, 60])
def test_delay_and_gaps_do_not_run_away(adapting, delay, gap):
    generator = np.random.default_rng(gap)
    level = np.repeat([0.0, 2.5, -2.0], 250)
    scores = np.exp(level + 0.3 * generator.standard_normal(750))
    factors, missed = play(adapting(), scores, lambda seq: seq % gap == 0, delay)
    # No more than the largest score, and what is under way: e^1.5.
    assert factors.max() < scores.max() * math.exp(1.5)
    assert factors.min() > scores.min() * math.exp(-1.5)
    eta = min(0.5 if gap > 20 else 0.3, gap / delay if delay else 1.0)
    assert abs(missed.mean() - 0.1) <= error_bound(missed.size, eta, delay / gap)


@pytest.mark.parametrize(("under_way", "first"), [(0.0, 471), (1.0, 481)])
def test_the_bound_is_below_a_tenth_from_the_label_that_the_guarantee_names(under_way, first):
    page = (Path(__file__).resolve().parents[2] / "docs" / "guarantee.md").read_text("utf-8")
    assert error_bound(first, 0.3, under_way) < 0.1 <= error_bound(first - 1, 0.3, under_way)
    assert re.search(rf"from\s{first}", page)


def test_labels_that_come_all_at_once_count_as_one_look(adapting):
    adaptation = adapting()
    for seq in range(KEPT):
        show(adaptation, seq)
    for seq in range(KEPT):
        factor = adaptation.update(seq, pose_at(100.0)).factor
    assert math.exp(1.0) < factor[0] <= math.exp(1.5) + 1e-9


def test_labels_are_poses_of_the_world_where_a_bundle_has_an_origin(adapting):
    adaptation = adapting(origin_m=(5e5, 4e6, 0.0))
    for seq, (x, covered) in enumerate([(5e5 + 0.9, True), (5e5 + 1.1, False)]):
        show(adaptation, seq)
        assert adaptation.update(seq, [x, 4e6, 0, 0, 0, 0, 1]).covered == (covered,)


def test_labels_out_of_order_are_used(adapting):
    adaptation = adapting()
    for seq in range(10):
        show(adaptation, seq)
    for seq in (7, 2, 9, 0):
        assert adaptation.update(seq, pose_at(0.0)).covered == (True,)
    assert adaptation.adapted.labels == 4


@pytest.mark.parametrize(
    ("seq", "pose", "said"),
    [
        (0, 0, "found 0, which is too old; the oldest is 1"),
        (5, 0, "found 5, which was dropped"),
        (7, 0, "found 7, which has a label already"),
        (1026, 0, "found 1026, which is still to come; the newest is 1025"),
        (-1, 0, "found -1, which is too old; the oldest is 1"),
        (1.5, 0, "seq: expected an int, found 1.5"),
        (8, math.nan, "pose: expected 7 finite numbers tx ty tz qx qy qz qw, found "),
    ],
)
def test_a_label_that_cannot_be_used_is_refused_and_changes_nothing(adapting, seq, pose, said):
    adaptation = adapting()
    with pytest.raises(UsageError, match="found 0, before the first frame"):
        adaptation.update(0, pose_at(0.0))
    for number in range(KEPT + 2):
        if number != 5:
            show(adaptation, number)
    adaptation.update(7, pose_at(9.0))
    before = adaptation.level
    with pytest.raises(UsageError) as caught:
        adaptation.update(seq, pose_at(pose))
    message = str(caught.value)
    assert said in message
    assert "\n" not in message
    if "which" in said:
        assert message.startswith(
            "seq: expected one of the last 1024 frames, not yet labelled, found "
        )
    assert adaptation.level is before
    assert adaptation.update(8, pose_at(9.0)).covered == (False,)


def test_a_frame_without_an_interval_changes_nothing(adapting):
    adaptation = adapting()
    show(adaptation, 0, interval=False)
    assert adaptation.update(0, pose_at(99.0)) == (None, (1.0,))
    with pytest.raises(UsageError, match="has a label already"):
        adaptation.update(0, pose_at(99.0))
    assert adaptation.adapted.labels == 0


# -- the state file -------------------------------------------------------------------------------


@pytest.fixture
def path(tmp_path):
    return tmp_path / "state.json"


@pytest.fixture
def state_file(path, bundle):
    return StateFile(path, bundle.calibration, 0.9, "joint")


def test_the_state_survives_and_reset_returns(adapting, path):
    first = adapting(state=path)
    for seq in range(5):
        show(first, seq)
        first.update(seq, pose_at(9.0))
    first.freeze()
    show(first, 9)
    assert first.update(9, pose_at(99.0)).covered == (False,)
    first.close()
    path.with_name("state.json.0badcafe.partial").write_bytes(b"{")
    again = adapting(state=path)
    lock = path.with_name("state.json.lock")
    assert sorted(path.parent.iterdir()) == [path, lock]
    assert again.level.threshold == first.level.threshold
    assert again.adapted == (5, True, first.level.factor)
    show(again, 0)
    assert again.update(0, pose_at(99.0)).factor == first.level.factor
    again.reset()
    show(again, 1)
    assert again.level.threshold == adapting().level.threshold
    again.close()
    assert list(path.parent.iterdir()) == [path]
    last = adapting(state=path)
    assert last.adapted == (0, False, (1.0,))
    show(last, 1)
    assert last.update(1, pose_at(99.0)).factor[0] > 1.0


def test_a_state_serves_one_odometer_at_a_time(adapting, path):
    first = adapting(state=path)
    with pytest.raises(SinkError, match="another odometer adapts with this state"):
        adapting(state=path)
    # The refused one has swept nothing away, and the first one still writes.
    show(first, 0)
    assert first.update(0, pose_at(9.0)).factor[0] > 1.0
    first.close()
    second = adapting(state=path)
    assert second.adapted == first.adapted
    # Another one may have removed the file of the lock and be gone.
    path.with_name("state.json.lock").unlink()
    second.close()
    del second
    assert adapting(state=path).adapted.labels == 1


def test_a_closed_or_forked_odometer_takes_no_labels(adapting, path):
    first = adapting(state=path)
    show(first, 0)
    child = os.fork()
    if child == 0:
        refused = 0
        for call in (lambda: first.update(0, pose_at(9.0)), first.freeze, first.reset):
            try:
                call()
            except UsageError:
                refused += 1
        os._exit(refused)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
    assert first.update(0, pose_at(9.0)).factor[0] > 1.0
    first.close()
    show(first, 1)
    for call in (lambda: first.update(1, pose_at(9.0)), first.freeze, first.reset):
        with pytest.raises(UsageError, match="the odometer is closed"):
            call()


def test_any_state_is_read_as_written(state_file):
    for number in range(0, 50, 5):
        x = (np.random.default_rng(number).normal() * 10.0 ** (number - 47),)
        state = State(x, number, bool(number % 2))
        state_file.write(state)
        assert state_file.read(1) == state


def test_any_damage_is_refused_with_what_to_do(state_file, path):
    state_file.write(State((0.25,), 3))
    whole = path.read_bytes()
    for place in range(0, len(whole), 4):
        for damaged in (whole[:place], whole[:place] + b"1" + whole[place + 1 :]):
            if damaged == whole:
                continue
            path.write_bytes(damaged)
            with pytest.raises(CalibrationFileError) as caught:
                state_file.read(1)
            assert str(caught.value).startswith(
                f"{path}: expected the state of an adaptation, found a damaged file: "
            )
            assert str(caught.value).endswith(
                "; restore a copy, or delete it to start from the calibrated thresholds"
            )
            assert path.read_bytes() == damaged


@pytest.mark.parametrize(
    ("changes", "confidence", "scope", "said"),
    [
        (
            {"digest": "0" * 64, "name": "other"},
            0.9,
            "joint",
            "bundle other (000000000000), found that of synthetic-room-cjp (",
        ),
        ({}, 0.8, "joint", "0.8 joint, found that of 0.9 joint; give another file"),
        ({}, 0.9, "marginal", "0.9 marginal, found that of 0.9 joint; give another file"),
    ],
)
def test_a_state_of_something_else_is_refused(
    state_file, path, bundle, changes, confidence, scope, said
):
    state_file.write(State((0.25,), 3))
    content = path.read_bytes()
    calibration = replace(bundle.calibration, **changes)
    with pytest.raises(
        BundleMismatchError, match=re.escape(f"{path}: expected the state of {said}")
    ):
        StateFile(path, calibration, confidence, scope).read(1)
    assert path.read_bytes() == content


def test_a_label_that_cannot_be_written_can_be_given_again(adapting, tmp_path, bundle):
    folder = tmp_path / "folder"
    state = folder / "state.json"
    with pytest.raises(SinkError):
        adapting(state=state)
    folder.mkdir()
    adaptation = adapting(state=state)
    show(adaptation, 0)
    before = adaptation.level
    shutil.rmtree(folder)
    with pytest.raises(SinkError, match="cannot be written"):
        adaptation.update(0, pose_at(9.0))
    assert adaptation.level is before
    folder.mkdir()
    assert adaptation.update(0, pose_at(9.0)).factor[0] > 1.0
    adaptation.close()
    assert StateFile(state, bundle.calibration, 0.9, "joint").read(1).labels == 1


# -- the odometer and the command -----------------------------------------------------------------


def test_an_odometer_adapts_on_request_only(bundle_dir, clip_dir, path):
    frames = [frame for frame, _ in zip(open_source(str(clip_dir)), range(4), strict=False)]
    with Odometer.load(bundle_dir, scope="joint") as plain:
        expected = [plain.step(frame.image) for frame in frames[:2]]
        with pytest.raises(UsageError) as caught:
            plain.update(0, expected[0].pose)
    assert str(caught.value) == (
        "labels: expected an odometer that adapts; load it with adapt=True or state=FILE"
    )
    with Odometer.load(bundle_dir, scope="joint", state=path) as odometer:
        first = odometer.step(frames[0].image)
        assert "factor" not in expected[0].to_dict()
        assert first.to_dict()["factor"] == [1.0]
        np.testing.assert_array_equal(first.upper, expected[0].upper)
        far = first.pose.to_array() + np.eye(7)[0] * 5.0
        update = odometer.update(0, far)
        assert update == ((False,), pytest.approx((math.exp(0.27),)))
        # Its point is inside, and the same width serves the next frame.
        second = odometer.step(frames[1].image)
        width, calibrated = second.upper - second.lower, expected[1].upper - expected[1].lower
        np.testing.assert_allclose(width, math.exp(0.27) * calibrated)
        assert odometer.update(1, second.pose).covered == (True,)
        black = odometer.step(np.zeros((48, 64, 3), np.uint8))
        assert odometer.update(black.seq, far).covered is None
    with Odometer.load(bundle_dir, scope="joint", state=path) as odometer:
        assert odometer.step(frames[2].image).factor == pytest.approx((math.exp(0.24),))
    with pytest.raises(BundleMismatchError):
        Odometer.load(bundle_dir, state=path)


@pytest.mark.parametrize("method", ["csp", "mcqr"])
def test_covered_is_what_the_interval_of_the_frame_says(artifacts_dir, clip_dir, method):
    truth = open_ground_truth(clip_dir)
    folder = artifacts_dir / f"synthetic-room-{method}"
    with Odometer.load(folder, scope="joint", adapt=True) as odometer:
        for estimate in odometer.stream(islice(open_source(str(clip_dir)), 4)):
            assert estimate.factor is not None
            pose = truth.pose_of(estimate) if estimate.source else None
            if pose is not None:
                assert odometer.update(estimate.seq, pose).covered == (estimate.contains(pose),)


def test_the_command_gives_labels_late_and_keeps_the_state(
    bundle_dir, clip_dir, tmp_path, path, capsys
):
    def run(*more):
        out = tmp_path / "records.jsonl"
        words = ["run", bundle_dir, clip_dir, "-o", out, "--max-frames", 6, "--state", path, *more]
        app([str(word) for word in words], standalone_mode=False)
        lines = map(msgspec.json.decode, out.read_bytes().splitlines()[1:])
        return [line["factor"] for line in lines], capsys.readouterr().err

    factors, said = run("--labels", clip_dir, "--label-delay", 4)
    assert factors[:5] == [[1.0] * 6] * 5
    assert factors[5] != factors[4]
    assert re.search(r"^labels      2 used, [0-2] outside, 4 too late$", said, re.MULTILINE)
    assert "thresholds  adapted to 2 labels: " in said
    again, said = run()
    assert again == [again[0]] * 6 != [[1.0] * 6] * 6
    assert "labels      " not in said
    assert "thresholds  adapted to 2 labels: " in said
    records = list(read_records(tmp_path / "records.jsonl"))
    assert [list(record.factor) for record in records] == again
    run("--format", "csv", "-o", tmp_path / "records.csv")
    lines = (tmp_path / "records.csv").read_text().splitlines()
    header, *rows = csv.reader(line for line in lines if not line.startswith("#"))
    assert header[-1] == "factor"
    assert [[*map(float, row[-1].split())] for row in rows] == again
    path.write_bytes(b"{}")
    with pytest.raises(CvoError, match="found a damaged file"):
        run()
    with pytest.raises(UsageError, match="--label-delay: expected --labels FILE with it"):
        run("--label-delay", 4)
    assert MOST_DELAY == KEPT - 1
