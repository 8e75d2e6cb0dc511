"""Pipes: every frame, the same pixels, and the end told from an interruption."""

import os
import subprocess
import sys
import threading
from contextlib import contextmanager, suppress

import cv2
import numpy as np
import pytest

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.input.decoding import decode_image
from cvo_edge.input.half import halve
from cvo_edge.input.image_row import ImageRow
from cvo_edge.input.pieces import Pieces
from cvo_edge.input.pipes import PipedImages, PipedVideo
from cvo_edge.input.sources import open_source

FRAMES = 8


def picture(value):
    image = np.random.default_rng(value).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    return cv2.GaussianBlur(image, (0, 0), 2)


def encoded(suffix):
    return [cv2.imencode(suffix, picture(value))[1].tobytes() for value in range(FRAMES)]


def y4m():
    frames = [cv2.cvtColor(picture(v), cv2.COLOR_BGR2YUV_I420).tobytes() for v in range(FRAMES)]
    return b"YUV4MPEG2 W64 H48 F20:1 C420jpeg\n" + b"".join(b"FRAME\n" + each for each in frames)


def written(tmp_path, name, codec):
    path = tmp_path / name
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 20.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV does not write it")
    for value in range(FRAMES):
        writer.write(picture(value))
    writer.release()
    return path.read_bytes()


def part(image):
    return b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(image) + image


CONTENT = {
    "jpegs": lambda _: b"".join(encoded(".jpg")),
    "pngs": lambda _: b"".join(encoded(".png")),
    "parts": lambda _: b"\r\n".join(map(part, encoded(".jpg"))) + b"\r\n--frame--\r\n",
    "padded": lambda _: b"".join(image + bytes(37) for image in encoded(".jpg")),
    "y4m": lambda _: y4m(),
    "mkv": lambda folder: written(folder, "a.mkv", "MJPG"),
    "avi": lambda folder: written(folder, "a.avi", "MJPG"),
}


@contextmanager
def piped(tmp_path, content):
    """A named pipe that a thread fills."""
    path = tmp_path / "pipe"
    os.mkfifo(path)

    def fill():
        with suppress(BrokenPipeError), path.open("wb") as stream:
            stream.write(content)

    writer = threading.Thread(target=fill)
    writer.start()
    try:
        yield path
    finally:
        writer.join()


@contextmanager
def standard_input(descriptor):
    before = os.dup(0)
    os.dup2(descriptor, 0)
    try:
        yield
    finally:
        os.dup2(before, 0)
        os.close(before)


def fed(content):
    """Standard input with a few bytes."""
    reader, writer = os.pipe()
    os.write(writer, content)
    os.close(writer)
    return standard_input(reader)


@pytest.mark.parametrize("kind", ["jpegs", "parts", "pngs", "y4m"])
def test_jpegs_in_a_row_are_halved_and_nothing_else_is(tmp_path, kind):
    with piped(tmp_path, CONTENT[kind](tmp_path)) as path:
        frames = open_source(path)
        if kind in ("pngs", "y4m"):
            with pytest.raises(UsageError, match="expected JPEG files, or a pipe of JPEG images"):
                halve(frames)
            list(frames)
            return
        halve(frames)
        for frame, image in zip(frames, encoded(".jpg"), strict=True):
            np.testing.assert_array_equal(frame.image, decode_image(image, decode="half"))


@pytest.mark.parametrize("kind", CONTENT)
def test_every_frame_comes_and_a_cut_is_told_after_the_whole_ones(tmp_path, kind):
    content = CONTENT[kind](tmp_path)
    with piped(tmp_path, content) as path:
        frames = list(open_source(path))
    assert [frame.source for frame in frames] == [f"{path}#{n}" for n in range(FRAMES)]
    assert {frame.image.shape for frame in frames} == {(48, 64, 3)}
    if "jpg" in kind or "png" in kind:
        images = encoded(".png" if kind == "pngs" else ".jpg")
        assert all((f.image == decode_image(i)).all() for f, i in zip(frames, images, strict=True))
    path.unlink()
    seen = []
    with piped(tmp_path, content[: len(content) * 3 // 5]) as path:
        source = open_source(path)
        with pytest.raises(SourceError, match=r"ended (within a frame, after \d|early: \d of 8)"):
            seen.extend(source)
    if kind != "avi":  # nothing tells that its last picture is damaged
        assert 1 < len(seen) < FRAMES
        assert all((a.image == b.image).all() for a, b in zip(seen, frames, strict=False))


def test_a_damaged_image_of_a_row_affects_no_other(tmp_path):
    images = encoded(".jpg")
    images[2] = images[2][: len(images[2]) // 2]
    images[4] = images[4].replace(b"\xff\xc4", b"\x00\xc4", 1)
    images[FRAMES - 1] = images[FRAMES - 1][:20] + b"\xff\xd9"
    with piped(tmp_path, b"".join(images)) as path:
        frames = list(open_source(path, fps=20))
    assert [n for n, frame in enumerate(frames) if frame.image is None] == [2, 4, FRAMES - 1]
    assert [frame.stamp_ns for frame in frames] == [50_000_000 * n for n in range(FRAMES)]


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_images_do_not_depend_on_the_pieces_in_which_they_come(suffix):
    images = encoded(suffix)[:3]
    content = b"\0\0" + b"ab".join(images) + b"\xff"
    row = ImageRow()
    found = [image for at in range(len(content)) for image in row.feed(content[at : at + 1])]
    assert found == images == list(ImageRow().feed(content))
    assert not row.torn


MP4 = (
    b"\0\0\0\x10ftypisom\0\0\0\0",
    b"\0\0\0\x0cmoov\0\0\0\0",
    b"\0\0\0\1mdat\0\0\0\0\0\0\0\x18" + bytes(8),
)
MATROSKA = (
    b"\x1a\x45\xdf\xa3\x82ab",
    b"\x18\x53\x80\x67\x01\xff\xff\xff\xff\xff\xff\xff\x15\x49\xa9\x66\x81a",
    b"\x1f\x43\xb6\x75\xff\xe7\x81a",
    b"\xa3\x40\x02ab",
)
Y4M = (b"YUV4MPEG2 W3 H3 F1:1 C422p10\n", b"FRAME X\n" + bytes(2 * (9 + 12)))
PACKETS = (b"G" + bytes(187),) * 3


@pytest.mark.parametrize("pieces", [MP4, MATROSKA, Y4M, PACKETS])
def test_a_container_is_whole_between_its_pieces_alone(pieces):
    content = b"".join(pieces)
    ends = {sum(map(len, pieces[:count])) for count in range(1, len(pieces) + 1)}
    followed, at_once = Pieces(content), []
    for at in range(len(content)):
        followed.feed(content[at : at + 1])
        other = Pieces(content)
        other.feed(content[: at + 1])
        assert other.torn == followed.torn
        at_once.append(at + 1) if not followed.torn else None
    assert ends <= set(at_once)
    # Within a Segment of Matroska, elements are pieces, too.
    assert len(set(at_once) - ends) <= (2 if pieces is MATROSKA else 0)


def test_standard_input_is_what_comes_through_it_and_a_file_is_read_as_such(tmp_path):
    with fed(b"".join(encoded(".jpg"))):
        source = open_source("-")
        assert isinstance(source, PipedImages)
        assert [frame.source for frame in source] == [f"standard input#{n}" for n in range(FRAMES)]
    written(tmp_path, "a.mp4", "mp4v")
    with (tmp_path / "a.mp4").open() as stream, standard_input(stream.fileno()):
        for name in ("-", "/dev/stdin"):
            assert [frame.source for frame in open_source(name)][-1] == f"a.mp4#{FRAMES - 1}"


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "expected images or a video, found no bytes"),
        (b"1 2 3\n" * 20, r"found text$"),
        (bytes(range(256)), r"found another kind of file$"),
        (b"GIF89a" + bytes(90), r"found another kind of file$"),
        (b"".join(MP4[:1] + MP4[2:]), "found an MP4 file with its index at the end"),
        (b"\x1a\x45\xdf\xa3" + bytes(90), "did not open as a video or camera"),
    ],
)
def test_what_is_no_recording_is_refused(content, found):
    with fed(content), pytest.raises(SourceError, match=found) as refused:
        list(open_source("-"))
    assert str(refused.value).startswith("standard input: ")


@pytest.mark.parametrize("kind", ["jpegs", "y4m"])
def test_a_camera_s_frames_are_stamped_as_they_arrive_and_its_wait_can_be_stopped(tmp_path, kind):
    hold = threading.Event()
    reader, writer = os.pipe()
    content = CONTENT[kind](tmp_path)
    threading.Thread(target=os.write, args=(writer, content)).start()
    source = open_source(f"/dev/fd/{reader}", timeout_s=600.0, live=True)
    assert isinstance(source, PipedImages | PipedVideo)
    assert source.live
    seen = []

    def stop():
        hold.wait()
        source.stop()

    thread = threading.Thread(target=stop)
    thread.start()
    with suppress(SourceError):
        for frame in source:
            seen.append(frame)
            # A decoder may hold the last one back.
            if len(seen) == FRAMES - 1:
                hold.set()
    thread.join()
    os.close(writer)
    os.close(reader)
    assert len(seen) >= FRAMES - 1
    assert all(frame.stamp_ns > 10**18 and frame.arrived_s is not None for frame in seen)


def test_the_command_reads_standard_input_to_its_end(bundle_dir, clip_dir):
    images = [path.read_bytes() for path in sorted(clip_dir.glob("*.color.jpg"))[:3]]
    arguments = [sys.executable, "-m", "cvo_edge", "run", bundle_dir, "-", "--quiet"]
    done = subprocess.run(arguments, input=b"".join(images), capture_output=True, check=False)
    assert (done.returncode, done.stdout.count(b'"seq"'), done.stderr) == (0, 3, b"")
    cut = b"".join(images)[:-9]
    done = subprocess.run(arguments, input=cut, capture_output=True, check=False)
    assert (done.returncode, done.stdout.count(b'"seq"')) == (6, 2)
    assert done.stderr.startswith(b"cvo-edge: standard input: ended within a frame, after 2 whole")
