"""Common behaviour of the readers, and the description of a data set."""

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from cvo_edge.errors import SourceError
from cvo_edge.trajectories.poses import quaternion_pose
from cvo_edge.trajectories.tables import read_rows
from cvo_export.calibrate import calibrate
from cvo_export.datasets import base, open_dataset
from cvo_export.datasets.base import Intrinsics, PoseDataset, remembered
from cvo_export.datasets.describe import describe, summary
from cvo_export.datasets.frames import FrameList
from cvo_export.datasets.sizes import image_sizes, one_size
from cvo_export.training.run import open_run

from .conftest import tiny_config

IDENTITY = np.array([0, 0, 0, 0, 0, 0, 1.0])


def tum_sequence(folder):
    """Write three frames: one complete, one without an image, one without a pose."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "rgb.txt").write_text("1.0 rgb/1.png\n2.0 rgb/2.png\n3.0 rgb/3.png\n")
    (folder / "groundtruth.txt").write_text("1.0 0.5 0 -1 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    cv2.imwrite(str(folder / "rgb" / "1.png"), np.zeros((48, 64, 3), np.uint8))
    return folder


def cvo_export(*arguments):
    command = [sys.executable, "-c", "from cvo_export.cli import main; main()", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_summary_says_what_was_left_out_and_why(tmp_path):
    found = open_dataset(f"tum:{tum_sequence(tmp_path / 'desk')}")
    assert summary(found) == (
        "desk        1 frame in 1 sequence; skipped 2: image missing 1, no pose within 0.02 s 1"
    )
    whole = open_dataset("synthetic:room,flights=2,frames=3,size=64x48")
    assert summary(whole) == "synthetic-room 6 frames in 2 sequences; none skipped"


def test_the_command_describes_a_data_set(tmp_path):
    folder = tum_sequence(tmp_path / "desk")
    told = cvo_export("dataset", f"tum:{folder}")
    assert (told.returncode, told.stderr) == (0, "")
    few = "expected frames for every role, found none for"
    assert told.stdout.splitlines() == [
        "desk        1 frame in 1 sequence; skipped 2: image missing 1, no pose within 0.02 s 1",
        "image       64 x 48 px",
        "camera      not stated",
        "positions   x 0.50 .. 0.50, y 0.00 .. 0.00, z -1.00 .. -1.00 m",
        "time        one stamp only",
        "agreement   not compared with the poses: too few points can be followed from frame to "
        "frame",
        "sequence    desk: 1 frame, path 0.0 m",
        f"split       random: {few} fit, val, cal, test among 1 frames in 1 sequence",
        "split       block (default): expected at least 60% of the frames to remain after gaps of "
        "3 frames, found 1 of 1; the recording is too short; --split random assigns single frames",
        f"split       sequence: {few} fit, val, cal, test among 1 frames in 1 sequence",
    ]
    (folder / "rgb.txt").write_text("1.0\n")
    refused = cvo_export("dataset", f"tum:{folder}")
    assert (refused.returncode, refused.stdout) == (6, "")
    assert refused.stderr == (
        f"cvo-export: {folder}/rgb.txt: expected timestamp filename, found '1.0' in line 1\n"
    )


def test_a_description_has_the_camera_and_each_sequence():
    told = describe(open_dataset("synthetic:room,flights=2,frames=3,size=64x48"))
    assert told[2] == "camera      fx 58.5, fy 58.5, cx 31.5, cy 23.5 px"
    assert [line.split(",")[0] for line in told[-2:]] == [
        "sequence    flight-01: 3 frames",
        "sequence    flight-02: 3 frames",
    ]


def mixed(folder):
    """Write a sequence of twelve frames, two of them of another size and one without a header."""
    (folder / "rgb").mkdir(parents=True)
    names = [f"rgb/{i}.{'jpg' if i % 2 else 'png'}" for i in range(12)]
    rows = [f"{i}.0 {name}\n" for i, name in enumerate(names)]
    (folder / "rgb.txt").write_text("".join(rows))
    (folder / "groundtruth.txt").write_text("".join(f"{i} {i} 0 0 0 0 0 1\n" for i in range(12)))
    for i, name in enumerate(names):
        size = (36, 64, 3) if i in (4, 7) else (48, 64, 3)
        cv2.imwrite(str(folder / name), np.full(size, 20 * i, np.uint8))
    (folder / names[9]).write_bytes(b"\xff\xd8")
    return folder


def test_sizes_are_those_of_the_files_headers(tmp_path):
    found = open_dataset(f"tum:{mixed(tmp_path / 'desk')}")
    assert image_sizes(found) == {(64, 48): 9, (64, 36): 2}
    sizes, damaged = describe(found)[1].rsplit("; ", 1)
    assert sizes == "image       64 x 48 px; of several sizes: 64x48 (9), 64x36 (2)"
    assert damaged == "1 damaged image, training refuses them"
    whole = open_dataset("synthetic:room,flights=2,frames=3,size=64x48")
    assert one_size(whole) == one_size(replace(whole, image_size=None)) == (64, 48)


def test_images_of_several_sizes_are_refused(tmp_path):
    data = f"tum:{mixed(tmp_path / 'desk')}"
    expected = (
        "desk: expected images of one size, found 64x48 (9), 64x36 (2); leave the others out, or "
        "resize those of the same camera"
    )
    with pytest.raises(SourceError) as refused:
        open_run(tmp_path / "run", tiny_config(dataset=data))
    assert str(refused.value) == expected
    with pytest.raises(SourceError) as refused:
        calibrate(tmp_path / "m.onnx", open_dataset(data), tmp_path / "b", "b")
    assert str(refused.value) == expected


def test_a_camera_is_scaled_with_its_images():
    assert Intrinsics(500, 501, 320, 240).scaled(0.5) == (250, 250.5, 160, 120)


def test_a_frame_name_is_kept_once(tmp_path):
    image = tmp_path / "1.png"
    image.touch()
    frames = FrameList(tmp_path)
    frames.add("a", "1", image, IDENTITY)
    frames.add("a", "1", image, IDENTITY)
    frames.add("b", "1", image, IDENTITY)
    found = frames.dataset("x")
    assert found.frame_names == ("a/1", "b/1")
    assert found.sequence.tolist() == [0, 1]
    assert found.skipped == {"listed twice": 1}


def test_an_image_that_vanished_or_is_damaged_names_its_file(tmp_path):
    image = tmp_path / "1.png"
    image.write_bytes(b"\x89PNG")
    frames = FrameList(tmp_path)
    frames.add("a", "1", image, IDENTITY)
    read_image = frames.dataset("x").read_image
    with pytest.raises(SourceError, match=r"1.png: expected an image, found a damaged or"):
        read_image(0)
    image.unlink()
    with pytest.raises(SourceError, match=r"1.png: expected an image; the file cannot be read"):
        read_image(0)
    with pytest.raises(IndexError):
        read_image(1)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("start", ["", "\ufeff"])
def test_rows_are_read_whatever_ends_a_line(tmp_path, start, end):
    path = tmp_path / "a.txt"
    path.write_bytes(end.join([start + "# comment", "", "  1   2 ", " # more", "3 4", ""]).encode())
    rows = read_rows(path, "x y")
    assert [(row.number, row.fields) for row in rows] == [(3, ["1", "2"]), (5, ["3", "4"])]
    assert rows[1].numbers().tolist() == [3, 4]


def test_an_empty_file_has_no_rows(tmp_path):
    path = tmp_path / "a.txt"
    path.touch()
    assert read_rows(path, "x y") == []


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(SourceError, match=r"expected a regular file, found a folder"):
        read_rows(tmp_path, "x y")


@pytest.mark.parametrize(
    ("scale", "valid"), [(1.0, True), (0.995, True), (1.02, False), (0.5, False), (0.0, False)]
)
def test_a_quaternion_far_from_unit_norm_is_no_rotation(scale, valid):
    q = scale * np.array([0.5, -0.5, 0.5, -0.5])
    found = quaternion_pose(np.array([1.0, 2.0, 3.0]), q)
    assert (found is not None) == valid
    if found is not None:
        np.testing.assert_allclose(found, [1, 2, 3, -0.5, 0.5, -0.5, 0.5], atol=1e-12)


def test_an_image_that_is_remembered_is_read_once_and_cannot_be_spoilt(monkeypatch):
    reads = []

    def read_image(index):
        reads.append(index)
        return np.full((4, 4, 3), index, np.uint8)

    poses = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (3, 1))
    plain = PoseDataset("x", poses, np.zeros(3, np.int64), ("a",), ("0", "1", "2"), read_image)
    monkeypatch.setattr(base, "_MOST", 2 * 48)
    dataset = remembered(plain)
    for _ in range(2):
        for index in range(3):
            image = dataset.read_image(index)
            assert (image == index).all()
            image[:] = 9
    # The third image is beyond the memory that is allowed.
    assert reads == [0, 1, 2, 2]
