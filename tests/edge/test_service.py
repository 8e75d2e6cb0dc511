"""A service: what it tells systemd, what it drops and counts, and what it calls alive."""

import signal
import socket
from collections import Counter
from types import SimpleNamespace

import pytest

from cvo_edge import process
from cvo_edge.errors import SinkError
from cvo_edge.input.sources import Camera
from cvo_edge.input.waiting import LONGEST_PAUSE_S, Waiting
from cvo_edge.odometer import Odometer
from cvo_edge.output.dropping import Dropping
from cvo_edge.output.records import header_of, read_records
from cvo_edge.output.sinks import Sink
from cvo_edge.programs.job import Job
from cvo_edge.programs.notify import Notifier
from cvo_edge.programs.run import RunSummary
from cvo_edge.programs.serve import _signals
from cvo_edge.programs.service import Service


@pytest.fixture
def listening(tmp_path, request):
    """A socket as systemd has it, and the environment that names it."""
    address = str(tmp_path / "notify")
    if request.param == "abstract":
        address = f"@cvo-edge-test-{tmp_path}"[:100]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(address.replace("@", "\0", 1))
        receiver.settimeout(5.0)
        yield receiver, {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "20000000"}


@pytest.mark.parametrize("listening", ["path", "abstract"], indirect=True)
def test_systemd_hears_what_a_notifier_tells(listening):
    receiver, environment = listening
    notifier = Notifier(environment)
    assert notifier.watchdog_s == 20.0
    for tell, expected in (
        (lambda: notifier.ready("waiting"), b"READY=1\nSTATUS=waiting"),
        (notifier.alive, b"WATCHDOG=1"),
        (lambda: notifier.status("health: x"), b"STATUS=health: x"),
        (notifier.stopping, b"STOPPING=1"),
    ):
        tell()
        assert receiver.recv(4096) == expected
    notifier.reloading()
    assert receiver.recv(4096).startswith(b"RELOADING=1\nMONOTONIC_USEC=")


def test_without_systemd_nobody_is_told():
    notifier = Notifier({"NOTIFY_SOCKET": "/no/such/socket"})
    notifier.alive()
    assert notifier.watchdog_s is None
    assert Notifier({"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}).watchdog_s is None


def test_a_camera_is_waited_for_with_growing_pauses_and_said_once(clock):
    told = []
    waiting = Waiting(told.append, clock)
    pauses = [waiting.failed("cam: gone") for _ in range(10)]
    assert pauses == sorted(pauses)
    assert pauses[0] < 1.0 < pauses[-1] == LONGEST_PAUSE_S
    assert waiting.lost
    waiting.gave_frame()
    waiting.gave_frame()
    assert [line.split(":")[0] for line in told] == [
        "camera lost",
        "camera back after 0.0 s and 10 attempts",
    ]
    # One that comes for a moment is not asked as if it were new; one that was steady is.
    assert waiting.failed("cam: gone") == LONGEST_PAUSE_S
    waiting.gave_frame()
    clock.now += 60.0
    assert waiting.failed("cam: gone") == pauses[0]
    assert (waiting.reopened, len(told)) == (2, 5)


@pytest.fixture(scope="module")
def estimates(bundle):
    with Odometer(bundle, threads=1) as odometer:
        header = header_of(odometer.calibration, odometer.chart, 0.9, "marginal")
        return header, [odometer.step(None, source=f"#{number}") for number in range(40)]


def test_every_record_is_written_or_dropped_and_said(tmp_path, estimates, files_limited, clock):
    header, frames = estimates
    path, told = tmp_path / "a.jsonl", []
    opening = lambda: Sink(str(path), "jsonl", header, existing="append")  # noqa: E731
    with Dropping("records", opening, told.append, clock) as sink:
        for frame in frames[:10]:
            sink.write(frame)
        with files_limited(path.stat().st_size + 50):
            for frame in frames[10:20]:
                sink.write(frame)
        for frame in frames[20:]:
            clock.now += 1.0
            sink.write(frame)
    assert (sink.written, sink.dropped) == (30, 10)
    assert [record.seq for record in read_records(path)] == [*range(10), *range(20, 40)]
    assert len(told) == 2
    assert "dropped until" in told[0]
    assert told[1] == "records are written again; 10 were dropped"


def test_a_disk_that_is_full_at_the_start_is_waited_for_and_no_other_failure(tmp_path, estimates):
    header, frames = estimates
    path, full = tmp_path / "a.jsonl", [True]

    def opening():
        try:
            if full:
                raise OSError(28, "No space left on device")
        except OSError:
            raise SinkError("a: cannot be written") from None
        return Sink(str(path), "jsonl", header)

    with Dropping("records", opening, lambda _: None) as sink:
        sink.write(frames[0])
        full.clear()
        sink.write(frames[1])
    assert (sink.written, sink.dropped) == (1, 1)
    missing = Dropping("records", lambda: Sink(str(tmp_path / "no" / "a"), "jsonl"), lambda _: None)
    with pytest.raises(SinkError), missing:
        pass


def test_a_file_that_was_emptied_begins_with_a_header(tmp_path, estimates, files_limited):
    header, frames = estimates
    path = tmp_path / "a.jsonl"
    with Sink(str(path), "jsonl", header) as sink:
        with files_limited(10), pytest.raises(SinkError):
            sink.write(frames[0])
        for frame in frames[:2]:
            sink.write(frame)
            assert read_records(path).header == header
            path.write_bytes(b"")


class Told:
    """Stands for systemd, and for a user who reads."""

    watchdog_s = 10.0

    def __init__(self):
        self.lines, self.said = [], Counter()

    def __getattr__(self, name):
        return lambda *_: self.said.update([name])


def watched(clock, every_s=1e9):
    """A service whose camera and summary a test sets."""
    told = Told()
    waiting = Waiting(told.lines.append, clock)
    service = Service(waiting, told, told.lines.append, every_s, clock)
    camera = Camera("cam", None, 5.0, clock=clock, patience=waiting)
    summary = RunSummary(("tx",) * 6, 0.9, "marginal")
    service._job = Job(None, camera, summary, [])
    return service, told, camera, summary


@pytest.mark.parametrize(
    ("frames", "loop", "reader", "alive"),
    [
        ("come", "works", "works", True),
        ("come", "hangs", "works", False),
        ("none", "works", "works", True),  # the camera is lost, and asked again and again
        ("none", "works", "hangs", False),
    ],
)
def test_the_watchdog_hears_of_progress_and_of_a_known_wait_alone(
    clock, frames, loop, reader, alive
):
    service, told, camera, summary = watched(clock)
    for _ in range(120):
        clock.now += 1.0
        camera.delivered += frames == "come"
        summary.statuses["ok"] += frames == "come" and loop == "works"
        if reader == "works":
            camera.heard_s = clock.awake_s()
        before = told.said["alive"]
        service.look()
    assert (told.said["alive"] > before) == alive
    assert sum("stuck" in line for line in told.lines) == (not alive)


@pytest.mark.parametrize(("way", "step_s"), [("forward", 3600.0), ("back", -3600.0)])
def test_a_clock_that_steps_is_said_once_and_changes_nothing(clock, way, step_s, monkeypatch):
    service, told, *_ = watched(clock, every_s=60.0)
    stepped = [0.0]
    day = clock.time_ns
    monkeypatch.setattr(clock, "time_ns", lambda: day() + round(1e9 * stepped[0]))
    for second in range(120):
        stepped[0] = step_s if second >= 30 else 0.0
        clock.now += 1.0
        service._job.frames.heard_s = clock.awake_s()
        service.look()
    health = [line for line in told.lines if line.startswith("health:")]
    assert [line for line in told.lines if line not in health] == [
        f"clock stepped: the system's time was set {way} by 3600.0 s"
    ]
    assert [line.split()[1] for line in health] == ["uptime_s=60", "uptime_s=120"]
    assert told.said["alive"] == 120


def test_a_clock_that_is_read_late_has_not_stepped(clock, monkeypatch):
    service, told, *_ = watched(clock)
    real = clock.time_ns

    def late():
        clock.now += 1.5
        return real()

    monkeypatch.setattr(clock, "time_ns", late)
    service.look()
    assert told.lines == []


def test_a_process_that_stood_still_says_so_and_is_alive(clock):
    service, told, *_ = watched(clock)
    for gap_s in (1.0, 1.0, 90.0, 1.0):
        clock.now += gap_s
        service.look()
    assert told.lines == ["stood still: this process did not run for 90.0 s; old frames are stale"]
    assert told.said["alive"] >= 3


def test_the_account_holds_while_frames_are_under_way(clock):
    service, _, camera, summary = watched(clock)
    camera.delivered, summary.dropped = 10, 3
    summary.statuses.update(ok=4, degraded=1)
    figures = service.figures()
    assert (
        figures["delivered"]
        == figures["frames"] + figures["dropped_frames"] + figures["pending"]
        == 10
    )
    assert "2 unfinished" in service.lines()[0]
    assert {each.name: each.value for each in service.counts()}["cvo_delivered_frames"] == 10


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_the_camera_and_others_are_answered(clock, number, monkeypatch):
    service, told, *_ = watched(clock)
    before = signal.signal(signal.SIGHUP, lambda *_: told.lines.append("reopened"))
    monkeypatch.setattr(process, "_has_terminal", lambda: False)
    stopped = SimpleNamespace(stop=lambda: told.lines.append("stopped"))
    try:
        with _signals(stopped, service, told):
            for each in (signal.SIGHUP, signal.SIGUSR1, number):
                signal.raise_signal(each)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert [line.split(":")[0] for line in told.lines] == ["reopened", "health", "stopped"]
    assert told.said == Counter(reloading=1, ready=1, stopping=1)
