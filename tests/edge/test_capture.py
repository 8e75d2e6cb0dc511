"""Cameras that end, hang and come back: real streams over loopback and pipes."""

import http.server
import itertools
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from pathlib import Path

import cv2
import numpy as np
import pytest

from cvo_edge import SourceError, UsageError, open_source, read_records
from cvo_edge.input.capture import shown
from cvo_edge.input.queue_lag import Arrivals
from cvo_edge.input.sources import PAUSES_S, Camera

pytestmark = pytest.mark.clock

# Whoever runs the suite in the background of a script has it ignore SIGINT, and its children too.
RUN = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from cvo_edge.__main__ import main; main()"
)
BOUNDARY = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n"


class NetworkCamera:
    """Motion JPEG over HTTP on loopback; ``lives`` says how each connection goes.

    Each is a number of frames, and how many seconds of silence come before it is closed.
    ``gaps_s`` are between frames, in turns.
    """

    def __init__(self, pictures, lives, gaps_s=(0.02,)):
        camera, self.connections, self.sent_ns = self, 0, []

        class Handler(http.server.BaseHTTPRequestHandler):
            def log_message(self, *_):
                pass

            def do_GET(self):
                number, camera.connections = camera.connections, camera.connections + 1
                if number >= len(lives):
                    self.send_error(503)
                    return
                frames, silence_s = lives[number]
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                try:
                    for k in range(frames):
                        picture = pictures[k % len(pictures)]
                        camera.sent_ns.append(time.time_ns())
                        self.wfile.write(BOUNDARY % (len(picture), picture))
                        time.sleep(gaps_s[k % len(gaps_s)])
                    camera.stopped.wait(silence_s)
                except OSError:
                    pass  # it was given up

        self.stopped = threading.Event()
        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self.server.server_port}/camera.mjpg"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def close(self):
        self.stopped.set()
        self.server.shutdown()
        self.server.server_close()


def resized(content, size):
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    return cv2.imencode(".jpg", cv2.resize(picture, size))[1].tobytes()


@pytest.fixture
def network_camera(clip_dir):
    pictures = [path.read_bytes() for path in sorted(clip_dir.glob("*.jpg"))[:20]]
    cameras = []

    def start(*lives, size=None, **options):
        shown = pictures if size is None else [resized(picture, size) for picture in pictures]
        cameras.append(NetworkCamera(shown, lives, **options))
        return cameras[-1]

    yield start
    for camera in cameras:
        camera.close()


@pytest.fixture
def hasty(monkeypatch):
    """Attempts without pauses between them."""
    monkeypatch.setattr("cvo_edge.input.sources.PAUSES_S", (0.01,) * len(PAUSES_S))


def test_a_stream_that_hangs_or_ends_is_opened_again_and_goes_on(network_camera, caplog):
    camera = network_camera((20, 60.0), (20, 0.0), (1000, 0.0))
    source = open_source(camera.address, timeout_s=0.5)
    assert source.live
    seen = []
    for frame in source:
        assert frame.image.shape == (240, 320, 3)
        seen.append((frame.source, frame.stamp_ns))
        if len(seen) == 60:
            break
    assert camera.connections == 3
    stamps = [stamp_ns for _, stamp_ns in seen]
    assert stamps == sorted(set(stamps))
    assert [name for name, _ in seen] == [f"{camera.address}#{number}" for number in range(60)]
    problems = [record.getMessage() for record in caplog.records]
    assert ["within 0.5 s, found none" in problems[0], "found its end" in problems[1]] == [True] * 2


@pytest.mark.parametrize("damage", ["nothing", "zeros", "no header"])
def test_a_damaged_frame_of_a_camera_costs_itself_alone(clip_dir, damage):
    pictures = [path.read_bytes() for path in sorted(clip_dir.glob("*.jpg"))[:30]]
    whole = pictures[10]
    pictures[10] = {
        "nothing": whole,
        "zeros": bytes(len(whole)),
        "no header": bytes(200) + whole[200:],
    }[damage]
    camera = NetworkCamera(pictures, [(1000, 0.0)])
    frames = list(zip(range(25), open_source(camera.address), strict=False))
    camera.close()
    assert camera.connections == 1
    unreadable = [frame.source for _, frame in frames if frame.image is None]
    assert unreadable == ([] if damage == "nothing" else [f"{camera.address}#10"])
    stamps = [frame.stamp_ns for _, frame in frames]
    assert stamps == sorted(set(stamps))


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def test_what_was_given_up_leaves_neither_threads_nor_files(network_camera):
    camera = network_camera(*[(5, 0.0)] * 8, (1000, 0.0))
    threads, files = threading.active_count(), open_files()
    source = open_source(camera.address, timeout_s=0.5)
    for number, _ in enumerate(source):
        if number == 50:
            break
    source.stop()
    assert camera.connections == 9
    camera.close()
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline and (
        threading.active_count() > threads or open_files() > files
    ):
        time.sleep(0.05)
    # The camera's own listening socket is closed, too.
    assert threading.active_count() <= threads
    assert open_files() <= files


def test_a_camera_that_is_gone_is_given_up_after_bounded_attempts(network_camera, caplog):
    camera = network_camera((10, 0.0))
    begin = time.monotonic()
    seen = []
    with pytest.raises(SourceError, match=f"and again {len(PAUSES_S)} times"):
        seen.extend(open_source(camera.address, timeout_s=0.5))
    assert 0 < len(seen) <= 10
    assert len(caplog.records) == len(PAUSES_S)
    assert time.monotonic() - begin < sum(PAUSES_S) + 30.0


def test_a_camera_that_never_answers_is_given_up(bundle_dir, tmp_path):
    """In a process of its own: OpenCV opens one stream at a time, and this one never is."""
    pipe = tmp_path / "camera"
    os.mkfifo(pipe)
    arguments = ["run", bundle_dir, pipe, "--timeout", "0.1"]
    done = subprocess.run(
        [sys.executable, "-c", RUN, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout) == (6, "")
    *attempts, last = done.stderr.splitlines()
    assert len(attempts) == len(PAUSES_S)
    assert last.startswith(f"cvo-edge: {pipe}: expected an answer within 0.2 s, found none, and")


def test_nobody_there_is_refused_in_the_same_way(hasty):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}/camera.mjpg"
    with pytest.raises(SourceError, match="expected a video or camera that opens"):
        open_source(address, timeout_s=1.0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_answered_within_a_second_while_a_read_blocks(
    network_camera, bundle_dir, tmp_path, number
):
    camera = network_camera((15, 120.0))
    records = tmp_path / "records.jsonl"
    arguments = ["run", bundle_dir, camera.address, "-o", records]
    process = subprocess.Popen(
        [sys.executable, "-c", RUN, *map(str, arguments)], stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline and not (records.exists() and records.stat().st_size):
        time.sleep(0.02)
    time.sleep(1.5)
    seen = len(list(read_records(records)))
    begin = time.monotonic()
    process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert time.monotonic() - begin < 1.0
    assert process.returncode == 128 + number
    assert "Traceback" not in errors
    assert len(list(read_records(records))) >= seen > 0


@pytest.mark.parametrize(
    ("mode", "options"),
    [
        ("live", {}),
        # A network's jitter, and pictures that take longer to decode.
        ("live", {"size": (1600, 1200), "gaps_s": (0.06, 0.06, 0.02, 0.1)}),
        ("latency", {"size": (1600, 1200), "gaps_s": (0.06, 0.06, 0.02, 0.1)}),
    ],
)
def test_what_lay_in_a_queue_while_the_process_was_stopped_has_no_interval(
    network_camera, bundle_dir, tmp_path, mode, options
):
    camera = network_camera((1000, 0.0), **options)
    records = tmp_path / "records.jsonl"
    arguments = ["run", bundle_dir, camera.address, "-o", records, "--mode", mode, "--threads", 1]
    process = subprocess.Popen([sys.executable, "-c", RUN, *map(str, arguments)])
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline and not (records.exists() and records.stat().st_size):
        time.sleep(0.02)
    time.sleep(1.0)
    process.send_signal(signal.SIGSTOP)
    time.sleep(3.0)
    process.send_signal(signal.SIGCONT)
    time.sleep(3.0)
    process.terminate()
    process.wait(timeout=30)
    assert camera.connections == 1
    # One frame of the camera is one number, whether it was looked at or left out.
    ages = [
        (1e-9 * (record.stamp_ns - camera.sent_ns[record.seq]), record)
        for record in read_records(records)
    ]
    old = [record for age_s, record in ages if age_s > 1.0]
    assert old
    assert {record.status for record in old} == {"degraded"}
    assert all("frame_stale" in record.reasons for record in old)
    # And they end.
    assert ages[-1][1].status == "ok"
    assert ages[-1][0] < 1.0


def test_time_in_which_the_process_was_stopped_is_no_time_waited(bundle_dir, tmp_path):
    path, records = tmp_path / "clip.avi", tmp_path / "records.jsonl"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (1280, 960))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video")
    generator = np.random.default_rng(0)
    for _ in range(150):
        small = generator.integers(0, 255, (120, 160, 3)).astype(np.uint8)
        writer.write(cv2.resize(small, (1280, 960)))
    writer.release()
    arguments = ["run", bundle_dir, path, "-o", records, "--timeout", "0.5", "--quiet"]
    process = subprocess.Popen(
        [sys.executable, "-c", RUN, *map(str, arguments)], stderr=subprocess.PIPE, text=True
    )
    for number in range(3):
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline and process.poll() is None:
            if records.exists() and records.read_bytes().count(b"\n") > 10 * number:
                break
            time.sleep(0.01)
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.8)
        process.send_signal(signal.SIGCONT)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    assert len(list(read_records(records))) == 150


def test_what_an_address_holds_cannot_forge_a_line(caplog, hasty):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}/\nfoo\x1b[31m"
    with pytest.raises(SourceError):
        open_source(address, timeout_s=1.0)
    assert caplog.records
    assert all(record.getMessage().isprintable() for record in caplog.records)


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_time_to_wait_must_be_one(timeout_s, tmp_path):
    with pytest.raises(UsageError, match="timeout"):
        open_source(str(tmp_path), timeout_s=timeout_s)


def test_camera_is_what_a_pipe_and_an_address_are(network_camera):
    camera = network_camera((1000, 0.0))
    assert isinstance(open_source(camera.address), Camera)


def test_a_password_is_in_no_record_and_no_message(network_camera, caplog, hasty):
    camera = network_camera((5, 0.0))
    address = camera.address.replace("//", "//user:secret@")
    seen = []
    with pytest.raises(SourceError) as caught:
        seen.extend(open_source(address, timeout_s=0.3))
    assert seen
    assert all(frame.source.startswith(camera.address) for frame in seen)
    said = [str(caught.value), *(record.getMessage() for record in caplog.records)]
    assert not any("secret" in text for text in said)


def test_an_address_of_single_pictures_is_no_camera(network_camera, hasty):
    camera = network_camera(*[(1, 0.0)] * 100)
    with pytest.raises(SourceError, match=f"and again {len(PAUSES_S)} times"):
        list(open_source(camera.address, timeout_s=0.5))
    assert camera.connections <= 1 + len(PAUSES_S)


def test_stop_ends_the_wait_for_a_camera_that_does_not_open(tmp_path):
    script = """
import os, sys, threading, time
from cvo_edge.input.sources import Camera
import cvo_edge.input.sources as sources

camera = Camera.__new__(Camera)
threading.Timer(1.0, lambda: camera.stop()).start()
begin = time.monotonic()
camera.__init__(sys.argv[1], None, 10.0)
print(time.monotonic() - begin < 3.0, flush=True)
os._exit(0)
"""
    os.mkfifo(tmp_path / "camera")
    done = subprocess.run(
        [sys.executable, "-c", script, tmp_path / "camera"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stdout == "True\n", done.stderr


def test_bench_connects_once(network_camera, bundle_dir):
    camera = network_camera((10_000, 0.0))
    arguments = ["bench", bundle_dir, camera.address, "--frames", 5, "--warmup", 1]
    done = subprocess.run(
        [sys.executable, "-c", RUN, *map(str, arguments), "--mode", "live"],
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, camera.connections) == (0, 1)


@pytest.mark.parametrize(
    ("gaps", "queued"),
    [
        # thirty a second, one pause of which 3 lie ready, and then it goes on: told after a while
        ([0.03] * 30 + [3.0] + [0.001] * 3 + [0.03] * 20, [0] * 30 + [1] * 18 + [0] * 6),
        # all of the pause lies ready: told as soon as it is made up for
        ([0.03] * 30 + [3.0] + [0.001] * 125, [0] * 30 + [1] * 115 + [0] * 11),
        # two pauses of less than a second each
        ([0.03] * 30 + [0.9, 0.001, 0.9] + [0.001] * 99, [0] * 32 + [1] * 67 + [0] * 33),
        # it took long to open: what came meanwhile may lie there
        ([4.0] + [0.034] * 20, [1] * 16 + [0] * 5),
        # it is a camera of one frame every two seconds
        ([2.0] * 20, [1] * 4 + [0] * 16),
    ],
)
def test_what_comes_sooner_than_usual_after_a_pause_is_old(gaps, queued):
    arrivals, now, found = Arrivals(0.0, 30.0), 0.0, []
    for gap in gaps:
        now += gap
        found.append(arrivals.queued_s(now))
    assert [int(age > 0) for age in found] == queued
    assert all(age == 0.0 or age > 1.0 for age in found)


def ages(period, jitter, decoding, pauses, room, generator):
    """(age, what is said of it) of frames that are read one after the other; pauses by number."""
    made = np.cumsum(period * generator.choice(jitter, 3000))
    arrivals, now, taken, queue, found = Arrivals(0.0, 1.0 / period), 0.0, 0, deque(), []
    while taken < len(made) or queue:
        while taken < len(made) and made[taken] <= now:
            # A full queue loses what is new.
            if len(queue) < room:
                queue.append(made[taken])
            taken += 1
        if queue:
            now += decoding * period * generator.choice([1.0, 1.0, 1.0, 1.5])
            found.append((now - queue.popleft(), arrivals.queued_s(now)))
            now += pauses.get(len(found), 0.0)
        else:
            now = made[taken]
    return found


PAUSES = (
    {100: 1.5},
    {100: 5.0},
    {100: 3.0, 101: 3.0},
    {100: 3.0, 110: 3.0},
    {100: 5.0, 101: 1.2},
    {100: 2.0, 101: 2.0, 102: 2.0},
    {100: 0.95, 101: 0.95, 102: 0.95, 103: 0.95, 104: 0.95},
)


@pytest.mark.parametrize("pauses", PAUSES)
@pytest.mark.parametrize("jitter", [[1.0], [0.8, 1.0, 1.2], [0.25, 1.0, 1.0, 1.75]])
@pytest.mark.parametrize("period", [1 / 60, 1 / 30, 0.1])
def test_no_frame_of_a_camera_with_a_queue_is_old_and_unsaid(period, pauses, jitter):
    for decoding, room, seed in itertools.product([0.02, 0.3, 0.6], [4, 60, 10**6], range(3)):
        found = ages(period, jitter, decoding, pauses, room, np.random.default_rng(seed))
        assert all(said > 1.0 for age, said in found if age > 1.0)
        # And what is new is believed again, soon.
        assert sum(said > 0.0 and age < 0.3 for age, said in found) < 100
        assert not any(said for _, said in found[-100:])


@pytest.mark.parametrize("jitter", [[1.0], [0.9, 1.0, 1.1]])
def test_a_camera_that_turns_slow_or_fast_is_believed_again(jitter):
    arrivals, now, generator = Arrivals(0.0, 30.0), 0.0, np.random.default_rng(0)
    for period in (0.03, 2.0, 0.03, 0.5, 0.02, 0.07, 0.03, 0.3):
        said = []
        for factor in generator.choice(jitter, 300):
            now += factor * period
            said.append(arrivals.queued_s(now))
        assert sum(age > 0.0 for age in said) < 20
        assert not any(said[20:])


@pytest.mark.parametrize("period", [0.2, 0.5, 1.0, 2.0, 5.0])
def test_a_slow_camera_is_believed_after_a_few_frames(period):
    for seed in range(20):
        arrivals, now, said = Arrivals(0.0, 30.0), 0.1, []
        for factor in 1.0 + 0.02 * np.random.default_rng(seed).standard_normal(200):
            said.append(arrivals.queued_s(now))
            now += factor * period
        assert sum(age > 0.0 for age in said) < 8


@pytest.mark.parametrize("address", ["http://u:secret@h/x", "rtsp://u:se@secret@h:1/x@y"])
def test_a_password_is_not_shown(address):
    assert "secret" not in shown(address)
    assert shown(address).startswith(address.split(":")[0] + "://h")
