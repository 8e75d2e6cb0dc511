"""TUM RGB-D: quaternions, association by stamp, cameras by name; evo reads the same poses."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvo_edge.errors import SourceError
from cvo_edge.pose import Pose
from cvo_export.datasets import open_dataset
from cvo_export.datasets.tum import open_tum

DATA = Path(__file__).parent / "data" / "tum"
SECOND = "1305031102"


def write_images(folder, size=(48, 64)):
    """Write the images that rgb.txt lists."""
    (folder / "rgb").mkdir(exist_ok=True)
    for line in (folder / "rgb.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            cv2.imwrite(str(folder / line.split()[1]), np.full((*size, 3), 90, np.uint8))


def sequence(folder, images, poses, end="\n"):
    """Write a sequence; stamps are milliseconds after a fixed second, each pose with its stamp."""
    folder.mkdir(parents=True)
    listed = [f"{SECOND}.{ms:03d}000 rgb/{SECOND}.{ms:03d}000.png" for ms in images]
    truth = [f"{SECOND}.{ms:03d}0 {pose}" for ms, pose in poses]
    header = ["# a comment", "# file: 'fixture.bag'"]
    (folder / "rgb.txt").write_bytes(end.join([*header, *listed, ""]).encode())
    (folder / "groundtruth.txt").write_bytes(end.join([*header, *truth, ""]).encode())
    write_images(folder)
    return folder


def test_poses_and_association_agree_with_evo(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg1_fixture"
    shutil.copytree(DATA, folder)
    write_images(folder)
    found = open_tum(str(folder))
    evo = np.loadtxt(DATA / "evo_associated.tum")
    assert len(found) == len(evo) == 17
    assert found.skipped == {"no pose within 0.02 s": 3}
    np.testing.assert_allclose(found.poses[:, :3], evo[:, 1:4], atol=1e-12)
    turn = Rotation.from_quat(found.poses[:, 3:]).inv() * Rotation.from_quat(evo[:, 4:])
    assert turn.magnitude().max() < 1e-12


def test_the_quaternion_is_scalar_last(tmp_path):
    turn = Rotation.from_rotvec([0.3, -0.5, 2.9])
    numbers = " ".join(f"{v:.4f}" for v in (0.5, -0.25, 1.5, *-turn.as_quat()))
    found = open_tum(str(sequence(tmp_path / "a", [100], [(100, numbers)])))
    T = Pose.from_array(found.poses[0]).to_matrix()
    np.testing.assert_allclose(T[:3, :3], turn.as_matrix(), atol=2e-4)
    np.testing.assert_array_equal(T[:3, 3], [0.5, -0.25, 1.5])
    assert found.poses[0][6] >= 0
    assert np.linalg.norm(found.poses[0][3:]) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_an_image_gets_the_nearest_pose_within_twenty_milliseconds(tmp_path, end):
    poses = [(ms, f"{ms} 0 0 0 0 0 1") for ms in (500, 100, 110, 300)]  # in any order
    images = [80, 79, 104, 105, 106, 130, 131, 315, 500, 521]
    found = open_tum(str(sequence(tmp_path / "a", images, poses, end)))
    assert found.frame_names[0] == f"a/{SECOND}.080000"
    stamps = [int(name.split(".")[1]) // 1000 for name in found.frame_names]
    assert stamps == [80, 104, 105, 106, 130, 315, 500]
    # Of two equally near poses, the earlier one is used.
    assert found.poses[:, 0].tolist() == [100, 100, 100, 110, 110, 300, 500]
    assert found.skipped == {"no pose within 0.02 s": 3}


def test_stamps_are_compared_to_the_nanosecond(tmp_path):
    # These stamps are equal in double precision.
    folder = sequence(tmp_path / "a", [100], [])
    truth = [f"{SECOND}.1200000{digit:02d} {digit} 0 0 0 0 0 1" for digit in (0, 1)]
    (folder / "groundtruth.txt").write_text("\n".join(truth))
    assert open_tum(str(folder)).poses[0][0] == 0
    (folder / "groundtruth.txt").write_text(truth[1])
    with pytest.raises(SourceError, match=r"found none; skipped 1: no pose within 0.02 s 1$"):
        open_tum(str(folder))


def test_invalid_poses_missing_images_and_repeated_lines_are_skipped_and_counted(tmp_path):
    poses = [
        (100, "1 0 0 0 0 0 1"),
        (200, "nan 0 0 0 0 0 1"),
        (300, "1 0 0 0 0 0 0"),
        (400, "1 0 0 0 0 0 1"),
    ]
    folder = sequence(tmp_path / "a", [100, 100, 200, 300, 400, 500], poses)
    (folder / "rgb" / f"{SECOND}.400000.png").unlink()
    found = open_tum(str(folder))
    assert len(found) == 1
    assert found.skipped == {
        "listed twice": 1,
        "invalid pose": 2,
        "image missing": 1,
        "no pose within 0.02 s": 1,
    }


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        ("rgbd_dataset_freiburg1_desk", (517.3, 516.5, 318.6, 255.3)),
        ("rgbd_dataset_freiburg2_xyz", (520.9, 521.0, 325.1, 249.7)),
        ("fr3_office", (535.4, 539.2, 320.1, 247.6)),
        ("freiburg12", None),
        ("desk", None),
    ],
)
def test_cameras_are_known_by_the_name_of_the_folder(tmp_path, name, camera):
    folder = sequence(tmp_path / name, [100], [(100, "0 0 0 0 0 0 1")])
    found = open_tum(str(folder)).intrinsics
    assert found == (camera if camera is None else pytest.approx([v / 10 for v in camera]))
    write_images(folder, (480, 640))
    assert open_tum(str(folder)).intrinsics == camera
    undistorted = camera is None or camera[0] == 535.4
    assert (open_tum(str(folder)).lens.distortion == "none") == undistorted


def test_a_folder_of_sequences_is_one_data_set(tmp_path):
    room = tmp_path / "room"
    sequence(room / "walk_10", [100, 200], [(100, "1 0 0 0 0 0 1"), (200, "2 0 0 0 0 0 1")])
    sequence(room / "walk_2", [100], [(100, "3 0 0 0 0 0 1")])
    sequence(room / "walk_3", [900], [(100, "3 0 0 0 0 0 1")])  # no posed frame
    (room / "notes").mkdir()
    found = open_dataset(f"tum:{room}")
    assert found.name == "room"
    assert found.sequence_names == ("walk_2", "walk_10")
    assert found.sequence.tolist() == [0, 1, 1]
    assert found.poses[:, 0].tolist() == [3, 1, 2]
    assert len(set(found.frame_names)) == 3


def test_sequences_of_two_cameras_are_refused(tmp_path):
    for name in ("freiburg1_desk", "freiburg2_desk"):
        sequence(tmp_path / name, [100], [(100, "0 0 0 0 0 0 1")])
    with pytest.raises(SourceError) as refusal:
        open_tum(str(tmp_path))
    assert str(refusal.value) == (
        f"{tmp_path}: expected sequences from one camera, "
        "found different cameras in freiburg1_desk and freiburg2_desk"
    )


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("rgb.txt", "#\n1.5\n", "timestamp filename, found '1.5' in line 2"),
        ("rgb.txt", "x rgb/a.png", "timestamp filename, found 'x rgb/a.png' in line 1"),
        ("groundtruth.txt", "1 2 3", "timestamp tx ty tz qx qy qz qw, found '1 2 3' in line 1"),
        (
            "groundtruth.txt",
            "#\n\n1 0 0 0 0 0 0 one\n",
            "timestamp tx ty tz qx qy qz qw, found '1 0 0 0 0 0 0 one' in line 3",
        ),
        (
            "groundtruth.txt",
            "nan 0 0 0 0 0 0 1",
            "timestamp tx ty tz qx qy qz qw, found 'nan 0 0 0 0 0 0 1' in line 1",
        ),
        (
            "groundtruth.txt",
            b"\xff\xfe\xfa",
            "a file of timestamp tx ty tz qx qy qz qw, found text that is not UTF-8",
        ),
        ("groundtruth.txt", None, "a file of timestamp tx ty tz qx qy qz qw, found none"),
    ],
)
def test_a_malformed_file_is_refused_with_its_line(tmp_path, file, text, expected):
    path = sequence(tmp_path / "a", [100], [(100, "0 0 0 0 0 0 1")]) / file
    if text is None:
        path.unlink()
    else:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SourceError) as refusal:
        open_tum(str(tmp_path / "a"))
    assert str(refusal.value) == f"{path}: expected {expected}"


def test_no_sequence_is_refused(tmp_path):
    with pytest.raises(SourceError) as refusal:
        open_tum(str(tmp_path))
    assert str(refusal.value) == (
        f"{tmp_path}: expected rgb.txt, or folders that contain it, found neither"
    )
