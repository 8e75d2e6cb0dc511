"""Bounds on the age of a frame: cameras with queues, on simulated time."""

import itertools
from collections import deque

import numpy as np
import pytest

from cvo_edge.input.capture import _Opened
from cvo_edge.input.queue_lag import DriverStamps, LagAccount

STALE_S = 1.0
# Tolerated excess of a frame's age over its bound.
TOLERANCE_S = 0.1
# Flagging a frame younger than this is a false alarm.
FRESH_S = 0.3


class SimulatedCamera:
    """A camera, its queue and a reader on simulated time; frames carry no stamps.

    Frames are ``period_s`` times a choice of ``jitter`` apart. A full queue of ``room`` frames
    drops new frames. Decoding takes ``decoding`` periods of the reader's own time, or of other
    threads' time if ``decodes_elsewhere``. ``pauses`` maps frame numbers to seconds without a read
    after that frame. ``stall(generator)`` draws the seconds for which the reader is not scheduled
    at each of five points of a read, during ``starved`` (begin, end); the kernel reports them
    unless ``hidden``.
    """

    def __init__(
        self,
        period_s,
        jitter,
        decoding,
        room,
        *,
        seed=0,
        pauses=None,
        starved=(0.0, 0.0),
        stall=None,
        hidden=False,
        decodes_elsewhere=False,
        count=700,
    ):
        self.generator = np.random.default_rng(seed)
        self.made = np.cumsum(period_s * self.generator.choice(jitter, count)).tolist()
        costs = decoding * period_s * self.generator.choice([1.0, 1.0, 1.0, 1.5], count)
        self.costs = costs.tolist()
        self.room, self.pauses, self.starved = room, pauses or {}, starved
        self.stall, self.hidden, self.decodes_elsewhere = stall, hidden, decodes_elsewhere
        self.account = LagAccount(0.0, 1.0 / period_s)
        self.now = self.busy = 0.0

    def _pass(self):
        """Stall the reader if it is starved."""
        if self.stall is not None and self.starved[0] <= self.now < self.starved[1]:
            stalled = self.stall(self.generator)
            self.now += stalled
            if not self.hidden:
                self.busy += stalled

    def frames(self):
        """Yield (age when used, bound when used, time) of each frame, in order."""
        queue, coming, number = deque(), 0, 0
        while True:
            self._pass()
            busy, begin = self.busy, self.now
            self._pass()
            while True:
                while coming < len(self.made) and self.made[coming] <= self.now:
                    if len(queue) < self.room:
                        queue.append(self.made[coming])
                    coming += 1
                if queue:
                    break
                if coming == len(self.made):
                    return
                self.now = self.made[coming]
            made = queue.popleft()
            self._pass()
            self.now += self.costs[number]
            if not self.decodes_elsewhere:
                self.busy += self.costs[number]
            self._pass()
            read_at = self.now
            slept = read_at - begin - (self.busy - busy)
            queued_s = self.account.queued_s(read_at, slept)
            self._pass()
            yield self.now - made, queued_s + self.now - read_at, self.now
            number += 1
            self.now += self.pauses.get(number, 0.0)


def unsaid(frames):
    """Ages of stale frames that would be ``ok``."""
    return [age for age, bound, _ in frames if age > STALE_S + TOLERANCE_S and bound <= STALE_S]


def false_alarms(frames, since=0.0):
    return sum(age < FRESH_S and bound > STALE_S for age, bound, now in frames if now >= since)


PAUSES = (
    {100: 1.5},
    {100: 5.0},
    {100: 3.0, 101: 3.0},
    {100: 3.0, 110: 3.0},
    {100: 5.0, 101: 1.2},
    {100: 2.0, 101: 2.0, 102: 2.0},
    {100: 0.95, 101: 0.95, 102: 0.95, 103: 0.95, 104: 0.95},
)
JITTERS = ([1.0], [0.8, 1.0, 1.2], [0.25, 1.0, 1.0, 1.75])
PERIODS = (1 / 60, 1 / 30, 0.1)
SETTINGS = tuple(itertools.product([0.02, 0.3, 0.6], [4, 60, 10**6]))


@pytest.mark.parametrize("decodes_elsewhere", [False, True])
@pytest.mark.parametrize("jitter", JITTERS)
@pytest.mark.parametrize("period_s", PERIODS)
def test_no_old_frame_is_ok_after_pauses_of_the_reader(period_s, jitter, decodes_elsewhere):
    for pauses, (decoding, room) in itertools.product(PAUSES, SETTINGS):
        camera = SimulatedCamera(
            period_s, jitter, decoding, room, pauses=pauses, decodes_elsewhere=decodes_elsewhere
        )
        frames = list(camera.frames())
        assert unsaid(frames) == []
        assert false_alarms(frames) < 100
        assert frames[-1][0] > FRESH_S or frames[-1][1] <= STALE_S


def stalls(share, usual_s, longest_s):
    """Draw stalls: a ``share`` of any length up to the longest, the others short."""

    def draw(generator):
        if generator.random() < share:
            return generator.uniform(0.0, longest_s)
        return generator.exponential(usual_s)

    return draw


STARVATION = {
    "seldom": stalls(0.01, 0.0, 5.0),
    "often": stalls(0.05, 0.01, 5.0),
    "at every point": stalls(0.0, 0.03, 0.0),
    "at every point, and long": stalls(0.02, 0.05, 5.0),
    "slower than the camera": stalls(0.0, 0.1, 0.0),
    "below a second": stalls(0.02, 0.0, 1.0),
}


@pytest.mark.parametrize("jitter", JITTERS)
@pytest.mark.parametrize("kind", STARVATION)
def test_no_old_frame_is_ok_while_and_after_the_reader_is_starved(kind, jitter):
    for period_s, (decoding, room) in itertools.product(PERIODS, SETTINGS):
        begin, end = 70 * period_s, 280 * period_s
        camera = SimulatedCamera(
            period_s, jitter, decoding, room, starved=(begin, end), stall=STARVATION[kind]
        )
        frames = list(camera.frames())
        assert max(age for age, _, _ in frames) > 0.0
        assert unsaid(frames) == []
        assert false_alarms(frames, since=end) < 100


@pytest.mark.parametrize("kind", ["seldom", "below a second"])
@pytest.mark.parametrize("jitter", JITTERS)
def test_no_old_frame_is_ok_after_rare_stalls_that_the_kernel_does_not_report(kind, jitter):
    """For example, the kernel sees a stopped process as asleep."""
    for period_s, (decoding, room) in itertools.product(PERIODS, SETTINGS):
        span = (70 * period_s, 280 * period_s)
        camera = SimulatedCamera(
            period_s, jitter, decoding, room, starved=span, stall=STARVATION[kind], hidden=True
        )
        assert unsaid(list(camera.frames())) == []


def bounds(gaps, claimed_fps=30.0, opened_after=0.0):
    """Bounds of frames with these gaps, for a reader that only sleeps between frames."""
    account, now, found = LagAccount(0.0, claimed_fps), opened_after, []
    for gap in gaps:
        now += gap
        found.append(account.queued_s(now, gap))
    return np.array(found)


def test_a_healthy_camera_raises_no_alarm():
    for rate in (10.0, 25.0, 30.0, 60.0, 120.0):
        assert max(bounds([1.0 / rate] * 1000)[20:]) < 0.5


def test_two_pauses_of_less_than_a_second_add_up():
    found = bounds([0.033] * 50 + [0.7, 0.001, 0.7, 0.001])
    assert max(found[:51]) <= STALE_S
    assert min(found[-2:]) > STALE_S


def test_frames_queued_while_the_camera_opened_are_old():
    assert bounds([0.001] * 8, opened_after=4.0).min() > STALE_S


@pytest.mark.parametrize("jitter", [[1.0], [0.9, 1.0, 1.1]])
def test_a_camera_that_turns_slow_or_fast_is_believed_again(jitter):
    generator = np.random.default_rng(0)
    periods = (0.03, 0.9, 0.03, 0.5, 0.02, 0.07, 0.03, 0.3)
    gaps = [p * factor for p in periods for factor in generator.choice(jitter, 300)]
    stale = (bounds(gaps) > STALE_S).reshape(len(periods), 300)
    assert stale.sum(axis=1).max() < 20
    assert not stale[:, 20:].any()


@pytest.mark.parametrize("period_s", [0.2, 0.5, 1.0, 2.0, 5.0])
def test_a_slow_camera_is_believed_after_a_few_frames(period_s):
    for seed in range(20):
        jitter = 1.0 + 0.02 * np.random.default_rng(seed).standard_normal(200)
        assert (bounds(period_s * jitter) > STALE_S).sum() < 9


def test_no_bound_grows_past_what_a_queue_can_hold():
    assert bounds([0.033] * 50 + [1e6]).max() < 100.0


class StampingDriver:
    """OpenCV's Video4Linux capture, whose position is the driver's stamp of the frame."""

    def __init__(self, clock, stamps_s, backend="V4L2"):
        self._clock, self._stamps_s, self._backend = clock, list(stamps_s), backend
        self._stamp_s = 0.0

    def open(self, device):
        return True

    def set(self, name, value):
        return True

    def get(self, name):
        return 1e3 * self._stamp_s

    def getBackendName(self):  # noqa: N802 - OpenCV's name
        return self._backend

    def grab(self):
        self._stamp_s = self._stamps_s.pop(0)
        self._clock.now += 0.001
        return True

    def retrieve(self):
        return True, np.zeros((2, 2, 3), np.uint8)


def test_the_age_of_a_frame_that_a_driver_stamps_is_known(clock):
    clock.now = 1000.0
    opened = _Opened(StampingDriver(clock, [999.9, 995.0, 996.0]), clock)
    opened.open(0, 1.0)
    found = [opened.grab().queued_ms for _ in range(3)]
    assert found == pytest.approx([101.0, 5002.0, 4003.0])


@pytest.mark.parametrize("stamp_s", [0.0, 2000.0, -5.0])
def test_a_driver_s_stamp_of_another_clock_is_not_believed(clock, stamp_s):
    clock.now = 1000.0
    opened = _Opened(StampingDriver(clock, [stamp_s] * 9), clock)
    opened.open(0, 1.0)
    clock.now += 5.0
    assert opened.grab().queued_ms > 4900.0


def test_the_position_of_another_backend_is_no_stamp(clock):
    clock.now = 1000.0
    opened = _Opened(StampingDriver(clock, [999.0], backend="FFMPEG"), clock)
    opened.open(0, 1.0)
    assert opened.grab().queued_ms < 900.0


def test_frames_from_before_a_suspension_are_older_by_its_length():
    stamps = DriverStamps()
    assert stamps.age_s(99.9, 100.0, 500.0) == pytest.approx(0.1)
    # After an hour of suspension, in which the monotonic clock stood still.
    assert stamps.age_s(100.0, 100.2, 4100.2) == pytest.approx(3600.2)
    assert stamps.age_s(100.1, 100.25, 4100.25) == pytest.approx(3600.15)
    assert stamps.age_s(100.25, 100.3, 4100.3) == pytest.approx(0.05)
