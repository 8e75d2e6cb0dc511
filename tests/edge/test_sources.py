"""Sources: order, damage, ends, stamps."""

import gc
import os
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from cvo_edge.capture import READER
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.images import decode_image
from cvo_edge.sources import Video, open_source


def picture(value=0, height=48, width=64):
    image = np.random.default_rng(value).integers(0, 255, (height, width, 3)).astype(np.uint8)
    return cv2.GaussianBlur(image, (0, 0), 2)


def write(path, value=0):
    assert cv2.imwrite(str(path), picture(value))
    return path


def names(source):
    return [frame.source for frame in source]


def test_folder_is_in_natural_order(tmp_path):
    for name in ("frame-10.png", "frame-9.png", "frame-100.png"):
        write(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no image")
    assert names(open_source(str(tmp_path))) == ["frame-9.png", "frame-10.png", "frame-100.png"]


def test_names_of_any_bytes_and_odd_digits_are_read(tmp_path):
    for name in (b"a\xff.png", "1\u00b22.png".encode()):
        plain = write(tmp_path / "plain.png")
        os.rename(os.fsencode(plain), os.fsencode(tmp_path) + b"/" + name)  # noqa: PTH104
    found = names(open_source(str(tmp_path)))
    assert len(found) == 2
    assert all(name.encode("utf-8") for name in found)


def test_colour_images_alone_where_there_are_any_and_never_depth(tmp_path):
    write(tmp_path / "frame-1.depth.png")
    write(tmp_path / "other.png")
    assert names(open_source(str(tmp_path))) == ["other.png"]
    write(tmp_path / "frame-1.color.png")
    assert names(open_source(str(tmp_path))) == ["frame-1.color.png"]


def test_glob_and_single_file(tmp_path):
    for value in range(3):
        write(tmp_path / f"{value}.png", value)
    assert names(open_source(str(tmp_path / "[01].png"))) == ["0.png", "1.png"]
    assert names(open_source(str(tmp_path / "2.png"))) == ["2.png"]


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_file_cut_anywhere_is_unreadable_and_its_neighbours_are_not(tmp_path, suffix):
    for value in range(3):
        write(tmp_path / f"{value}{suffix}", value)
    middle = tmp_path / f"1{suffix}"
    whole = middle.read_bytes()
    for kept in (0, 1, 10, len(whole) // 2, len(whole) - 3):
        middle.write_bytes(whole[:kept])
        frames = list(open_source(str(tmp_path)))
        assert [frame.image is None for frame in frames] == [False, True, False], kept


def test_a_decoded_image_is_what_opencv_reads_without_exif_rotation(tmp_path):
    path = write(tmp_path / "a.png")
    np.testing.assert_array_equal(decode_image(path.read_bytes()), cv2.imread(str(path)))
    assert decode_image(b"") is None
    assert decode_image(b"\xff\xd8 no jpeg \xff\xd9") is None


def test_stamps_are_integer_nanoseconds_from_zero(tmp_path):
    for value in range(3):
        write(tmp_path / f"{value}.png", value)
    assert [frame.stamp_ns for frame in open_source(str(tmp_path), fps=30)] == [
        0,
        33_333_333,
        66_666_667,
    ]
    assert [frame.stamp_ns for frame in open_source(str(tmp_path))] == [None] * 3


@pytest.mark.parametrize("text", ["/no/such/place", "/no/such/*.png"])
def test_what_is_not_there_is_refused(text):
    with pytest.raises(SourceError, match="/no/such"):
        open_source(text)


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(SourceError, match="expected images, found none"):
        open_source(str(tmp_path))


@pytest.mark.parametrize("fps", [0.0, -1.0, 1e-12, 5e-324, 1e9, float("nan"), float("inf")])
def test_fps_must_be_of_a_camera(tmp_path, fps):
    with pytest.raises(UsageError, match="fps"):
        open_source(str(tmp_path), fps)


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video")
    for value in range(20):
        writer.write(picture(value))
    writer.release()
    return path


def test_video_frames_and_stamps(video):
    frames = list(open_source(str(video)))
    assert len(frames) == 20
    assert frames[1].stamp_ns == 50_000_000
    assert frames[0].source == "clip.avi#0"
    assert frames[0].image.shape == (48, 64, 3)


def test_a_video_cut_short_is_told_after_its_frames(video):
    content = video.read_bytes()
    video.write_bytes(content[: len(content) // 2])
    source = open_source(str(video))
    assert isinstance(source, Video)
    seen = []
    with pytest.raises(SourceError, match=r"ended early: \d+ of 20"):
        seen.extend(source)
    if not seen:
        for frame in open_source(str(video)):
            seen.append(frame)
            if len(seen) == 3:
                break
    assert seen


def test_a_text_file_is_no_video(tmp_path):
    path = tmp_path / "video.avi"
    path.write_text("not a video")
    with pytest.raises(SourceError, match="expected a video"):
        open_source(str(path))


def test_a_camera_that_is_not_there_is_refused():
    if Path("/dev/video63").exists():
        pytest.skip("this machine has 64 cameras")
    with pytest.raises(SourceError, match="63"):
        open_source("63")


def test_a_file_of_any_kind_and_size_costs_its_own_frame(tmp_path):
    write(tmp_path / "0.png")
    with (tmp_path / "1.png").open("wb") as stream:
        stream.truncate(2 << 40)
    source = open_source(str(tmp_path))
    write(tmp_path / "2.png")
    frames = list(open_source(str(tmp_path)))
    assert [frame.image is None for frame in frames] == [False, True, False]
    # What was a file when it was listed may be a pipe when it is read.
    (tmp_path / "1.png").unlink()
    os.mkfifo(tmp_path / "1.png")
    assert [frame.image is None for frame in source] == [False, True]


def test_a_video_s_name_is_utf8_or_refused(tmp_path, video):
    path = os.fsencode(tmp_path) + b"/\xff.avi"
    os.rename(video, path)  # noqa: PTH104
    with pytest.raises(SourceError, match="expected a name in UTF-8"):
        open_source(os.fsdecode(path))


def test_a_source_that_nobody_reads_gives_its_file_back(video):
    def threads():
        return [thread for thread in threading.enumerate() if thread.name == READER]

    before = len(threads())
    for _ in range(5):
        open_source(str(video))
    gc.collect()
    deadline = time.monotonic() + 10.0
    while len(threads()) > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert len(threads()) == before


@pytest.mark.parametrize("text", ["x" * 300, "a/" * 3000])
def test_a_name_too_long_is_no_source(text):
    with pytest.raises(SourceError):
        open_source(text)
