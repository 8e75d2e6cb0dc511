"""Stamps of frames: in names and lists; what is no stamp, and what does not belong."""

import cv2
import numpy as np
import pytest

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.input.sources import open_source

S = 1_305_031_102
NS = 1_403_636_579_763_555_584


def folder_of(tmp_path, names):
    folder = tmp_path / "frames"
    folder.mkdir()
    for name in names:
        cv2.imwrite(str(folder / name), np.full((8, 8, 3), 90, np.uint8))
    return folder


def stamps_of(folder, given=None):
    return [frame.stamp_ns for frame in open_source(folder, stamps=given and str(given))]


@pytest.mark.parametrize(
    ("names", "automatic", "asked"),
    [
        ([f"{S}.175304.png", f"{S}.211214.png"], [S * 10**9 + 175304000], None),
        ([f"left-{NS}.png", f"left-{NS + 50_000_000}.png"], [NS], None),
        ([f"{NS // 1000}.png", f"{NS // 1000 + 1}.png"], [NS // 1000 * 1000], None),
        ([f"{S}123.png", f"{S}124.png"], [S * 10**9 + 123_000_000], None),
        ([f"{S}.5_rgb.png", f"{S + 1}.5_rgb.png"], [S * 10**9 + 500_000_000], None),
        (["0.25.png", "0.50.png"], [None], [250_000_000]),
        (["000001.png", "000002.png"], [None], "found 000001.png$"),
        ([f"{S}.5.png", "a.png"], [None], "found a.png$"),
        # In natural order, the digits after the point are a number.
        ([f"{S}.5.png", f"{S}.25.png"], [None], "expected each later than the one before"),
    ],
)
def test_names_that_are_stamps(tmp_path, names, automatic, asked):
    folder = folder_of(tmp_path, names)
    assert stamps_of(folder)[0] == automatic[0]
    if isinstance(asked, str):
        with pytest.raises(SourceError, match=asked):
            stamps_of(folder, "names")
    else:
        assert stamps_of(folder, "names")[0] == (asked or automatic)[0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("# a\n0.1 rgb/1.png\n0.3 rgb/2.png\n", [100_000_000, 300_000_000]),
        (
            "0.1 rgb/1.png 0.1 d/1.png\n0.3 rgb/2.png 0.3 d/2.png",
            [100_000_000, 300_000_000],
        ),
        (f"#timestamp [ns],filename\r\n{NS},1.png\r\n{NS + 5},2.png\r\n", [NS, NS + 5]),
        # KITTI counts from zero, and its images have these numbers.
        ("0\n1.0e-1\n3.5e-1\n", [100_000_000, 350_000_000]),
        ("0\n0.1\n", r"a time for each of 2 frames, numbers to 2, found 2"),
        ("0.1 rgb/1.png\n", "expected a stamp for 2.png, found none"),
        (f"{NS} rgb/1.png\n", "expected stamps in seconds, found 1403636579763555584 in line 1"),
        ("0.1 rgb/1.png\n0.1 rgb/2.png\n", "expected each later than the one before"),
        ("# a\n", "found no line"),
    ],
)
def test_lists_of_stamps(tmp_path, text, expected):
    folder = folder_of(tmp_path, ["1.png", "2.png"])
    path = tmp_path / "list.txt"
    path.write_bytes(text.encode())
    if isinstance(expected, list):
        assert stamps_of(folder, path) == expected
    else:
        with pytest.raises(SourceError, match=expected):
            stamps_of(folder, path)


def test_frames_without_numbers_take_times_in_their_order(tmp_path):
    folder = folder_of(tmp_path, ["a.png", "b.png"])
    path = tmp_path / "times.txt"
    path.write_text("0.5\n0.75\n")
    assert stamps_of(folder, path) == [500_000_000, 750_000_000]
    path.write_text("0.5\n0.75\n1\n")
    with pytest.raises(SourceError, match="expected a time for each of 2 frames, found 3"):
        stamps_of(folder, path)


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video")
    for value in (30, 90, 150):
        writer.write(np.full((48, 64, 3), value, np.uint8))
    writer.release()
    return path


def announce(video, count):
    """Change the number of frames in the header of an AVI file."""
    content = bytearray(video.read_bytes())
    for place in (content.index(b"avih") + 8 + 16, content.index(b"strh") + 8 + 32):
        content[place : place + 4] = count.to_bytes(4, "little")
    video.write_bytes(content)


SHORT = "expected a stamp for each of 3 frames, as the video announces, found"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("# s\n0.5\n7.5e-1\n1\n", [500_000_000, 750_000_000, 10**9]),
        (f"{NS},0\n{NS + 5},1\n{NS + 9},2\n{NS + 10},3\n", [NS, NS + 5, NS + 9]),
        ("0.3 2\n0.1 0\n\n0.2 1 x\n0.9 1\n", [100_000_000, 200_000_000, 300_000_000]),
        ("0.5\n0.75\n", f"{SHORT} 2; if it holds fewer, ffmpeg"),
        ("0.1 1\n0.2 2\n0.3 3\n", f"{SHORT} 3, none for frame 0; frames count from 0$"),
        ("0.5\n0.75\n0.75\n", "found 0.750000000 s for frame 1 and 0.750000000 s for frame 2"),
        ("0.1 0\n0.3 1\n0.2 2\n", "found 0.300000000 s for frame 1 and 0.200000000 s for frame 2"),
        ("0.1 rgb/1.png\n", "expected timestamp frame, found '0.1 rgb/1.png' in line 1"),
        ("0.1,0\n", r"expected timestamp \[ns\],frame, found '0.1 0' in line 1"),
        ("timestamp frame\n0.1 0\n", "put # before a line of names"),
        ("# a\n", "expected stamps of a video: .*, found no line"),
    ],
)
def test_lists_of_stamps_of_a_video(tmp_path, video, text, expected):
    path = tmp_path / "times.txt"
    path.write_text(text)
    if isinstance(expected, list):
        assert stamps_of(video, path) == expected
    else:
        with pytest.raises(SourceError, match=expected):
            open_source(video, stamps=str(path))


@pytest.mark.parametrize(
    ("announced", "text", "seen", "expected"),
    [
        (0, "0.5\n0.75\n", 2, "each of 3 frames or more, found 2$"),
        (2, "0.1 0\n0.2 1\n0.4 3\n", 2, "found 3, none for frame 2; frames count"),
        (3, "1\n2\n3\n4\n", 3, "each of 3 frames, the whole video, found 4; times of dropped"),
        (4, "1\n2\n3\n4\n", 3, "ended early: 3 of 4 frames"),
    ],
)
def test_what_a_video_does_not_announce_is_refused_after_its_frames(
    tmp_path, video, announced, text, seen, expected
):
    announce(video, announced)
    path = tmp_path / "times.txt"
    path.write_text(text)
    found = []
    with pytest.raises(SourceError, match=expected):
        found.extend(open_source(video, stamps=str(path)))
    assert len(found) == seen


def test_stamps_are_for_recordings_alone(tmp_path, video):
    with pytest.raises(UsageError, match=r"expected images or a video, .* found 0, whose frames"):
        open_source("0", stamps="times.txt")
    with pytest.raises(UsageError, match="expected a list of times for a video, found names"):
        open_source(video, stamps="names")
    with pytest.raises(UsageError, match="expected no fps beside them"):
        open_source(folder_of(tmp_path, ["1.png"]), 30.0, stamps="names")
