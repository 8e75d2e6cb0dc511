"""TUM-VI, 12-Scenes, ScanNet and ACE in their true layouts; scipy computes the poses."""

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from cvo_edge.errors import SourceError
from cvo_edge.pose import Pose
from cvo_export.datasets import open_dataset

START_NS = 1520530308199447626
# As Kalibr writes it: the IMU's frame to the camera's.
T_CAMERA_IMU = np.eye(4)
T_CAMERA_IMU[:3, :3] = Rotation.from_euler("zyx", [-91.7, 1.5, -178.0], degrees=True).as_matrix()
T_CAMERA_IMU[:3, 3] = 0.0453, -0.0719, -0.0448
LENS = [0.0035, 0.0007, -0.0021, 0.0002]
K = [[1170.2, 0, 647.8, 0], [0, 1170.2, 483.8, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
INFO = """m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = 1296
m_colorHeight = 968
m_depthWidth = 640
m_depthHeight = 480
m_depthShift = 1000
m_calibrationColorIntrinsic = {}
m_calibrationDepthIntrinsic = 582.9 0 320 0 0 582.7 240 0 0 0 1 0 0 0 0 1
"""
LOST = "-1.#INF -1.#INF -1.#INF -1.#INF\n" * 4
SPLIT = "sequence0 [frames=2] [start=0 ; end=1]\nsequence1 [frames=3] [start=2 ; end=4]\n"


def image(path, size=(48, 64), value=90, kind=np.uint8):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full(size, value, kind))


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def matrices(count):
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, random_state=1).as_matrix()
    T[:, :3, 3] = np.random.default_rng(1).normal(size=(count, 3))
    return T


def rows(T):
    return "\n".join(" ".join(f"{value:.9f}" for value in row) for row in T) + "\n"


def agree(dataset, expected):
    found = [Pose.from_array(pose).to_matrix() for pose in dataset.poses]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def imu(seconds):
    """A body that turns and moves at constant speed, so that interpolation is exact."""
    T = np.eye(4)
    T[:3, :3] = (
        Rotation.from_rotvec([0.3, 2.9, -0.4]) * Rotation.from_rotvec([0, 0, seconds])
    ).as_matrix()
    T[:3, 3] = np.array([1.0, -2.0, 0.5]) * seconds
    return T


def tum_vi(folder, visits=((0.0, 1.0), (3.0, 4.1)), end=4.0):
    """20 images a second, 120 poses a second where the motion capture system sees the camera."""
    camera = folder / "mav0" / "cam0"
    names = ["#timestamp [ns],filename"]
    for number in range(round(20 * end) + 1):
        stamp = START_NS + number * 50_000_000 + 1_234_567
        names.append(f"{stamp},{stamp}.png")
        image(camera / "data" / f"{stamp}.png", value=256 * number + 255, kind=np.uint16)
    write(camera / "data.csv", "\n".join(names) + "\n")
    poses = ["#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x []"]
    for start, stop in visits:
        for step in range(round(120 * start), round(120 * stop) + 1):
            T = imu(step / 120)
            x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat() * (-1) ** step
            numbers = (*T[:3, 3], w, x, y, z)
            stamp = START_NS + round(step / 120 * 1e9)
            poses.append(",".join([str(stamp), *(f"{value:.9f}" for value in numbers)]))
    write(folder / "mav0" / "mocap0" / "data.csv", "\n".join(poses) + "\n")
    chain = {
        "T_cam_imu": T_CAMERA_IMU.tolist(),
        "camera_model": "pinhole",
        "distortion_coeffs": LENS,
        "distortion_model": "equidistant",
        "intrinsics": [24.0, 24.1, 31.9, 24.2],
        "resolution": [64, 48],
    }
    write(folder / "dso" / "camchain.yaml", yaml.safe_dump({"cam0": chain, "cam1": {}}))
    return folder


def test_tum_vi_has_poses_of_the_camera_where_the_room_sees_it(tmp_path):
    folder = tum_vi(tmp_path / "corridor1")
    found = open_dataset(f"tum-vi:{folder}")
    seconds = (found.stamps_ns - START_NS) / 1e9
    agree(found, [imu(t) @ np.linalg.inv(T_CAMERA_IMU) for t in seconds])
    assert found.frame_names[0] == f"corridor1/{START_NS + 1_234_567}"
    assert len(found) == 42
    assert found.skipped == {"no pose within 0.005 s": 39}
    assert found.chosen == "corridor1 has ground truth for 2.1 of 4.0 s, in 2 parts"
    # Of 16 bits, the upper eight are kept.
    assert found.read_image(2).shape == (48, 64, 3)
    assert found.read_image(2)[0, 0].tolist() == [2, 2, 2]
    assert found.lens == ("equidistant", tuple(LENS))
    assert found.intrinsics == (24.0, 24.1, 31.9, 24.2)
    # OpenCV's fisheye model agrees, beyond the field of view of a pinhole camera.
    points = np.array([[0.3, -0.2, 1.0], [3.0, 1.0, 0.7]])
    theirs, _ = cv2.fisheye.projectPoints(
        points[:, np.newaxis], np.zeros(3), np.zeros(3), found.camera().matrix, np.array(LENS)
    )
    np.testing.assert_allclose(found.camera().project(points), theirs[:, 0], atol=1e-6)


def test_tum_vi_rooms_share_a_world_and_the_poses_of_dso_serve_as_well(tmp_path):
    first = tum_vi(tmp_path / "all" / "room1", [(0.0, 0.5)], 0.45)
    second = tum_vi(tmp_path / "all" / "room2", [(0.0, 0.5)], 0.45)
    (second / "mav0" / "mocap0" / "data.csv").rename(second / "dso" / "gt_imu.csv")
    found = open_dataset(f"tum-vi:{first.parent}")
    assert (found.sequence_names, found.skipped, found.chosen) == (("room1", "room2"), {}, "")
    np.testing.assert_array_equal(found.poses[:10], found.poses[10:])


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("dso/camchain.yaml", "cam1: {}", "cam0 with T_cam_imu, found cam1"),
        (
            "dso/camchain.yaml",
            "cam0: {}",
            "T_cam_imu of cam0, 16 numbers of a rigid transform, found none",
        ),
        ("mav0/mocap0/data.csv", "# none", "poses, found none"),
        (
            "mav0/mocap0/data.csv",
            "# a\n1,0,0,0,1,0,0,x\n",
            "timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z, found '1 0 0 0 1 0 0 x' in line 2",
        ),
    ],
)
def test_tum_vi_files_that_are_malformed_are_refused(tmp_path, file, text, expected):
    folder = tum_vi(tmp_path / "a", [(0.0, 0.1)], 0.05)
    write(folder / file, text)
    with pytest.raises(SourceError) as refusal:
        open_dataset(f"tum-vi:{folder}")
    assert str(refusal.value) == f"{folder / file}: expected {expected}"


def twelve_scenes(folder, size=(968, 1296)):
    for number, T in enumerate(matrices(6)):
        image(folder / "data" / f"frame-{number:06d}.color.jpg", size)
        image(folder / "data" / f"frame-{number:06d}.depth.png")
        text = LOST if number == 3 else rows(T)
        write(folder / "data" / f"frame-{number:06d}.pose.txt", text)
    write(folder / "info.txt", INFO.format(" ".join(str(value) for row in K for value in row)))
    write(folder / "split.txt", SPLIT)
    return folder


def test_12_scenes_have_the_sequences_of_their_split(tmp_path):
    found = open_dataset(f"12scenes:{twelve_scenes(tmp_path / 'apt1' / 'kitchen').parent}")
    agree(found, matrices(6)[[0, 1, 2, 4]])
    assert found.name == "kitchen"
    assert found.frame_names[:3] == (
        "sequence0/frame-000000",
        "sequence0/frame-000001",
        "sequence1/frame-000002",
    )
    assert (found.own_test, found.own_train) == ({0}, {1})
    assert found.skipped == {"invalid pose": 1, "in no sequence of split.txt": 1}
    assert found.intrinsics == (1170.2, 1170.2, 647.8, 483.8)
    half = open_dataset(f"12scenes:{twelve_scenes(tmp_path / 'half', (484, 648))}")
    np.testing.assert_allclose(half.intrinsics, (585.1, 585.1, 323.65, 241.65))


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("split.txt", "", r"lines sequenceN .*, found none"),
        ("split.txt", f"{SPLIT}sequence2 5", r"sequenceN .*, found 'sequence2 5' in line 3"),
        ("split.txt", 2 * SPLIT, r"each sequence once, found 'sequence0 .*' in line 3"),
        ("info.txt", INFO.format("1 2"), r"m_calibrationColorIntrinsic = 16 numbers, found .*"),
        ("info.txt", "m_colorWidth = 640", r"lines m_colorWidth, .*, found .*"),
        ("info.txt", INFO.format(" ".join("0" * 16)), "matrix of finite intrinsics with .*"),
    ],
)
def test_12_scenes_files_that_are_malformed_are_refused(tmp_path, file, text, expected):
    folder = twelve_scenes(tmp_path / "a", (48, 64))
    write(folder / file, text)
    with pytest.raises(SourceError, match=f"^{folder / file}: expected .*{expected}$"):
        open_dataset(f"12scenes:{folder}")


@pytest.mark.parametrize("below", ["", "data"])
def test_12_scenes_read_as_7_scenes_are_refused(tmp_path, below):
    scene = twelve_scenes(tmp_path / "a", (48, 64))
    with pytest.raises(SourceError, match=rf"split.txt of 12-Scenes .* as 12scenes:{scene}$"):
        open_dataset(f"7scenes:{scene / below}")


@pytest.mark.parametrize("name", ["mocap0", "gt_imu"])
def test_tum_vi_read_as_euroc_is_refused(tmp_path, name):
    folder = tum_vi(tmp_path / "room1", [(0.0, 0.1)], 0.05)
    if name == "gt_imu":
        (folder / "mav0" / "mocap0" / "data.csv").rename(folder / "dso" / "gt_imu.csv")
        (folder / "mav0" / "mocap0").rmdir()
    with pytest.raises(SourceError, match=f"^{folder}: .* of TUM-VI; read it as tum-vi:{folder}$"):
        open_dataset(f"euroc:{folder}")


def scannet(folder, size=(968, 1296)):
    for number, T in zip((0, 2, 10, 20, 30), matrices(5), strict=True):
        image(folder / "color" / f"{number}.jpg", size)
        lost = "-inf -inf -inf -inf\n" * 4
        write(folder / "pose" / f"{number}.txt", lost if number == 20 else rows(T))
    (folder / "pose" / "30.txt").unlink()
    write(folder / "intrinsic" / "intrinsic_color.txt", rows(K))
    return folder


def test_a_scan_of_scannet_is_one_sequence_without_lost_frames(tmp_path):
    found = open_dataset(f"scannet:{scannet(tmp_path / 'scene0000_00')}")
    agree(found, matrices(5)[:3])
    assert found.frame_names == tuple(f"scene0000_00/{number}" for number in (0, 2, 10))
    assert found.skipped == {"invalid pose": 1, "no pose file": 1}
    assert found.intrinsics == (1170.2, 1170.2, 647.8, 483.8)
    scannet(tmp_path / "scene0000_01", (48, 64))
    with pytest.raises(SourceError, match=r"one scan with .*own world frame.*scene0000_00, scene"):
        open_dataset(f"scannet:{tmp_path}")
    with pytest.raises(SourceError, match=r"intrinsic_color.txt: expected the principal point .*"):
        open_dataset(f"scannet:{tmp_path / 'scene0000_01'}")
    camera = tmp_path / "scene0000_00" / "intrinsic" / "intrinsic_color.txt"
    for text, expected in (
        ("1 0 0\n0 x 0\n", "the sixteen numbers of a 4x4 matrix, found '0 x 0' in line 2"),
        ("1 0 0", "the sixteen numbers of a 4x4 matrix, found 3 numbers"),
    ):
        write(camera, text)
        with pytest.raises(SourceError) as refusal:
            open_dataset(f"scannet:{tmp_path / 'scene0000_00'}")
        assert str(refusal.value) == f"{camera}: expected {expected}"
    camera.unlink()
    assert open_dataset(f"scannet:{tmp_path / 'scene0000_00'}").intrinsics is None


def ace(folder, names, calibration):
    for number, (name, T) in enumerate(zip(names, matrices(len(names)), strict=True)):
        image(folder / "rgb" / f"{name}.color.png")
        write(folder / "poses" / f"{name}.pose.txt", rows(T))
        write(folder / "calibration" / f"{name}.calibration.txt", calibration(number))


def test_ace_pairs_sorted_files_and_keeps_recordings_and_parts(tmp_path):
    names = [f"seq-{seq:02d}-frame-{number:06d}" for seq in (2, 1) for number in range(2)]
    ace(tmp_path / "train", names, lambda number: f"{52.5 + 0.1 * number}")
    ace(tmp_path / "test", ["a1", "a2"], lambda number: "52.5")
    found = open_dataset(f"ace:{tmp_path}")
    assert found.sequence_names == ("train/seq-01", "train/seq-02", "test")
    assert found.frame_names[::5] == ("train/seq-01/seq-01-frame-000000", "test/a2")
    agree(found, [*matrices(4)[[2, 3, 0, 1]], *matrices(2)])
    assert (found.own_train, found.own_test) == ({0, 1}, {2})
    assert found.chosen == "the median of focal lengths 52.5 to 52.8 px"
    np.testing.assert_allclose(found.intrinsics, (52.55, 52.55, 32, 24))
    part = tmp_path / "test"
    ace(part, ["a1", "a2"], lambda number: "50 0 31\n0 51 23\n0 0 1\n")
    assert open_dataset(f"ace:{part}").intrinsics == (50, 51, 31, 23)


def test_ace_files_that_do_not_fit_together_are_refused(tmp_path):
    ace(tmp_path / "train", ["a1", "a2", "a3"], lambda number: f"{50 + number}")
    with pytest.raises(SourceError, match=r"one camera, within 1%, found focal lengths 50.0 to 52"):
        open_dataset(f"ace:{tmp_path}")
    write(tmp_path / "train" / "calibration" / "a2.calibration.txt", "52.5 px")
    with pytest.raises(
        SourceError, match=r"a2.calib.*: expected a focal length .*, found '52.5 px"
    ):
        open_dataset(f"ace:{tmp_path}")
    pose = tmp_path / "train" / "poses" / "a1.pose.txt"
    pose.rename(pose.with_name("a4.pose.txt"))
    with pytest.raises(SourceError, match=r"same place of .*, found rgb/a2.* and poses/a3"):
        open_dataset(f"ace:{tmp_path}")
    pose.with_name("a4.pose.txt").unlink()
    with pytest.raises(SourceError, match="as many files in poses as in rgb, found 2 and 3; del"):
        open_dataset(f"ace:{tmp_path}")
    with pytest.raises(SourceError, match="expected folders train/rgb or test/rgb, or rgb"):
        open_dataset(f"ace:{tmp_path / 'test'}")
