"""The alarm without labels: what a stream of statistics comes to."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from cvo_edge.bundle.format import AlarmSpec
from cvo_edge.monitor.alarm import Running, StreamAlarm, alarm_statement, false_alarms, rank
from cvo_edge.record import Reason

_FIVE = (1.0,) * 5


@pytest.fixture(scope="module")
def stated(bundle):
    """Return the calibration of a bundle with this alarm."""

    def make(alarm, split=None, crossed=None):
        source = bundle.calibration.calibration
        kind = "random" if alarm is not None and alarm.kind == "frames" else "sequence"
        source = replace(source, split=replace(source.split, kind=split or kind), crossed=crossed)
        return replace(bundle.calibration, alarm=alarm, calibration=source)

    return make


def _spec(kind, n=400, limits=_FIVE):
    return AlarmSpec(kind=kind, usual=(0.0,) * 5, scales=_FIVE, limits=limits, n=n)


def _outputs(*values):
    values = [*values, *[0.0] * (5 - len(values))]
    return {
        "novelty": np.array([values[:4]], np.float32),
        "degradation": np.array([values[4:]], np.float32),
    }


def test_the_running_statistic_is_the_larger_of_two_weighted_means():
    values = np.random.default_rng(0).normal(size=(200, 5))
    running = Running((np.inf,) * 5)
    found = np.array([running.add(row) for row in values.tolist()])
    kept = np.maximum(values, -1.0)
    for t in (0, 1, 10, 199):
        means = []
        for weight in (0.5, 0.1):
            # The first value stands for all before it.
            weights = weight * (1.0 - weight) ** np.arange(t + 1)
            weights[-1] = (1.0 - weight) ** t
            means.append(weights @ kept[t::-1])
        assert found[t] == pytest.approx(np.maximum(0.9 * means[0], means[1]))


@pytest.mark.parametrize("kind", ["frames", "recordings"])
def test_a_bundle_without_limits_cannot_tell(kind, stated):
    assert StreamAlarm(None).judge(_outputs(99.0), 0) is None
    assert StreamAlarm(None).drift.state == "unknown"
    assert StreamAlarm(_spec(kind)).drift.state == "clear"
    assert "drift is unknown" in alarm_statement(stated(None))
    assert false_alarms(stated(None)) is None


@pytest.mark.parametrize("kind", ["frames", "recordings"])
@pytest.mark.parametrize("which", range(5))
def test_a_strange_frame_is_doubted_at_once_for_the_statistic_that_is_beyond(kind, which):
    alarm = StreamAlarm(_spec(kind))
    for seq in range(20):
        assert alarm.judge(_outputs(), seq).doubt is None
    values = [0.0] * 5
    values[which] = 5.0
    expected = Reason.IMAGE_DEGRADED if which == 4 else Reason.IMAGE_UNFAMILIAR
    assert alarm.judge(_outputs(*values), 20).doubt is expected
    assert alarm.drift[:3] == ("alarm", expected, 20)


@pytest.mark.parametrize("kind", ["frames", "recordings"])
@pytest.mark.parametrize("strange", [1, 10, 1000])
def test_an_alarm_ends_within_30_right_frames_however_long_it_was(kind, strange):
    alarm = StreamAlarm(_spec(kind))
    for seq in range(strange):
        alarm.judge(_outputs(1e6), seq)
    doubts = [alarm.judge(_outputs(), strange + k).doubt for k in range(30)]
    assert doubts[-1] is None
    assert alarm.drift.state == "clear"
    if strange == 1 and kind == "frames":
        assert doubts[0] is None


def test_doubt_lasts_over_frames_that_pass_between_strange_ones():
    alarm = StreamAlarm(_spec("frames"))
    found = [alarm.judge(_outputs(0.0 if seq % 3 else 2.0), seq).doubt for seq in range(60)]
    assert all(doubt is Reason.IMAGE_UNFAMILIAR for doubt in found[9:])


@pytest.mark.parametrize("n", [1, 20, 99, 200, 1000])
def test_the_limit_of_single_frames_is_a_conformal_rank(n, stated):
    """Among n + 1 exchangeable frames, each is as likely to be the one beyond the rank."""
    bound = false_alarms(stated(_spec("frames", n)))
    assert bound == pytest.approx((n + 1 - rank(n)) / (n + 1))
    assert bound <= max(0.01, 1.0 / (n + 1)) + 1e-12


def test_recordings_bound_false_alarms_by_their_number(stated):
    """Maxima of G exchangeable recordings as limits of five statistics: at most 5 / (G + 1)."""
    generator = np.random.default_rng(1)
    recordings, trials = 29, 150
    alarms = 0
    for _ in range(trials):
        # Heavy tails, statistics that depend on each other, recordings of different levels.
        level = generator.exponential(size=(recordings + 1, 1, 1))
        frames = level * generator.standard_t(3, size=(recordings + 1, 12, 5))
        limits = [
            np.max([running.add(row) for row in each.tolist()], axis=0)
            for each in frames[1:]
            for running in [Running((np.inf,) * 5)]
        ]
        spec = _spec("recordings", recordings, tuple(np.max(limits, axis=0).tolist()))
        alarm = StreamAlarm(spec)
        alarms += any(alarm.judge(_outputs(*row), k).doubt for k, row in enumerate(frames[0]))
    bound = false_alarms(stated(spec))
    assert bound == pytest.approx(5 / 30)
    assert alarms / trials <= bound + 3.0 * np.sqrt(bound * (1.0 - bound) / trials)
    assert "at most 0.17" in alarm_statement(stated(spec))
    assert "bound no rate" in alarm_statement(stated(_spec("recordings", 4)))


@pytest.mark.parametrize(
    ("kind", "changes", "why"),
    [
        ("frames", {"split": "block"}, "neighbouring frames depend on each other"),
        ("recordings", {"crossed": 6}, "other networks gave the limits"),
    ],
)
def test_without_exchangeable_draws_nothing_is_proven(kind, changes, why, stated):
    calibration = stated(_spec(kind), **changes)
    assert false_alarms(calibration) is None
    assert alarm_statement(calibration) == f"no rate of false alarms is proven: {why}"
