"""EuRoC: body poses are converted to camera poses; evo reads the same poses, before and after."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvo_edge.errors import SourceError
from cvo_edge.pose import Pose
from cvo_export.datasets import open_dataset
from cvo_export.datasets.euroc import open_euroc

DATA = Path(__file__).parent / "data" / "euroc"
# The stamps of groundtruth.csv, some of which differ from the images' by a few nanoseconds.
FIRST_NS, STEP_NS = 1403715274302142976, 5_000_000
ONES = ("[" + "1, " * 99)[:80]
IDENTITY = "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"


def recording(folder, stamps_ns, end="\r\n"):
    camera = folder / "mav0" / "cam0"
    truth = folder / "mav0" / "state_groundtruth_estimate0"
    (camera / "data").mkdir(parents=True)
    truth.mkdir()
    rows = ["#timestamp [ns],filename", *(f"{stamp},{stamp}.png" for stamp in stamps_ns), ""]
    (camera / "data.csv").write_bytes(end.join(rows).encode())
    for number, stamp in enumerate(stamps_ns):
        image = np.full((48, 64), number, np.uint8)
        cv2.imwrite(str(camera / "data" / f"{stamp}.png"), image)
    shutil.copy(DATA / "sensor.yaml", camera / "sensor.yaml")
    shutil.copy(DATA / "groundtruth.csv", truth / "data.csv")
    return folder


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def sensor(folder):
    return folder / "mav0" / "cam0" / "sensor.yaml"


def truth(folder):
    return folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"


def stamps(count=40, every=1):
    return [FIRST_NS + STEP_NS * step for step in range(0, count, every)]


def agree(poses, evo):
    np.testing.assert_allclose(poses[:, :3], evo[:, 1:4], atol=2e-6)
    turn = Rotation.from_quat(poses[:, 3:]).inv() * Rotation.from_quat(evo[:, 4:])
    assert turn.magnitude().max() < 2e-6
    np.testing.assert_allclose(np.linalg.norm(poses[:, 3:], axis=1), 1, atol=1e-12)
    assert (poses[:, 6] >= 0).all()


def test_the_camera_moves_as_evo_has_it(tmp_path):
    found = open_euroc(str(recording(tmp_path / "V1_01", stamps())))
    assert not found.skipped
    agree(found.poses, np.loadtxt(DATA / "evo_camera.tum"))


def test_a_camera_in_the_body_frame_moves_as_the_body_does(tmp_path):
    folder = recording(tmp_path / "V1_01", stamps())
    text = sensor(folder).read_text()
    start, stop = text.index("["), text.index("]") + 1
    sensor(folder).write_text(text[:start] + IDENTITY + text[stop:])
    agree(open_euroc(str(folder)).poses, np.loadtxt(DATA / "evo_body.tum"))


def test_the_quaternion_is_scalar_first_and_the_camera_sits_on_the_body(tmp_path):
    folder = recording(tmp_path / "a", [FIRST_NS])
    turn = Rotation.from_rotvec([0.3, -0.5, 2.9])
    x, y, z, w = turn.as_quat()
    truth(folder).write_text(f"{FIRST_NS},1,2,3,{w},{x},{y},{z}\n")  # eight columns are enough
    text = sensor(folder).read_text()
    numbers = text[text.index("[") + 1 : text.index("]")].split(",")
    T_BS = np.array(numbers, dtype=float).reshape(4, 4)
    T = Pose.from_array(open_euroc(str(folder)).poses[0]).to_matrix()
    point_camera = np.array([0.2, -0.1, 3.0])
    point_body = T_BS[:3, :3] @ point_camera + T_BS[:3, 3]
    point_world = np.add(turn.apply(point_body), [1, 2, 3])
    np.testing.assert_allclose(T[:3, :3] @ point_camera + T[:3, 3], point_world, atol=1e-9)


def test_images_are_bgr_and_the_camera_is_that_of_sensor_yaml(tmp_path):
    found = open_euroc(str(recording(tmp_path / "V1_01", stamps(40, 10), end="\n")))
    assert (found.name, found.sequence_names) == ("V1_01", ("V1_01",))
    assert found.frame_names[0] == f"V1_01/{FIRST_NS}"
    assert found.read_image(3).shape == (48, 64, 3)
    assert found.read_image(3)[0, 0].tolist() == [3, 3, 3]
    assert found.intrinsics == (40.5, 40.25, 31.5, 24.75)
    assert found.lens.distortion == "radial_tangential"
    assert found.camera().coefficients == found.lens.coefficients != ()
    assert (found.camera().width, found.camera().height) == (64, 48)


def test_the_first_line_of_opencv_is_passed_over(tmp_path):
    folder = recording(tmp_path / "a", stamps(1))
    sensor(folder).write_text("%YAML:1.0\n" + sensor(folder).read_text())
    assert open_euroc(str(folder)).intrinsics == (40.5, 40.25, 31.5, 24.75)


@pytest.mark.parametrize("number", [".nan", "-40.5"])
def test_intrinsics_of_no_camera_are_refused(tmp_path, number):
    folder = recording(tmp_path / "a", stamps(1))
    edit(sensor(folder), "40.5", number)
    with pytest.raises(SourceError, match=r"sensor.yaml: expected finite intrinsics with"):
        open_euroc(str(folder))


def test_a_fisheye_has_an_equidistant_lens_and_other_models_are_unknown(tmp_path):
    folder = recording(tmp_path / "a", stamps(1))
    edit(sensor(folder), "radial-tangential", "equidistant")
    assert open_euroc(str(folder)).lens.distortion == "equidistant"
    edit(sensor(folder), "equidistant", "double-sphere")
    assert open_euroc(str(folder)).intrinsics is None


def test_an_image_gets_the_nearest_pose_within_five_milliseconds(tmp_path):
    last = FIRST_NS + 39 * STEP_NS + 128
    images = [
        FIRST_NS - 5_000_001,
        FIRST_NS - 5_000_000,
        FIRST_NS + 2_000_000,
        FIRST_NS + 3_000_000,
        last + 5_000_000,
        last + 5_000_001,
    ]
    found = open_euroc(str(recording(tmp_path / "a", images)))
    evo = np.loadtxt(DATA / "evo_camera.tum")
    assert found.frame_names == tuple(f"a/{stamp}" for stamp in images[1:5])
    agree(found.poses, evo[[0, 0, 1, 39]])
    assert found.skipped == {"no pose within 0.005 s": 2}


def test_invalid_poses_and_missing_images_are_skipped_and_counted(tmp_path):
    folder = recording(tmp_path / "a", stamps(4))
    (folder / "mav0" / "cam0" / "data" / f"{FIRST_NS}.png").unlink()
    lines = truth(folder).read_text().splitlines()
    lines[2] = f"{FIRST_NS + STEP_NS},1,2,3,0,0,0,0"
    lines[3] = f"{FIRST_NS + 2 * STEP_NS},1,2,nan,1,0,0,0"
    truth(folder).write_text("\n".join(lines))
    found = open_euroc(str(folder))
    assert found.frame_names == (f"a/{FIRST_NS + 3 * STEP_NS}",)
    assert found.skipped == {"image missing": 1, "invalid pose": 2}


def test_recordings_of_one_room_are_one_data_set(tmp_path):
    room = tmp_path / "vicon_room1"
    recording(room / "V1_02_medium", stamps(2))
    recording(room / "V1_01_easy", stamps(3))
    found = open_dataset(f"euroc:{room}")
    assert found.name == "vicon_room1"
    assert found.sequence_names == ("V1_01_easy", "V1_02_medium")
    assert found.sequence.tolist() == [0, 0, 0, 1, 1]
    assert len(set(found.frame_names)) == 5
    edit(sensor(room / "V1_02_medium"), "40.25", "41.25")
    with pytest.raises(SourceError) as refusal:
        open_euroc(str(room))
    assert str(refusal.value) == (
        f"{room}: expected sequences from one camera, found different cameras in V1_01_easy and "
        "V1_02_medium"
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("\t: [", "YAML with T_BS and intrinsics, found other text"),
        ("text", "YAML with T_BS and intrinsics, found other text"),
        ("date: 2014-13-45", "YAML with T_BS and intrinsics, found other text"),
        ("[" * 3000, "YAML with T_BS and intrinsics, found other text"),
        (f"T_BS: [{', '.join('1' * 99)}]", f"T_BS, 16 numbers of a rigid transform, found {ONES}"),
        ("a: 1", "T_BS, 16 numbers of a rigid transform, found none"),
        ("T_BS: [1, 2]", "T_BS, 16 numbers of a rigid transform, found [1, 2]"),
        (
            "T_BS: {data: [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}",
            "T_BS, 16 numbers of a rigid transform, found "
            "[2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]",
        ),
    ],
)
def test_a_sensor_that_states_no_transform_is_refused(tmp_path, text, expected):
    folder = recording(tmp_path / "a", stamps(1))
    sensor(folder).write_text(text)
    with pytest.raises(SourceError) as refusal:
        open_euroc(str(folder))
    assert str(refusal.value) == f"{sensor(folder)}: expected {expected}"


def test_a_sensor_that_is_missing_is_refused(tmp_path):
    folder = recording(tmp_path / "a", stamps(1))
    sensor(folder).unlink()
    with pytest.raises(SourceError) as refusal:
        open_euroc(str(folder))
    assert str(refusal.value) == (
        f"{sensor(folder)}: expected a file of a camera's T_BS and intrinsics, found none"
    )


@pytest.mark.parametrize(
    ("file", "line", "expected"),
    [
        ("cam0", "12", "timestamp,filename, found '12' in line 2"),
        ("cam0", "1" * 5000 + ",a.png", f"timestamp,filename, found {'1' * 80!r} in line 2"),
        ("cam0", "1.5,a.png", "timestamp,filename, found '1.5 a.png' in line 2"),
        (
            "state_groundtruth_estimate0",
            "12,1,2,3,1,0,0",
            "timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z, found '12 1 2 3 1 0 0' in line 2",
        ),
        (
            "state_groundtruth_estimate0",
            "12,1,2,3,1,0,0,none",
            "timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z, found '12 1 2 3 1 0 0 none' in line 2",
        ),
    ],
)
def test_a_malformed_list_is_refused_with_its_line(tmp_path, file, line, expected):
    folder = recording(tmp_path / "a", stamps(1))
    path = folder / "mav0" / file / "data.csv"
    path.write_text(f"#header\n{line}\n")
    with pytest.raises(SourceError) as refusal:
        open_euroc(str(folder))
    assert str(refusal.value) == f"{path}: expected {expected}"


def test_no_recording_is_refused(tmp_path):
    with pytest.raises(SourceError) as refusal:
        open_euroc(str(tmp_path))
    assert str(refusal.value) == (
        f"{tmp_path}: expected mav0/cam0/data.csv, or folders that contain it, found neither"
    )
