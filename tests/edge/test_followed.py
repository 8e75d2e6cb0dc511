"""A folder that grows: every image once, whole, in the order of its appearance."""

import os
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.input.followed import FollowedFolder
from cvo_edge.input.sources import open_source

IMAGE = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)


def content(suffix=".jpg"):
    return cv2.imencode(suffix, IMAGE)[1].tobytes()


class Scripted:
    """The simulated clock, and what happens in the folder at each look."""

    def __init__(self, clock, steps):
        self._clock, self._steps = clock, iter(steps)

    def __getattr__(self, name):
        return getattr(self._clock, name)

    def wait(self, event, timeout_s):
        next(self._steps, lambda: None)()
        return self._clock.wait(event, timeout_s)


def follow(folder, clock, steps, **options):
    return FollowedFolder(folder, None, 4.0, clock=Scripted(clock, steps), **options)


def put(folder, name, data=None):
    return lambda: (folder / name).write_bytes(content() if data is None else data)


def test_images_come_in_natural_order_and_then_as_they_appear(tmp_path, clock):
    for name in ("10.jpg", "9.jpg"):
        put(tmp_path, name)()

    def renamed():
        put(tmp_path, ".hidden")()
        (tmp_path / ".hidden").rename(tmp_path / "1.jpg")

    def several():
        for name in ("12.jpg", "3.jpg", "a.heic", "a.txt", "3-depth.png"):
            put(tmp_path, name)()

    source = follow(tmp_path, clock, [put(tmp_path, "11.jpg"), renamed, several])
    found = [(frame.source, frame.image is not None) for frame in source]
    assert found == [(f"{n}.jpg", True) for n in (9, 10, 11, 1, 3, 12)]
    assert source.left_out == {".heic": 1, "marked depth": 1}
    # It ends by the time without an image.
    assert 4.0 <= clock.now <= 4.5


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".bmp", ".ppm", ".tiff"])
def test_an_image_that_is_being_written_is_waited_for(tmp_path, clock, suffix):
    whole = content(suffix)
    cuts = (0, 3, len(whole) // 2, len(whole) - 2, len(whole))
    steps = [put(tmp_path, f"0{suffix}", whole[:cut]) for cut in cuts]
    # The next one is whole before it, and waits.
    steps.insert(3, put(tmp_path, f"1{suffix}", whole))
    frames = list(follow(tmp_path, clock, steps))
    assert [frame.source for frame in frames] == [f"0{suffix}", f"1{suffix}"]
    assert all(frame.image.shape == IMAGE.shape for frame in frames)


def test_one_that_does_not_become_whole_is_told_and_one_that_vanishes_too(tmp_path, clock):
    (tmp_path / "0.jpg").symlink_to("nowhere")
    put(tmp_path, "1.jpg", content()[:-9])()
    put(tmp_path, "2.jpg")()
    put(tmp_path, "3.jpg", b"")()
    source = follow(tmp_path, clock, [])
    seen = []
    for frame in source:
        seen.append((frame.source, frame.image is not None))
        (tmp_path / "2.jpg").unlink(missing_ok=True)
    assert seen == [("0.jpg", False), ("1.jpg", False), ("2.jpg", False), ("3.jpg", False)]


def test_a_name_that_comes_back_is_a_new_image(tmp_path, clock):
    put(tmp_path, "0.jpg")()
    steps = [(tmp_path / "0.jpg").unlink, put(tmp_path, "0.jpg")]
    assert [frame.source for frame in follow(tmp_path, clock, steps)] == ["0.jpg", "0.jpg"]


def test_a_folder_that_goes_ends_with_an_error_and_images_written_before_are_kept(tmp_path, clock):
    folder = tmp_path / "frames"
    folder.mkdir()
    put(folder, "0.jpg")()
    source = follow(folder, clock, [lambda: folder.rename(tmp_path / "other")])
    seen = []
    with pytest.raises(SourceError, match=r"frames: expected a folder to follow: No such file"):
        seen.extend(source)
    assert len(seen) == 1


def test_old_images_grow_old_where_they_are_live_and_names_give_stamps(tmp_path, clock):
    put(tmp_path, "1305031102.175304.jpg")()
    put(tmp_path, "other.jpg")()
    named, plain = follow(tmp_path, clock, [], live=True)
    assert named.stamp_ns == 1305031102175304000
    # The clock of the test is that of 2023, and files are not older than that.
    assert plain.stamp_ns == clock.time_ns() - round(1e9 * clock.now)
    assert named.arrived_s is not None
    os.utime(tmp_path / "other.jpg", (1.6e9, 1.6e9))
    (_, old) = follow(tmp_path, clock, [], live=True)
    assert old.queued_ms > 1e9


@pytest.mark.parametrize(
    ("name", "options", "error", "said"),
    [
        ("nothing", {}, SourceError, "nothing: expected a folder to follow, found none; create it"),
        ("a.jpg", {}, UsageError, "follow: expected a folder of images, found .*a.jpg"),
        (
            "",
            {"stamps": "names"},
            UsageError,
            "stamps: expected none for a folder that is followed",
        ),
    ],
)
def test_only_a_folder_is_followed(tmp_path, name, options, error, said):
    put(tmp_path, "a.jpg")()
    with pytest.raises(error, match=said):
        open_source(tmp_path / name, follow=True, **options)


def test_a_signal_ends_the_command_with_every_record(bundle_dir, clip_dir, tmp_path):
    images = [path.read_bytes() for path in sorted(clip_dir.glob("*.color.jpg"))[:2]]
    put(tmp_path, "0.jpg", images[0])()
    # A record that does not come ends the command, and fails the test.
    options = ["--follow", "--timeout", "60"]
    arguments = [sys.executable, "-m", "cvo_edge", "run", bundle_dir, tmp_path, *options]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert b'"header"' in process.stdout.readline()
        assert b'"0.jpg"' in process.stdout.readline()
        put(tmp_path, "1.jpg", images[1])()
        assert b'"1.jpg"' in process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        assert process.stdout.read() == b""
        assert process.wait(60) == 143
