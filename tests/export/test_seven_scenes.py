"""The 7-Scenes layout: reading, skipping and counting frames; writing and reading round-trip."""

import cv2
import numpy as np
import pytest

from cvo_edge import open_source
from cvo_edge.errors import SinkError, SourceError, UsageError
from cvo_edge.pose import Pose
from cvo_export.datasets import FORMATS, open_dataset
from cvo_export.datasets.seven_scenes import open_seven_scenes, write_sequence


def scene(root, sequences=2, frames=3, suffix=".color.png"):
    for number in range(1, sequences + 1):
        folder = root / f"seq-{number:02d}"
        folder.mkdir(parents=True)
        for frame in range(frames):
            stem = folder / f"frame-{frame:06d}"
            image = np.full((48, 64, 3), 10 * number + frame, np.uint8)
            cv2.imwrite(str(stem) + suffix, image)
            T = Pose.from_array([number, frame, 0, 0, 0, 0.1, 1]).to_matrix()
            text = "\n".join(" ".join(f"{v:.7e}" for v in row) for row in T)
            (folder / f"{stem.name}.pose.txt").write_text(text)
    return root


@pytest.mark.parametrize("suffix", [".color.png", ".color.jpg"])
def test_sequences_frames_and_poses_are_read_in_order(tmp_path, suffix):
    found = open_seven_scenes(str(scene(tmp_path, suffix=suffix)))
    assert len(found) == 6
    assert found.sequence_names == ("seq-01", "seq-02")
    assert found.frame_names[4] == "seq-02/frame-000001"
    np.testing.assert_allclose(found.poses[4][:3], [2, 1, 0])
    assert found.read_image(4).shape == (48, 64, 3)
    assert abs(int(found.read_image(4)[0, 0, 0]) - 21) <= 1


def test_lost_tracking_and_missing_poses_are_skipped_and_counted(tmp_path):
    root = scene(tmp_path)
    (root / "seq-01" / "frame-000000.pose.txt").write_text("nan " * 16)
    (root / "seq-02" / "frame-000002.pose.txt").unlink()
    found = open_seven_scenes(str(root))
    assert len(found) == 4
    assert found.skipped == {"invalid pose": 1, "no pose file": 1}


@pytest.mark.parametrize("suffix", [".color.png", "_rgb.jpg", "-color.png", ".jpg"])
def test_the_runtime_and_the_training_side_choose_the_same_images(tmp_path, suffix):
    folder = scene(tmp_path, 1, suffix=suffix) / "seq-01"
    for frame in range(3):
        cv2.imwrite(str(folder / f"frame-{frame:06d}.depth.png"), np.zeros((48, 64), np.uint16))
        cv2.imwrite(str(folder / f"frame-{frame:06d}_mask.png"), np.zeros((48, 64), np.uint8))
    found = open_seven_scenes(str(tmp_path))
    source = open_source(folder)
    assert found.frame_names == tuple(f"seq-01/frame-{frame:06d}" for frame in range(3))
    assert [frame.source for frame in source] == [f"frame-{n:06d}{suffix}" for n in range(3)]
    assert found.left_out == source.left_out == {"marked depth": 3, "marked mask": 3}


def test_own_lists_name_sequences_by_number(tmp_path):
    root = scene(tmp_path, 3)
    (root / "TrainSplit.txt").write_text("sequence1\nsequence3\n")
    (root / "TestSplit.txt").write_text("sequence2\nsequence9\n")
    found = open_seven_scenes(str(root))
    assert (found.own_train, found.own_test) == ({0, 2}, {1})
    (root / "TrainSplit.txt").write_text("\ufeffsequence3\n", "utf-8")
    assert open_seven_scenes(str(root)).own_train == {2}


def test_intrinsics_are_read_or_scaled_from_the_nominal_ones(tmp_path):
    root = scene(tmp_path)
    nominal = open_seven_scenes(str(root)).intrinsics
    assert nominal == pytest.approx((58.5, 58.5, 32, 24))
    (root / "camera-intrinsics.txt").write_text("50 0 31\n0 51 23\n0 0 1\n")
    assert open_seven_scenes(str(root)).intrinsics == (50, 51, 31, 23)
    (root / "camera-intrinsics.txt").write_text("50 0")
    with pytest.raises(SourceError, match="nine numbers"):
        open_seven_scenes(str(root))
    (root / "camera-intrinsics.txt").write_text("-50 0 31\n0 51 23\n0 0 1\n")
    with pytest.raises(SourceError, match="expected a matrix of finite intrinsics with positive"):
        open_seven_scenes(str(root))


def test_one_sequence_folder_is_a_data_set(tmp_path):
    found = open_seven_scenes(str(scene(tmp_path) / "seq-02"))
    assert len(found) == 3
    assert found.sequence_names == ("seq-02",)


def test_nothing_to_read_is_refused(tmp_path):
    with pytest.raises(SourceError, match="expected a 7-Scenes folder, found no folder"):
        open_seven_scenes(str(tmp_path / "nowhere"))
    with pytest.raises(SourceError, match="expected frames with a pose"):
        open_seven_scenes(str(tmp_path))


def test_a_damaged_image_names_its_file(tmp_path):
    root = scene(tmp_path)
    found = open_seven_scenes(str(root))
    (root / "seq-01" / "frame-000001.color.png").write_bytes(b"\x89PNG")
    with pytest.raises(SourceError, match="frame-000001"):
        found.read_image(1)


def test_images_of_fewer_bits_keep_the_upper_eight_of_them(tmp_path):
    scene(tmp_path, sequences=1, frames=2, suffix=".color.png")
    plain = open_dataset(f"7scenes:{tmp_path}").read_image(0)
    for path in tmp_path.rglob("*.color.png"):
        cv2.imwrite(str(path), cv2.imread(str(path)).astype(np.uint16) << 4)
    np.testing.assert_array_equal(open_dataset(f"7scenes:{tmp_path},bits=12").read_image(0), plain)
    assert open_dataset(f"7scenes:{tmp_path}").read_image(0).max() < 16
    with pytest.raises(UsageError, match="bit depth: expected 9 to 16 bits, found 8"):
        open_dataset(f"7scenes:{tmp_path},bits=8")


def test_writing_a_sequence_gives_it_back(tmp_path):
    rendered = open_dataset("synthetic:room,flights=1,frames=3,size=64x48")
    assert write_sequence(rendered, 0, tmp_path / "clip", 2) == 2
    found = open_seven_scenes(str(tmp_path / "clip"))
    np.testing.assert_allclose(found.poses, rendered.poses[:2], atol=1e-8)
    jpeg = cv2.imencode(".jpg", rendered.read_image(1), [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    np.testing.assert_array_equal(found.read_image(1), cv2.imdecode(jpeg, cv2.IMREAD_COLOR))
    with pytest.raises(SinkError, match="new folder"):
        write_sequence(rendered, 0, tmp_path / "clip", 2)


@pytest.mark.parametrize("text", ["room", "folder:x", "", "synthetic", ":room"])
def test_an_unknown_format_lists_those_there_are(text):
    with pytest.raises(UsageError, match=", ".join(FORMATS)):
        open_dataset(text)


def test_real_redkitchen_is_read_whole(real_data):
    found = open_seven_scenes(str(real_data / "redkitchen"))
    assert len(found) == 1000
    assert found.intrinsics == (585, 585, 320, 240)
    assert not found.skipped
    np.testing.assert_allclose(np.linalg.norm(found.poses[:, 3:], axis=1), 1.0, atol=1e-12)
    steps = np.linalg.norm(np.diff(found.poses[:, :3], axis=0), axis=1)
    assert 7.0 < steps.sum() < 8.0
