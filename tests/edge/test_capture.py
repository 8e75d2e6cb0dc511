"""Cameras that end, hang and reconnect: on simulated time, and over loopback and pipes."""

import contextlib
import http.server
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue

import cv2
import numpy as np
import pytest

from cvo_edge import SourceError, UsageError, open_source
from cvo_edge.input import capture as capture_module
from cvo_edge.input.capture import READER, Capture, Grabbed, shown
from cvo_edge.input.clock import Clock
from cvo_edge.input.sources import PAUSES_S, Camera
from cvo_edge.output.records import read_records

# Only a defect makes a wait take this long.
HANGS_S = 120.0
# In a background shell, children may ignore SIGINT. Attempts follow without pauses.
RUN = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "import cvo_edge.input.sources as sources; sources.PAUSES_S = (0.01,) * 5; "
    "from cvo_edge.__main__ import main; main()"
)
BOUNDARY = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n"

IMAGE = np.zeros((4, 4, 3), np.uint8)


class Cameras:
    """Cameras on simulated time; ``lives`` describes what each connection to one yields.

    A life is a list: seconds until the next frame, ``None`` for a frame that does not decode, or a
    SourceError to raise. It starts with an error if the camera does not open; the stream ends after
    the last item.
    """

    def __init__(self, clock, *lives):
        self.clock, self.lives, self.opened = clock, list(lives), 0
        self.closed = 0

    def __call__(self, device, timeout_s):
        self.opened += 1
        return _Life(self, self.lives.pop(0) if self.lives else [SourceError("gone")])


class _Life:
    def __init__(self, cameras, events):
        self._cameras, self._clock, self._events = cameras, cameras.clock, list(events)

    def open(self):
        if self._events and isinstance(self._events[0], SourceError):
            raise self._events.pop(0)
        return 30.0, 0

    def read(self):
        if not self._events:
            return None
        event = self._events.pop(0)
        if isinstance(event, SourceError):
            raise event
        if event is None:
            return None
        self._clock.now += event
        clock = self._clock
        return Grabbed(IMAGE, clock.time_ns(), clock.now_s(), 0.0, 2.0, 1e3 * event, 5.0)

    def close(self):
        self._cameras.closed += 1


def camera(clock, *lives, fps=None):
    cameras = Cameras(clock, *lives)
    return Camera("cam", fps, 5.0, clock=clock, reader=cameras), cameras


def test_a_stream_that_hangs_or_ends_is_opened_again_and_goes_on(clock, caplog):
    source, cameras = camera(
        clock, [0.03] * 20 + [SourceError("no answer")], [0.03] * 20, [0.03] * 1000
    )
    seen = list(islice(source, 60))
    assert cameras.opened == 3
    assert [frame.source for frame in seen] == [f"cam#{number}" for number in range(60)]
    stamps = [frame.stamp_ns for frame in seen]
    assert stamps == sorted(set(stamps))
    assert clock.waits == [PAUSES_S[0]] * 2
    problems = [record.getMessage() for record in caplog.records]
    assert problems == [
        "no answer; opening it again in 0.25 s",
        "cam: the stream ended; opening it again in 0.25 s",
    ]


def test_a_camera_that_is_gone_is_given_up_after_all_pauses(clock, caplog):
    source, cameras = camera(clock, [0.03] * 10)
    seen = []
    with pytest.raises(SourceError, match=rf"gone \({len(PAUSES_S) + 1} attempts\)"):
        seen.extend(source)
    assert len(seen) == 10
    assert clock.waits == list(PAUSES_S)
    assert cameras.opened == cameras.closed == 1 + len(PAUSES_S)
    assert len(caplog.records) == len(PAUSES_S)


def test_a_camera_that_never_opens_is_refused(clock):
    with pytest.raises(SourceError, match="attempts"):
        camera(clock)
    assert clock.waits == list(PAUSES_S)


def test_an_address_of_single_pictures_is_no_camera(clock):
    source, cameras = camera(clock, *[[0.03]] * 100)
    with pytest.raises(SourceError, match=rf"\({len(PAUSES_S) + 1} attempts\)"):
        list(source)
    assert cameras.opened == 1 + len(PAUSES_S)


def test_a_camera_that_has_come_back_has_all_attempts_again(clock):
    lives = [[0.03] * 2, [SourceError("off")], [SourceError("off")]] * 5
    source, cameras = camera(clock, *lives)
    with pytest.raises(SourceError, match="gone"):
        assert len(list(source)) > 10
    assert cameras.opened == len(lives) + len(PAUSES_S) - 2


def test_frames_that_do_not_decode_have_no_image_and_many_of_them_end_the_stream(clock):
    source, cameras = camera(clock, [0.03, None, None, 0.03], [0.03] * 9)
    seen = list(islice(source, 6))
    assert [frame.image is None for frame in seen] == [False, True, True, False, False, False]
    assert cameras.opened == 2
    assert [frame.source for frame in seen] == [f"cam#{number}" for number in range(6)]


def test_a_frame_knows_when_it_arrived_and_how_long_it_may_have_been_queued(clock):
    source, _ = camera(clock, [0.5, 0.25])
    frames = iter(source)
    first, second = next(frames), next(frames)
    assert (first.arrived_s, second.arrived_s) == (0.5, 0.75)
    assert (first.queued_ms, first.read_ms) == (5.0, 2.0)
    assert second.age_ms(1.0) == pytest.approx(255.0)


def test_a_camera_with_a_given_rate_is_stamped_by_it(clock):
    source, _ = camera(clock, [0.5, 0.25, 0.1], fps=10.0)
    stamps = [frame.stamp_ns for frame in islice(source, 3)]
    assert stamps == [0, 100_000_000, 200_000_000]


def test_a_stopped_camera_yields_no_further_frame(clock):
    source, cameras = camera(clock, [0.03] * 100)
    frames = iter(source)
    next(frames)
    source.stop()
    assert list(frames) == []
    assert cameras.closed == 1


def test_stop_ends_the_pause_before_a_new_attempt(clock):
    source, cameras = camera(clock, [0.03])
    clock.wait = lambda event, timeout_s: source.stop()
    assert len(list(source)) == 1
    assert cameras.opened == 1


class Answers(SimpleQueue):
    """Answers that arrive after some waits have expired, as in a process that was suspended."""

    def __init__(self, expired):
        self.expired, self.waits_s = expired, []

    def get(self, timeout):
        self.waits_s.append(timeout)
        if len(self.waits_s) <= self.expired:
            raise Empty
        return


def test_time_in_which_the_process_was_stopped_is_not_waited_time():
    """A suspension, however long, lets only one part of the wait expire."""
    capture = Capture("nothing", 5.0)
    capture._answers = Answers(expired=1)
    assert capture.read() is None
    assert max(capture._answers.waits_s) < 0.5
    capture._answers = never = Answers(expired=10**6)
    with pytest.raises(SourceError, match="gave no answer within 5 s"):
        capture.read()
    assert sum(never.waits_s) == pytest.approx(5.0)
    with pytest.raises(SourceError, match="closed"):
        capture.read()


class SlowVideo:
    """Stands for OpenCV's capture; its frame comes when ``due`` is set."""

    def __init__(self):
        self.asked, self.due, self.released = threading.Event(), threading.Event(), False

    def __getattr__(self, name):
        return lambda *_: 0.0

    def open(self, *_):
        return True

    def getBackendName(self):  # noqa: N802 - OpenCV's name
        return "FFMPEG"

    def grab(self):
        self.asked.set()
        return self.due.wait(HANGS_S) and False

    def release(self):
        self.released = True


def test_a_read_that_is_under_way_ends_before_python_does(monkeypatch):
    """Python would end its thread inside OpenCV, and abort."""
    video = SlowVideo()
    capture = Capture("slow", HANGS_S, video=lambda: video)
    capture.open()
    reading = threading.Thread(target=read_quietly, args=(capture,))
    reading.start()
    video.asked.wait(HANGS_S)
    capture.close()
    assert not video.released
    monkeypatch.setattr(capture_module, "_RELEASE_S", HANGS_S)
    monkeypatch.setattr(capture_module, "_reading", {capture._thread})
    video.due.set()
    capture_module._await_readers()
    assert video.released
    reading.join(HANGS_S)


def read_quietly(capture):
    with contextlib.suppress(SourceError):
        capture.read()


class NetworkCamera:
    """Motion JPEG over HTTP on loopback, sent as fast as the client reads it.

    ``lives`` holds the number of frames of each connection; the last connection then hangs.
    """

    def __init__(self, pictures, lives):
        camera, self.connections = self, 0

        class Handler(http.server.BaseHTTPRequestHandler):
            def log_message(self, *_):
                pass

            def do_GET(self):
                number, camera.connections = camera.connections, camera.connections + 1
                if number >= len(lives):
                    self.send_error(503)
                    return
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                with contextlib.suppress(OSError):
                    for k in range(lives[number]):
                        picture = pictures[k % len(pictures)]
                        self.wfile.write(BOUNDARY % (len(picture), picture))
                    if number == len(lives) - 1:
                        camera.stopped.wait(HANGS_S)

        self.stopped = threading.Event()
        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = False
        self.address = f"http://127.0.0.1:{self.server.server_port}/camera.mjpg"
        self.serving = threading.Thread(target=self.server.serve_forever, daemon=True)
        self.serving.start()

    def close(self):
        """Close all connections and join their threads."""
        self.stopped.set()
        self.server.shutdown()
        self.server.server_close()
        self.serving.join(HANGS_S)


@pytest.fixture
def network_camera(clip_dir):
    pictures = [path.read_bytes() for path in sorted(clip_dir.glob("*.jpg"))[:20]]
    cameras = []

    def start(*lives, pictures=pictures):
        cameras.append(NetworkCamera(pictures, lives))
        return cameras[-1]

    yield start
    for each in cameras:
        each.close()


@pytest.fixture
def hasty(monkeypatch):
    """Remove the pauses between attempts."""
    monkeypatch.setattr("cvo_edge.input.sources.PAUSES_S", (0.01,) * len(PAUSES_S))


@pytest.mark.parametrize("damage", ["nothing", "zeros", "no header"])
def test_a_damaged_frame_of_a_camera_has_no_image_and_the_others_have_theirs(
    clip_dir, network_camera, damage
):
    pictures = [path.read_bytes() for path in sorted(clip_dir.glob("*.jpg"))[:30]]
    whole = pictures[10]
    pictures[10] = {
        "nothing": whole,
        "zeros": bytes(len(whole)),
        "no header": bytes(200) + whole[200:],
    }[damage]
    camera = network_camera(1000, pictures=pictures)
    source = open_source(camera.address, timeout_s=HANGS_S)
    frames = list(islice(source, 25))
    source.stop()
    assert camera.connections == 1
    unreadable = [frame.source for frame in frames if frame.image is None]
    assert unreadable == ([] if damage == "nothing" else [f"{camera.address}#10"])
    assert [frame.source for frame in frames] == [f"{camera.address}#{k}" for k in range(25)]
    stamps = [frame.stamp_ns for frame in frames]
    assert stamps == sorted(set(stamps))


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def test_abandoned_connections_leave_neither_threads_nor_files(network_camera, hasty):
    files, before = open_files(), set(threading.enumerate())
    camera = network_camera(*[5] * 8, 1000)
    source = open_source(camera.address, timeout_s=HANGS_S)
    for number, _ in enumerate(source):
        if number == 50:
            break
    source.stop()
    assert camera.connections == 9
    camera.close()
    for thread in set(threading.enumerate()) - before:
        thread.join(HANGS_S)
        assert not thread.is_alive()
    assert open_files() <= files


def test_a_camera_that_never_answers_is_given_up(bundle_dir, tmp_path):
    """Runs in its own process: OpenCV opens one stream at a time, and this one never opens."""
    pipe = tmp_path / "camera"
    os.mkfifo(pipe)
    arguments = ["run", bundle_dir, pipe, "--timeout", "0.1", "--mode", "live"]
    done = subprocess.run(
        [sys.executable, "-c", RUN, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=False,
    )
    assert (done.returncode, done.stdout) == (6, "")
    *attempts, last = done.stderr.splitlines()
    assert len(attempts) == len(PAUSES_S)
    assert last.startswith(f"cvo-edge: {pipe}: gave no answer within 0.2 s (6 attempts)")


def free_address():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{free.getsockname()[1]}"


def test_an_address_where_nothing_answers_is_refused(hasty):
    with pytest.raises(SourceError, match="did not open as a video or camera"):
        open_source(f"{free_address()}/camera.mjpg", timeout_s=HANGS_S)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_run_whose_read_does_not_return(network_camera, bundle_dir, number):
    camera = network_camera(15)
    arguments = ["run", bundle_dir, camera.address, "--timeout", 3600, "--format", "jsonl"]
    with subprocess.Popen(
        [sys.executable, "-c", RUN, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        # The last frame is never dropped; after it, the camera hangs.
        while json.loads(process.stdout.readline()).get("seq", -1) < 13:
            pass
        process.send_signal(number)
        _, errors = process.communicate(timeout=HANGS_S)
    assert process.returncode == 128 + number
    assert "Traceback" not in errors


def test_what_an_address_holds_cannot_forge_a_line(caplog, hasty):
    with pytest.raises(SourceError):
        open_source(f"{free_address()}/\nfoo\x1b[31m", timeout_s=HANGS_S)
    assert caplog.records
    assert all(record.getMessage().isprintable() for record in caplog.records)


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_timeout_out_of_range_is_refused(timeout_s, tmp_path):
    with pytest.raises(UsageError, match="timeout"):
        open_source(str(tmp_path), timeout_s=timeout_s)


def test_an_address_is_a_live_camera(network_camera):
    source = open_source(network_camera(1000).address, timeout_s=HANGS_S)
    assert isinstance(source, Camera)
    assert source.live
    source.stop()


def test_a_password_is_in_no_record_and_no_message(network_camera, caplog, hasty):
    camera = network_camera(5, 0)
    camera.stopped.set()
    address = camera.address.replace("//", "//user:secret@")
    seen = []
    with pytest.raises(SourceError) as caught:
        seen.extend(open_source(address, timeout_s=HANGS_S))
    assert seen
    assert all(frame.source.startswith(camera.address) for frame in seen)
    said = [str(caught.value), *(record.getMessage() for record in caplog.records)]
    assert not any("secret" in text for text in said)


def test_stop_ends_the_wait_for_a_camera_that_does_not_open(tmp_path):
    script = """
import os, sys, threading
from cvo_edge.input.capture import Capture
from cvo_edge.input.sources import Camera

opening = threading.Event()
camera = Camera.__new__(Camera)

def reader(device, timeout_s):
    opening.set()
    return Capture(device, timeout_s)

def stop():
    opening.wait()
    camera.stop()

threading.Thread(target=stop, daemon=True).start()
camera.__init__(sys.argv[1], None, 3000.0, reader=reader)
print("ended", flush=True)
os._exit(0)
"""
    os.mkfifo(tmp_path / "camera")
    done = subprocess.run(
        [sys.executable, "-c", script, tmp_path / "camera"],
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=False,
    )
    assert done.stdout == "ended\n", done.stderr


def test_bench_connects_once(network_camera, bundle_dir):
    camera = network_camera(10_000)
    arguments = ["bench", bundle_dir, camera.address, "--frames", 5, "--warmup", 1]
    done = subprocess.run(
        [sys.executable, "-c", RUN, *map(str, arguments), "--mode", "live"],
        capture_output=True,
        timeout=HANGS_S,
        check=False,
    )
    assert (done.returncode, camera.connections) == (0, 1)


@pytest.mark.parametrize("address", ["http://u:secret@h/x", "rtsp://u:se@secret@h:1/x@y"])
def test_a_password_is_not_shown(address):
    assert "secret" not in shown(address)
    assert shown(address).startswith(address.split(":")[0] + "://h")


def test_a_failure_inside_opencv_is_an_unreadable_frame(monkeypatch, clip_dir):
    class Failing:
        def open(self, device):
            return True

        def get(self, name):
            return 0.0

        def set(self, name, value):
            return False

        def getBackendName(self):  # noqa: N802 - OpenCV's name
            return "FFMPEG"

        def grab(self):
            raise cv2.error("inside")

        def release(self):
            pass

    monkeypatch.setattr(cv2, "VideoCapture", Failing)
    capture = Capture("camera", HANGS_S)
    assert capture.open() == (0.0, 0)
    assert capture.read() is None
    capture.close()
    assert not any(t.name == READER and t.is_alive() for t in threading.enumerate())


def test_a_device_that_fails_inside_opencv_does_not_open(monkeypatch):
    class Failing:
        def open(self, device):
            raise cv2.error("inside")

        def release(self):
            pass

    monkeypatch.setattr(cv2, "VideoCapture", Failing)
    with pytest.raises(SourceError, match="did not open as a video or camera"):
        Capture("camera", HANGS_S).open()


def test_a_defect_in_the_reading_thread_reaches_the_caller(monkeypatch):
    class Defective:
        def open(self, device):
            raise ValueError("a defect")

        def release(self):
            pass

    monkeypatch.setattr(cv2, "VideoCapture", Defective)
    with pytest.raises(ValueError, match="a defect"):
        Capture("camera", HANGS_S).open()


def test_without_a_thread_to_read_it_a_camera_is_refused(monkeypatch):
    def start(thread):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("cvo_edge.input.capture.Thread.start", start)
    with pytest.raises(SourceError, match="cannot start its reading thread"):
        Capture("camera", HANGS_S)


@pytest.mark.parametrize(
    ("content", "busy_s"), [(b"2000000000 500000000 7\n", 2.5), (b"", 11.0), (None, 11.0)]
)
def test_time_ready_to_run_counts_as_busy_where_the_kernel_reports_it(
    monkeypatch, tmp_path, content, busy_s
):
    path = tmp_path / "schedstat"
    if content is not None:
        path.write_bytes(content)
    monkeypatch.setattr("cvo_edge.input.clock._SCHEDSTAT", path)
    monkeypatch.setattr("time.thread_time", lambda: 11.0)
    assert Clock().busy_s() == pytest.approx(busy_s)


def test_a_service_accounts_for_every_frame_of_a_camera_that_comes_and_goes(
    bundle_dir, network_camera, tmp_path
):
    """Its file is renamed meanwhile; it is asked to open it again, and to end."""
    camera, path = network_camera(20, 8, 30), tmp_path / "a.jsonl"
    command = ["serve", bundle_dir, camera.address, "-o", path, "--threads", "1"]
    with subprocess.Popen(
        [sys.executable, "-m", "cvo_edge", *map(str, command)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as service:
        lines = iter(service.stderr.readline, "")
        said = ["", *(line for line in takewhile_back(lines, 2))]
        path.rename(tmp_path / "a.jsonl.1")
        service.send_signal(signal.SIGHUP)
        service.send_signal(signal.SIGUSR1)
        said += [next(line for line in lines if line.startswith("health"))]
        service.send_signal(signal.SIGTERM)
        said += lines
        assert service.wait(HANGS_S) == 0
    text = "".join(said)
    assert text.count("camera lost") == text.count("camera back") == 2
    delivered, frames, dropped = map(
        int, re.search(r"(\d+) frames delivered = (\d+) estimated \+ (\d+) dropped", text).groups()
    )
    assert delivered == frames + dropped > 28
    written = [len(list(read_records(each))) for each in tmp_path.glob("a.jsonl*")]
    assert sum(written) == frames


def takewhile_back(lines, times):
    """Yield lines until the camera has come back so often."""
    for line in lines:
        yield line
        times -= line.startswith("camera back")
        if not times:
            return
