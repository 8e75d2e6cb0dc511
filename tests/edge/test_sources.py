"""Sources: order, damaged frames, ends and stamps."""

import contextlib
import gc
import os
import re
import struct
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.files import natural_key, natural_text
from cvo_edge.input.capture import READER, Capture
from cvo_edge.input.containers import is_video
from cvo_edge.input.decoding import decode_image
from cvo_edge.input.image_files import colour_images, left_out_text
from cvo_edge.input.sources import open_source
from cvo_edge.input.videos import Video, VideoStamps


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
    assert names(open_source(tmp_path)) == names(open_source(str(tmp_path)))


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
def test_a_missing_source_is_refused(text):
    with pytest.raises(SourceError, match="/no/such"):
        open_source(text)


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(SourceError, match="expected images, found none"):
        open_source(str(tmp_path))


@pytest.mark.parametrize("fps", [0.0, -1.0, 1e-12, 5e-324, 1e9, float("nan"), float("inf")])
def test_fps_must_be_of_a_camera(tmp_path, fps):
    with pytest.raises(UsageError, match="fps"):
        open_source(str(tmp_path), fps)


def test_hidden_files_are_no_frames(tmp_path):
    write(tmp_path / "0.png")
    # macOS writes such a companion file for each file on a card.
    (tmp_path / "._0.png").write_bytes(b"\0\5\x16\7")
    assert names(open_source(str(tmp_path))) == ["0.png"]


@pytest.mark.parametrize(
    ("files", "used", "left_out"),
    [
        ("1-color.png 1-depth.png 2-color.png 2-depth.png", [0, 2], {"marked depth": 2}),
        ("f.color.jpg f.depth.png f.jpg", [0], {"marked depth": 1, "not marked as colour": 1}),
        ("rgb0001.png ir0001.png", [0], {"marked ir": 1}),
        ("RGBImage1.png DepthImage1.png left_RGB_2.png", [0, 2], {"marked depth": 1}),
        ("0001.png 0001_mask.png 0001.normals.png", [0], {"marked mask": 1, "marked normals": 1}),
        ("colour_1.png 1_disp.png 2_rgb_depth.png", [0], {"marked depth": 1, "marked disp": 1}),
        # Marks are whole words.
        ("first.png masked.png depths.png normalised.png bird.png", [0, 1, 2, 3, 4], {}),
    ],
)
def test_marks_in_names_decide_which_images_of_a_folder_are_used(tmp_path, files, used, left_out):
    for file in files.split():
        write(tmp_path / file)
    expected = [files.split()[number] for number in used]
    for source in (open_source(str(tmp_path)), open_source(f"{tmp_path}/*")):
        assert sorted(names(source)) == sorted(expected)
        assert source.left_out == left_out


def test_a_folder_without_colour_images_says_what_it_left_out(tmp_path):
    write(tmp_path / "1-depth.png")
    write(tmp_path / "2-mask.png")
    with pytest.raises(SourceError) as refused:
        open_source(str(tmp_path))
    assert str(refused.value) == (
        f"{tmp_path}: expected images, found none; left out 2 files: marked depth 1, marked mask 1"
    )
    assert names(open_source(str(tmp_path / "1-depth.png"))) == ["1-depth.png"]


def test_what_a_folder_holds_beside_its_images_is_counted_and_a_dangling_link_is_a_frame(tmp_path):
    """Also a link to itself; a link to an image is that image. Hidden files are not counted."""
    write(tmp_path / "1.jpg")
    for name in ("1.heic", "2.HEIC", "list.txt", "README", ".hidden.heic", "odd\n.x\ny"):
        (tmp_path / name).write_bytes(b"?")
    (tmp_path / "3.png").symlink_to("1.jpg")
    (tmp_path / "4.png").symlink_to("nowhere.png")
    (tmp_path / "5.png").symlink_to("5.png")
    (tmp_path / "6.png").mkdir()
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "7.png")
    source = open_source(tmp_path)
    assert [(frame.source, frame.image is None) for frame in source] == [
        ("1.jpg", False),
        ("3.png", False),
        ("4.png", True),
        ("5.png", True),
    ]
    assert left_out_text(source.left_out) == (
        "6 files: .heic 2, .x\\ny 1, a folder 1, no regular file 1, without suffix 1"
    )


def test_the_order_of_a_folder_is_natural_and_does_not_depend_on_that_of_its_entries(tmp_path):
    texts = ("a1", "a01", "a2", "a10", "a1b2", "a1b10", "b", "a", "1", "02", "a1-", "a-1", "\u00b2")
    shuffled = np.random.default_rng(0).permutation(texts).tolist()
    assert sorted(shuffled, key=natural_text) == sorted(
        shuffled, key=lambda s: natural_key(Path(s))
    )
    assert colour_images([f"{text}.png" for text in shuffled]) == colour_images(
        [f"{text}.png" for text in texts]
    )


@pytest.mark.parametrize("name", ["a.jpe", "a.jfif", "a", "a.pbm", "a.mp4"])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".ppm"])
def test_one_image_is_an_image_whatever_its_name(tmp_path, name, suffix):
    path = tmp_path / name
    content = cv2.imencode(suffix, picture(7))[1].tobytes()
    path.write_bytes(content)
    (whole,) = open_source(str(path))
    assert whole.image.shape == (48, 64, 3)
    path.write_bytes(content[:-3])
    (cut,) = open_source(str(path))
    assert cut.image is None


@pytest.mark.parametrize("scheme", ["file", "FILE", "crypto+file", "cache:file", "subfile,,"])
def test_a_file_s_address_is_no_camera(tmp_path, scheme):
    write(tmp_path / "0.png")
    with pytest.raises(SourceError, match="expected a file's path"):
        open_source(f"{scheme}://{tmp_path}/0.png")


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
    assert seen
    assert all(frame.image is not None for frame in seen)


@pytest.mark.parametrize("damaged", [[7], [0], [3, 4, 5], [0, 1, 9]])
def test_a_damaged_frame_of_a_video_affects_no_other(video, damaged):
    """It yields no image; later frames keep their pixels, names and stamps."""
    whole = list(open_source(str(video)))
    content = bytearray(video.read_bytes())
    starts = [found.start() for found in re.finditer(rb"00dc.{4}\xff\xd8", content, re.DOTALL)]
    assert len(starts) == 20
    for seq in damaged:
        begin, end = starts[seq] + 8, starts[seq + 1]
        content[begin:end] = bytes(end - begin)
    video.write_bytes(content)
    frames = list(open_source(str(video)))
    assert [frame.source for frame in frames] == [frame.source for frame in whole]
    assert [frame.stamp_ns for frame in frames] == [frame.stamp_ns for frame in whole]
    assert [seq for seq, frame in enumerate(frames) if frame.image is None] == damaged
    for seq in set(range(20)) - set(damaged):
        assert np.array_equal(frames[seq].image, whole[seq].image)


def test_the_threads_of_a_decoder_are_limited(tmp_path):
    path = tmp_path / "a.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (64, 48))
    for value in range(3):
        writer.write(picture(value))
    writer.release()
    tasks = Path("/proc/self/task")
    if not tasks.is_dir():
        pytest.skip("threads are counted in /proc")
    before = len(list(tasks.iterdir()))
    frames = iter(open_source(path, threads=1))
    next(frames)
    assert len(list(tasks.iterdir())) <= before + 1, "a reader, and no thread of a decoder"
    frames.close()


def test_a_video_without_an_end_in_sight_ends(video):
    """A container that announces more frames than it holds is read a bounded number of times."""
    content = bytearray(video.read_bytes())
    # Frame count of the file (avih), then of its stream (strh).
    announced = (20).to_bytes(4, "little")
    for place in (content.index(b"avih") + 8 + 16, content.index(b"strh") + 8 + 32):
        assert content[place : place + 4] == announced
        content[place : place + 4] = (10**9).to_bytes(4, "little")
    video.write_bytes(content)
    with pytest.raises(SourceError, match=r"ended early: 20 of 1000000000"):
        list(open_source(str(video)))


def test_stamps_are_the_container_s_times():
    """Includes frames of unequal length, and an OpenCV that reports the frame's end."""
    for shift_ms in (0.0, 40.0):
        stamps = VideoStamps(None, 25.0)
        found = [stamps.next(1, shift_ms + place) for place in (0.0, 40.0, 90.0, 120.0)]
        assert found == [[0], [40_000_000], [90_000_000], [120_000_000]]
        # Two unreadable frames are interpolated.
        assert stamps.next(3, shift_ms + 240.0) == [160_000_000, 200_000_000, 240_000_000]


def test_a_missing_position_shifts_only_its_own_stamp():
    places = [0.0, 16.7, 33.3, 0.0, 66.7, 83.3, float("nan"), 133.3]
    stamps = VideoStamps(None, 30.0)
    found = [1e-6 * stamps.next(1, place)[0] for place in places]
    assert found == sorted(set(found))
    assert [found[k] for k in (0, 1, 2, 4, 5, 7)] == pytest.approx(
        [0, 16.7, 33.3, 66.7, 83.3, 133.3]
    )


@pytest.mark.parametrize("place", [0.0, -1.0, float("nan"), float("inf"), 1e300])
def test_a_container_without_times_has_those_of_its_frame_rate(place):
    stamps = VideoStamps(None, 25.0)
    assert [stamps.next(1, place) for _ in range(3)] == [[0], [40_000_000], [80_000_000]]
    assert stamps.next(2, place) == [120_000_000, 160_000_000]


@pytest.mark.parametrize("rate", [0.0, -1.0, 2.3e-10, 1e9, float("nan"), float("inf")])
def test_an_impossible_rate_gives_no_stamps(rate):
    assert VideoStamps(None, rate).next(2, 40.0) == [None, None]


def test_a_given_rate_is_taken_whatever_the_container_says():
    stamps = VideoStamps(10.0, 25.0)
    assert [stamps.next(1, 40.0 * seq) for seq in range(3)] == [[0], [100_000_000], [200_000_000]]


def test_a_program_that_has_read_a_video_ends_as_it_wants_to(video):
    """If Python ended a thread inside OpenCV, the process would abort."""
    script = (
        "import sys; from cvo_edge import open_source; print(len(list(open_source(sys.argv[1]))))"
    )
    for _ in range(5):
        done = subprocess.run(
            [sys.executable, "-c", script, video], capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stdout) == (0, "20\n"), done.stderr


NUMBERS = b"1.5 0.25 -3.75 0 0 0 1\n" * 40
TRAJECTORY = b"# timestamp tx ty tz qx qy qz qw\n1305031098.6659 1.35 0.63 1.64 0.6 0.6 -0.3 -0.3\n"


@pytest.mark.parametrize(
    ("name", "content", "found"),
    [
        ("a.txt", NUMBERS, "text"),
        ("groundtruth.txt", TRAJECTORY, "text"),
        ("a.ans", b"\x1b[31mred\x1b[0m\n" * 20, "text"),
        ("a.txt", b"GG" * 4000, "text"),
        ("a.txt", b"1234ftypisom" + NUMBERS, "text"),
        ("a.txt", "1 2 3".encode("utf-16"), "text"),
        ("list.mp4", b"ffconcat version 1.0\nfile clip.avi\n", "text"),
        ("list.m3u8", b"#EXTM3U\n#EXTINF:1,\nclip.avi\n#EXT-X-ENDLIST\n", "text"),
        ("a.gif", b"GIF89a" + bytes(32), "another kind of file"),
        ("a.heic", b"\0\0\0\x18ftypheic" + bytes(32), "another kind of file"),
        ("a.ico", b"\0\0\1\0\1\0" + bytes(32), "another kind of file"),
        ("a.wav", b"RIFF\x24\0\0\0WAVEfmt " + bytes(32), "another kind of file"),
        ("a.ts", b"G" + bytes(187) + b"X" + bytes(187) + b"G" + bytes(187), "another kind of file"),
        ("empty.avi", b"", "an empty file"),
    ],
)
def test_what_is_no_video_of_a_camera_is_refused(tmp_path, video, name, content, found):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(SourceError) as refused:
        open_source(str(path))
    assert str(refused.value) == (
        f"{path}: expected images or a video (MP4, MOV, MKV, WebM, AVI, MPEG, FLV, WMV, Ogg, MXF, "
        f"DV, IVF, Y4M, H.264, H.265, MJPEG), found {found}"
    )


@pytest.mark.parametrize(
    "start",
    [
        b"\0\0\0\x20ftypisom",
        b"\0\0\0\x14ftypqt  ",
        b"\0\0\0\x08wide\0\1\0\0mdat",
        b"\x7f\0\1\0mdat",
        b"\x1a\x45\xdf\xa3\x9f\x42\x86\x81\1",
        b"RIFF\0\1\0\0AVI LIST",
        b"FLV\1\5\0\0\0\x09",
        b"OggS\0\2",
        b"G\x40\0\x10" + bytes(184) + b"G\1\0\x10" + bytes(184) + b"G\1\0\x11" + bytes(184),
        (bytes(4) + b"G\x40" + bytes(186)) * 3,
        b"\0\0\1\xba\x44\0\4",
        b"\0\0\1\xb3\x14\0\xf0",
        b"\0\0\0\1\x67\x42\0\x1f",
        b"\0\0\1\x09\xf0\0\0\1\x67",
        b"\0\0\0\1\x40\1\x0c\1",
        b"YUV4MPEG2 W64 H48 F30:1\nFRAME\n",
        b"DKIF\0\0\x20\0VP80",
        b"\xff\xd8\xff\xe0\0\x10JFIF\0",
    ],
)
def test_containers_and_streams_of_cameras_are_known_by_their_start(start):
    assert is_video(start)
    assert not is_video(b" " + start)


@pytest.mark.parametrize(
    ("suffix", "codec"), [("mp4", "mp4v"), ("mov", "mp4v"), ("mkv", "MJPG"), ("webm", "VP80")]
)
def test_videos_of_other_containers_are_read(tmp_path, suffix, codec):
    path = tmp_path / f"clip.{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 20.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV does not write it")
    for value in range(3):
        writer.write(picture(value))
    writer.release()
    assert [frame.image.shape for frame in open_source(str(path))] == [(48, 64, 3)] * 3


def test_a_video_with_a_rotation_tag_is_read_in_the_sensor_s_order(tmp_path):
    path = tmp_path / "clip.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 20.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV does not write it")
    for value in range(3):
        writer.write(picture(value))
    writer.release()
    upright = [frame.image for frame in open_source(path)]
    content = bytearray(path.read_bytes())
    # The matrix of a track's header, in 16.16 and 2.30 fixed point: a quarter turn.
    at = content.index(b"tkhd") + 44
    content[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    # OpenCV alone turns it.
    assert cv2.VideoCapture(str(path)).read()[1].shape == (64, 48, 3)
    turned = [frame.image for frame in open_source(path)]
    assert [(one == other).all() for one, other in zip(upright, turned, strict=True)] == [True] * 3


def test_text_that_comes_through_a_pipe_is_refused(tmp_path):
    path = tmp_path / "a.txt"
    os.mkfifo(path)

    def write_text() -> None:
        # More than a pipe holds: its reader may have seen enough, and hung up, before the rest.
        with contextlib.suppress(BrokenPipeError):
            path.write_bytes(NUMBERS * 100)

    writer = threading.Thread(target=write_text)
    writer.start()
    with pytest.raises(SourceError, match=r"a.txt: expected a video or camera, found text$"):
        Capture(str(path), 30.0).open()
    writer.join()


def test_a_camera_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setattr("cvo_edge.input.sources.PAUSES_S", (0.0,))
    if Path("/dev/video63").exists():
        pytest.skip("this machine has 64 cameras")
    with pytest.raises(SourceError, match="63"):
        open_source("63")
    with pytest.raises(SourceError, match="63"):
        open_source(63)


@pytest.mark.parametrize("source", [1.5, None, b"frames"])
def test_what_is_neither_path_nor_index_is_refused(source):
    with pytest.raises(UsageError, match="source: expected a path, an address or a camera index"):
        open_source(source)


def test_a_file_of_any_kind_and_size_affects_its_own_frame_only(tmp_path):
    write(tmp_path / "0.png")
    with (tmp_path / "1.png").open("wb") as stream:
        stream.truncate(2 << 40)
    source = open_source(str(tmp_path))
    write(tmp_path / "2.png")
    frames = list(open_source(str(tmp_path)))
    assert [frame.image is None for frame in frames] == [False, True, False]
    # A file that was listed may have become a pipe before it is read.
    (tmp_path / "1.png").unlink()
    os.mkfifo(tmp_path / "1.png")
    assert [frame.image is None for frame in source] == [False, True]


def test_a_video_s_name_is_utf8_or_refused(tmp_path, video):
    path = os.fsencode(tmp_path) + b"/\xff.avi"
    os.rename(video, path)  # noqa: PTH104
    with pytest.raises(SourceError, match="not valid UTF-8"):
        open_source(os.fsdecode(path))


def test_a_source_that_nobody_reads_gives_its_file_back(video):
    before = set(threading.enumerate())
    for _ in range(5):
        open_source(str(video))
    gc.collect()
    for thread in set(threading.enumerate()) - before:
        if thread.name == READER:
            thread.join(120.0)
            assert not thread.is_alive()


@pytest.mark.parametrize("text", ["x" * 300, "a/" * 3000])
def test_a_name_too_long_is_refused(text):
    with pytest.raises(SourceError):
        open_source(text)
