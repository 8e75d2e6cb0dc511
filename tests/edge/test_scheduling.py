"""Scheduling of streams: order, errors at their position, the newest frame."""

import json
import subprocess
import sys
import threading
from itertools import pairwise
from types import SimpleNamespace

import cv2
import msgspec
import numpy as np
import pytest

from cvo_edge import Frame, Odometer, Reason, SourceError, UsageError, open_source
from cvo_edge.input.capture import READER
from cvo_edge.input.newest import Newest, Played
from cvo_edge.scheduling import in_order, plan, usual_mode
from cvo_edge.vocabulary import MODES

# Only a defect makes a wait take this long.
HANGS_S = 120.0


def test_each_mode_uses_the_threads_it_is_given():
    for mode in MODES:
        settings = plan(mode, 2)
        assert settings.threads * settings.workers == 2
    assert plan("throughput", 3).threads == 1
    with pytest.raises(UsageError, match="threads: expected 1 to 64, found 0"):
        plan("throughput", 0)


def test_results_come_in_the_order_of_their_tasks():
    done = [threading.Event() for _ in range(60)]

    def task(number):
        # Each even task ends after its successor.
        if number % 2 == 0:
            assert done[number + 1].wait(HANGS_S)
        done[number].set()
        return number

    tasks = (lambda number=number: task(number) for number in range(60))
    assert list(in_order(tasks, 3)) == list(range(60))


def test_few_tasks_are_under_way_and_none_after_the_last_one_wanted():
    taken = []

    def tasks():
        for number in range(1000):
            taken.append(number)
            yield lambda number=number: number

    results = in_order(tasks(), 2)
    assert [next(results) for _ in range(5)] == list(range(5))
    assert len(taken) <= 5 + 2 + 2
    results.close()
    assert len(taken) <= 5 + 2 + 2


def test_a_single_worker_is_the_calling_thread():
    assert list(in_order([threading.get_ident] * 3, 1)) == [threading.get_ident()] * 3


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_comes_in_its_place(workers):
    def fails():
        raise ValueError("third")

    def ending(error):
        yield from (lambda: 1, lambda: 2)
        raise error

    results = in_order([lambda: 1, lambda: 2, fails, lambda: 4], workers)
    assert [next(results), next(results)] == [1, 2]
    with pytest.raises(ValueError, match="third"):
        next(results)
    for error in (SourceError("ended early"), KeyError("ended early")):
        results = in_order(ending(error), workers)
        assert [next(results), next(results)] == [1, 2]
        with pytest.raises(type(error), match="ended early"):
            next(results)


def picture_free(number):
    return Frame(None, number * 1_000_000, str(number), 0.0)


class Stepping:
    """A source whose frames arrive when a test releases them."""

    def __init__(self, count, failure=None):
        self._go, self._asked = threading.Semaphore(0), threading.Semaphore(0)
        self._count, self._failure = count, failure

    def __iter__(self):
        for number in range(self._count):
            self._asked.release()
            self._go.acquire()
            yield picture_free(number)
        self._asked.release()
        if self._failure:
            raise self._failure

    def give(self, count):
        """Release this many frames, one by one, until the next one is requested."""
        for _ in range(count):
            assert self._asked.acquire(timeout=HANGS_S)
            self._go.release()
        assert self._asked.acquire(timeout=HANGS_S)
        self._asked.release()


FAILURES = [None, SourceError("camera 0: gave no frame after 6 frames"), SystemExit(3)]


@pytest.mark.parametrize("failure", FAILURES)
def test_the_newest_frame_is_seen_and_the_others_are_counted(clock, failure):
    source = Stepping(6, failure)
    newest = iter(Newest(source, clock=clock))
    first = threading.Thread(target=source.give, args=(1,))
    first.start()
    assert next(newest).source == "0"
    first.join()
    source.give(3)
    clock.now = 2.0
    frame = next(newest)
    assert (frame.source, frame.skipped) == ("3", 2)
    assert frame.age_ms(clock.now) == 2000.0
    source.give(2)
    frame = next(newest)
    assert (frame.source, frame.skipped) == ("5", 1)
    with pytest.raises(type(failure) if failure else StopIteration):
        next(newest)


def test_a_frame_ages_from_its_arrival_at_the_camera(clock):
    clock.now = 10.0
    given = Frame(None, 0, "", 5.0, queued_ms=300.0, arrived_s=9.0)
    (frame,) = Newest([given], clock=clock)
    assert frame.age_ms(clock.now) == pytest.approx(1300.0)
    (frame,) = Newest([Frame(None, 0, "", 5.0)], clock=clock)
    assert frame.age_ms(clock.now) == pytest.approx(5.0)
    assert given.since_arrival_ms(9.5) == pytest.approx(500.0)


def test_a_frame_that_ages_while_it_is_estimated_is_stale(bundle_dir, clip_dir, clock, monkeypatch):
    images = [frame.image for frame in list(open_source(str(clip_dir)))[:3]]
    frames = [Frame(image, None, "", 0.0, arrived_s=0.0) for image in images]
    delays = iter([0.9, 0.2, 0.0])
    with Odometer.load(bundle_dir, threads=1) as odometer:
        odometer._clock, infer = clock, odometer._observer.infer

        def slowly(prepared, seq):
            clock.now += next(delays)
            return infer(prepared, seq)

        monkeypatch.setattr(odometer._observer, "infer", slowly)
        found = list(odometer.stream(frames))
    assert [each.reasons for each in found] == [(), (Reason.FRAME_STALE,), (Reason.FRAME_STALE,)]
    assert [np.isfinite(each.lower).all() for each in found] == [True, False, False]


def test_files_are_played_at_their_stamps_and_late_ones_at_once(clock):
    seen = []
    for frame in Played(Recorded(6, step_ns=20_000_000), clock):
        seen.append(round(clock.now, 6))
        clock.now += 0.05 if frame.source == "2" else 0.001
    assert seen == [0.0, 0.02, 0.04, 0.09, 0.091, 0.1]


def test_a_play_that_is_stopped_ends(clock):
    played = Played(Recorded(6, step_ns=20_000_000), clock)
    frames = iter(played)
    next(frames)
    played.stop()
    assert list(frames) == []


class Recorded:
    """A recording without images."""

    live = False

    def __init__(self, length, step_ns):
        self.length, self._step_ns = length, step_ns

    def __iter__(self):
        for number in range(self.length):
            yield Frame(None, number * self._step_ns, str(number), 0.0)

    def reads(self):
        for frame in self:
            yield lambda frame=frame: frame


def readers():
    return {thread for thread in threading.enumerate() if thread.name == READER}


def test_nothing_reads_on_when_a_live_stream_is_left(bundle_dir):
    before = readers()
    with Odometer.load(bundle_dir, mode="live") as odometer:
        for _ in odometer.stream(Recorded(3, step_ns=10 * 10**9 * int(HANGS_S))):
            break
    for reader in readers() - before:
        reader.join(HANGS_S)
        assert not reader.is_alive()


def test_a_process_exits_cleanly_while_a_video_is_being_read(bundle_dir, clip_dir, tmp_path):
    # The images are large, so that the reader spends most of its time inside OpenCV.
    frame = next(iter(open_source(str(clip_dir))))
    path = tmp_path / "large.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30, (2560, 1920))
    for _ in range(20):
        writer.write(cv2.resize(frame.image, (2560, 1920)))
    writer.release()
    command = [sys.executable, "-c", "from cvo_edge.__main__ import main; main()", "run"]
    arguments = [str(bundle_dir), str(path), "--mode", "live", "--max-frames", "2", "--quiet"]
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr, len(done.stdout.splitlines())) == (0, "", 1 + 2)


@pytest.mark.parametrize(
    ("live", "length", "adapts", "mode"),
    [
        (True, None, False, "live"),
        (True, None, True, "live"),
        (False, 50, False, "throughput"),
        (False, 50, True, "latency"),
        (False, None, False, "latency"),
        (False, 1, False, "latency"),
    ],
)
def test_recordings_are_read_as_fast_as_nothing_is_lost(live, length, adapts, mode):
    source = SimpleNamespace(live=live, length=length)
    assert usual_mode(source, adapts=adapts) == mode


def test_a_recording_without_stamps_is_not_played_live(bundle_dir, clip_dir):
    odometer = Odometer.load(bundle_dir, mode="live")
    with pytest.raises(UsageError, match="the frames have no stamps"):
        list(odometer.stream(open_source(str(clip_dir))))
    with pytest.raises(UsageError, match="mode: expected one of live, latency, throughput"):
        Odometer.load(bundle_dir, mode="fast")


def intervals(estimates):
    return {
        estimate.source: (estimate.seq, estimate.lower.tolist(), estimate.upper.tolist())
        for estimate in estimates
    }


def test_every_mode_gives_the_same_numbers(bundle, rewrite, clip_dir, clock):
    # An alarm depends on the frames before, of which live mode drops some.
    folder = rewrite(msgspec.structs.replace(bundle.calibration, alarm=None))
    found = {}
    for mode in MODES:
        with Odometer.load(folder, mode=mode, threads=2) as odometer:
            odometer._clock = clock
            found[mode] = list(odometer.stream(open_source(str(clip_dir), fps=100)))
    latency, throughput = (intervals(found[mode]) for mode in ("latency", "throughput"))
    assert list(throughput.items()) == list(latency.items())
    assert intervals(found["live"]).items() <= latency.items()
    numbers = [each.seq for each in found["live"]]
    assert all(a < b for a, b in pairwise(numbers))
    assert numbers[-1] == 49  # the last frame is never dropped


def test_a_caller_may_write_the_next_image_into_the_same_memory(bundle_dir, clip_dir):
    images = [frame.image for frame in list(open_source(str(clip_dir)))[:12]]

    def refilled():
        memory = np.empty_like(images[0])
        for image in images:
            np.copyto(memory, image)
            yield memory

    found = {}
    for mode in ("latency", "throughput"):
        with Odometer.load(bundle_dir, mode=mode, threads=2) as odometer:
            found[mode] = [estimate.lower.tolist() for estimate in odometer.stream(refilled())]
    assert found["throughput"] == found["latency"]


@pytest.mark.parametrize("mode", ["latency", "throughput"])
def test_numbers_go_on_where_a_stream_was_left(bundle_dir, clip_dir, mode):
    with Odometer.load(bundle_dir, mode=mode, threads=2) as odometer:
        for _ in range(2):
            stream = odometer.stream(open_source(str(clip_dir)))
            first = [next(stream).seq, next(stream).seq]
            stream.close()
        assert first == [2, 3]
        assert odometer.step(None).seq == 4


def test_a_mode_on_the_command_line(bundle_dir, clip_dir):
    command = [sys.executable, "-c", "from cvo_edge.__main__ import main; main()", "run"]
    outputs = {}
    for mode in ("latency", "throughput"):
        arguments = [bundle_dir, clip_dir, "--mode", mode, "--max-frames", 7, "--format", "table"]
        result = subprocess.run(
            [*command, *map(str, arguments)], capture_output=True, text=True, check=True
        )
        outputs[mode] = result.stdout
    assert outputs["latency"] == outputs["throughput"]
    assert len(outputs["latency"].splitlines()) == 4 + 7
    arguments = [bundle_dir, clip_dir, "--mode", "live", "--fps", 1000]
    result = subprocess.run(
        [*command, *map(str, arguments)], capture_output=True, text=True, check=True
    )
    records = [json.loads(line) for line in result.stdout.splitlines()[1:]]
    left_out = 50 - len(records)
    assert records[-1]["seq"] == 49
    assert (f"dropped     {left_out} frames" in result.stderr) == (left_out > 0)
