"""KITTI odometry: poses belong to the camera whose images are read; evo reads the same poses."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvo_edge.errors import SourceError
from cvo_edge.pose import Pose
from cvo_export.datasets import open_dataset
from cvo_export.datasets.kitti import open_kitti

DATA = Path(__file__).parent / "data" / "kitti"
FORM = "r11 r12 r13 t1 r21 r22 r23 t2 r31 r32 r33 t3"


def write_images(folder, count=12, grey=False):
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        image = np.full((37, 124) if grey else (37, 124, 3), number, np.uint8)
        cv2.imwrite(str(folder / f"{number:06d}.png"), image)


def root_with(tmp_path, cameras=(2,), name="00"):
    sequence = tmp_path / "sequences" / name
    for camera in cameras:
        write_images(sequence / f"image_{camera}", grey=camera == 0)
    shutil.copy(DATA / "calib.txt", sequence / "calib.txt")
    (sequence / "times.txt").write_text("".join(f"{0.1 * i:.6e}\n" for i in range(12)))
    (tmp_path / "poses").mkdir(exist_ok=True)
    shutil.copy(DATA / "00.txt", tmp_path / "poses" / f"{name}.txt")
    return sequence


def matrices(poses):
    return np.array([Pose.from_array(pose).to_matrix()[:3] for pose in poses])


@pytest.mark.parametrize(("cameras", "reference"), [((0, 2), "camera2"), ((0,), "camera0")])
def test_poses_are_those_of_the_camera_read_as_evo_has_them(tmp_path, cameras, reference):
    found = open_kitti(str(root_with(tmp_path, cameras)))
    evo = np.loadtxt(DATA / f"evo_{reference}.kitti").reshape(-1, 3, 4)
    assert len(found) == 12
    assert not found.skipped
    # The file has seven digits, so rotations are orthonormal only to that precision.
    np.testing.assert_allclose(matrices(found.poses), evo, atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(found.poses[:, 3:], axis=1), 1, atol=1e-12)
    assert (found.poses[:, 6] >= 0).all()
    turn = Rotation.from_matrix(evo[:, :, :3]).inv() * Rotation.from_quat(found.poses[:, 3:])
    assert turn.magnitude().max() < 2e-6


def test_both_cameras_project_a_point_as_the_calibration_says(tmp_path):
    sequence = root_with(tmp_path, (0, 2))
    colour = open_kitti(str(sequence))
    shutil.rmtree(sequence / "image_2")
    grey = open_kitti(str(sequence))
    lines = (sequence / "calib.txt").read_text().splitlines()
    P2 = np.array(lines[2].split()[1:], dtype=float).reshape(3, 4)
    point_camera0 = np.array([1.5, -0.5, 12.0, 1.0])
    point_world = Pose.from_array(grey.poses[5]).to_matrix() @ point_camera0
    in_camera2 = np.linalg.inv(Pose.from_array(colour.poses[5]).to_matrix()) @ point_world
    fx, fy, cx, cy = colour.intrinsics
    x, y, z = in_camera2[:3]
    pixel = P2 @ point_camera0
    np.testing.assert_allclose([fx * x / z + cx, fy * y / z + cy], pixel[:2] / pixel[2], atol=1e-6)


def test_the_colour_camera_comes_first_and_grey_images_are_bgr(tmp_path):
    sequence = root_with(tmp_path, (0,))
    found = open_dataset(f"kitti:{sequence}")
    assert (found.name, found.sequence_names) == ("kitti-00", ("00",))
    assert found.frame_names[11] == "00/000011"
    assert found.intrinsics == pytest.approx((712.5, 712.5, 601.25, 187.75))
    assert found.read_image(7).shape == (37, 124, 3)
    assert found.read_image(7)[0, 0].tolist() == [7, 7, 7]


def test_a_root_will_do_where_one_sequence_has_poses(tmp_path):
    root_with(tmp_path)
    root_with(tmp_path, name="11")
    (tmp_path / "poses" / "11.txt").unlink()
    assert open_kitti(str(tmp_path)).name == "kitti-00"


def test_several_sequences_are_refused_by_name(tmp_path):
    first = root_with(tmp_path)
    root_with(tmp_path, name="01")
    with pytest.raises(SourceError) as refusal:
        open_kitti(str(tmp_path))
    assert str(refusal.value) == (
        f"{tmp_path}: expected one sequence with poses, because each has its own world frame, "
        f"found 00, 01; choose one, e.g. {first}"
    )


def test_frames_without_counterpart_and_invalid_poses_are_skipped_and_counted(tmp_path):
    sequence = root_with(tmp_path)
    write_images(sequence / "image_2", 14)
    (sequence / "image_2" / "000004.png").unlink()
    path = tmp_path / "poses" / "00.txt"
    lines = path.read_text().splitlines()
    lines[1] = " ".join(["nan"] * 12)
    lines[2] = " ".join(["0"] * 12)
    lines[3] = "2 0 0 0 0 2 0 0 0 0 2 0"
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode())
    found = open_kitti(str(sequence))
    assert found.skipped == {"invalid pose": 3, "image missing": 1, "no pose": 2}
    assert [name[-2:] for name in found.frame_names] == [
        f"{number:02d}" for number in (0, *range(5, 12))
    ]
    evo = np.loadtxt(DATA / "evo_camera2.kitti").reshape(-1, 3, 4)
    np.testing.assert_allclose(matrices(found.poses), evo[[0, *range(5, 12)]], atol=2e-6)


def test_nothing_but_the_calibration_is_refused(tmp_path):
    sequence = root_with(tmp_path)
    shutil.rmtree(sequence / "image_2")
    with pytest.raises(SourceError) as refusal:
        open_kitti(str(sequence))
    assert str(refusal.value) == (
        f"{sequence}: expected frames with a pose, found none; skipped 12: image missing 12"
    )


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("poses/00.txt", "1 0 0\n", f"{FORM}, found '1 0 0' in line 1"),
        ("poses/00.txt", "# comment\n", f"{FORM}, found '# comment' in line 1"),
        ("poses/00.txt", None, f"a file of {FORM}, found none"),
        ("sequences/00/calib.txt", "P0: 1 2\n", None),
        ("sequences/00/calib.txt", "P0:" + " 1" * 12, "a line P2:, found P0:"),
        ("sequences/00/calib.txt", "P2:" + " 0" * 12, None),
        ("sequences/00/calib.txt", "P2:" + " x" * 12, None),
        ("sequences/00/calib.txt", "P2: 1 1 0 0 1 1 0 0 0 0 1 0", None),
    ],
)
def test_a_malformed_file_is_refused_with_its_line(tmp_path, file, text, expected):
    sequence = root_with(tmp_path)
    path = tmp_path / file
    if text is None:
        path.unlink()
    else:
        path.write_text(text)
    if expected is None:
        expected = (
            f"P2: p11 p12 p13 p14 p21 p22 p23 p24 p31 p32 p33 p34, found {text.strip()!r} in line 1"
        )
    with pytest.raises(SourceError) as refusal:
        open_kitti(str(sequence))
    assert str(refusal.value) == f"{path}: expected {expected}"


def test_no_sequence_is_refused(tmp_path):
    with pytest.raises(SourceError) as refusal:
        open_kitti(str(tmp_path))
    assert str(refusal.value) == f"{tmp_path}: expected a sequence with poses, found none"


def test_poses_in_the_folder_of_the_sequence_are_read_if_there_are_no_others(tmp_path):
    sequence = root_with(tmp_path)
    expected = open_kitti(str(sequence)).poses
    (tmp_path / "poses" / "00.txt").rename(sequence / "poses.txt")
    np.testing.assert_array_equal(open_kitti(str(sequence)).poses, expected)


@pytest.mark.parametrize("name", ["000003.jpg", "3.png"])
def test_two_images_of_one_number_are_refused(tmp_path, name):
    sequence = root_with(tmp_path)
    folder = sequence / "image_2"
    shutil.copy(folder / "000003.png", folder / name)
    with pytest.raises(SourceError) as caught:
        open_kitti(str(sequence))
    first, second = sorted(["000003.png", name])
    expected = f"{folder}: expected one image for each number, found {first} and {second}"
    assert str(caught.value) == expected
