"""``--ground-truth`` reads what training reads, and gives each frame the same pose."""

import json
import os
import shutil
import struct
import subprocess

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from cvo_edge.errors import SourceError
from cvo_edge.ground_truth import open_ground_truth
from cvo_edge.pose import Pose
from cvo_edge.trajectories.euroc import read_euroc
from cvo_edge.trajectories.kitti import read_kitti
from cvo_edge.trajectories.tum import read_tum
from cvo_edge.trajectories.tum_vi import read_imu_camera
from cvo_export.datasets import open_dataset

from .test_layouts import START_NS, T_CAMERA_IMU, ace, imu, tum_vi
from .true_poses import estimates, same_as_training

COUNT = 4
STAMPS_NS = [1_403_636_579_763_555_584 + 50_000_000 * i for i in range(COUNT)]
SECONDS = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in STAMPS_NS]
T_BODY_CAMERA = np.eye(4)
T_BODY_CAMERA[:3, :3] = Rotation.from_rotvec([0.1, -1.5, 0.3]).as_matrix()
T_BODY_CAMERA[:3, 3] = (0.05, -0.02, 0.01)


def poses():
    """T_world_camera (COUNT, 4, 4)."""
    T = np.tile(np.eye(4), (COUNT, 1, 1))
    T[:, :3, :3] = Rotation.random(COUNT, random_state=3).as_matrix()
    T[:, :3, 3] = np.random.default_rng(3).normal(size=(COUNT, 3))
    return T


def quaternion(T):
    return Rotation.from_matrix(T[:3, :3]).as_quat().tolist()


def text(values, separator=" "):
    return separator.join(repr(float(value)) for value in np.ravel(values))


def images(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.full((8, 8, 3), 90, np.uint8))
    return folder


def seven_scenes(root):
    names = [f"frame-{i:06d}" for i in range(COUNT)]
    for name, T in zip(names, poses(), strict=True):
        (root / f"{name}.pose.txt").write_text("\n".join(map(text, T)))
    return "7scenes", root, images(root, [f"{name}.color.png" for name in names]), root


def scannet(root):
    frames = images(root / "color", [f"{i}.png" for i in range(COUNT)])
    (root / "pose").mkdir()
    (root / "intrinsic").mkdir()
    K = np.eye(4)
    K[:2, 2] = 4.0
    (root / "intrinsic" / "intrinsic_color.txt").write_text("\n".join(map(text, K)))
    for i, T in enumerate(poses()):
        (root / "pose" / f"{i}.txt").write_text("\n".join(map(text, T)))
    return "scannet", root, frames, root / "pose"


def tum(root):
    rows = [
        f"{stamp} {text([*T[:3, 3], *quaternion(T)])}\n"
        for stamp, T in zip(SECONDS, poses(), strict=True)
    ]
    path = root / "groundtruth.txt"
    path.write_text("".join(rows))
    (root / "rgb.txt").write_text("".join(f"{s} rgb/{s}.png\n" for s in SECONDS))
    return "tum", root, images(root / "rgb", [f"{s}.png" for s in SECONDS]), path


def euroc(root):
    folder = root / "mav0" / "state_groundtruth_estimate0"
    folder.mkdir(parents=True)
    rows = ["#timestamp,p_x,..."]
    for stamp, T in zip(STAMPS_NS, poses() @ np.linalg.inv(T_BODY_CAMERA), strict=True):
        x, y, z, w = quaternion(T)
        rows.append(f"{stamp},{text([*T[:3, 3], w, x, y, z], ',')},0,0")
    (folder / "data.csv").write_text("\r\n".join(rows))
    camera = root / "mav0" / "cam0"
    frames = images(camera / "data", [f"{stamp}.png" for stamp in STAMPS_NS])
    (camera / "data.csv").write_text("".join(f"{stamp},{stamp}.png\n" for stamp in STAMPS_NS))
    numbers = text(T_BODY_CAMERA, ", ")
    (camera / "sensor.yaml").write_text(
        f"%YAML:1.0\n# a [comment]\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\nrate_hz: 20\n"
    )
    return "euroc", root, frames, root


def kitti(root):
    sequence = root / "sequences" / "07"
    frames = images(sequence / "image_2", [f"{i:06d}.png" for i in range(COUNT)])
    offset = np.eye(4)
    offset[:3, 3] = (-0.06, 0.002, -0.005)
    projection = np.diag([700.0, 710.0, 1.0, 1.0])[:3] @ offset
    (sequence / "calib.txt").write_text(f"P0: {text(np.eye(4)[:3])}\nP2: {text(projection)}\n")
    (root / "poses").mkdir()
    rows = [text(T[:3]) for T in poses() @ offset]
    (root / "poses" / "07.txt").write_text("\n".join(rows))
    return "kitti", sequence, frames, root / "poses" / "07.txt"


def rgbd_scenes(root):
    frames = images(root / "imgs" / "scene_01", [f"{i:05d}-color.png" for i in range(COUNT)])
    (root / "pc").mkdir()
    rows = [text([*np.roll(quaternion(T), 1), *T[:3, 3]]) for T in poses()]
    (root / "pc" / "01.pose").write_text("\n".join(rows))
    return "rgbd-scenes", root, frames, frames


def colmap(root, binary=False):
    frames = images(root / "images", [f"{i}.png" for i in range(COUNT)])
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    inverses = np.linalg.inv(poses())
    rows = [[*np.roll(quaternion(T), 1), *T[:3, 3]] for T in inverses]
    if binary:
        (model / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 8, 8, 9, 9, 4, 4))
        content = struct.pack("<Q", COUNT)
        for i, row in enumerate(rows):
            content += struct.pack("<i7di", i, *row, 1) + f"{i}.png".encode() + b"\0" + bytes(8)
        (model / "images.bin").write_bytes(content)
        return "colmap", root, frames, root
    (model / "cameras.txt").write_text("1 PINHOLE 8 8 9 9 4 4\n")
    lines = [f"{i} {text(row)} 1 {i}.png\n\n" for i, row in enumerate(rows)]
    (model / "images.txt").write_text("".join(lines))
    return "colmap", root, frames, model / "images.txt"


def colmap_binary(root):
    return colmap(root, binary=True)


def nerfstudio(root):
    frames = images(root / "images", [f"{i}.png" for i in range(COUNT)])
    axes = np.diag([1.0, -1.0, -1.0, 1.0])
    listed = [
        {"file_path": f"images/{i}.png", "transform_matrix": (T @ axes).tolist()}
        for i, T in enumerate(poses())
    ]
    (root / "transforms.json").write_text(json.dumps({"fl_x": 9.0, "frames": listed}))
    return "nerfstudio", root, frames, root / "transforms.json"


@pytest.mark.parametrize(
    "write",
    [seven_scenes, scannet, tum, euroc, kitti, rgbd_scenes, colmap, colmap_binary, nerfstudio],
)
def test_frames_get_the_poses_that_training_gives_them(tmp_path, write):
    form, root, frames, path = write(tmp_path)
    truth = open_ground_truth(path, frames)
    found = np.array([truth.pose_of(estimate) for estimate in estimates(frames)])
    np.testing.assert_array_equal(found, open_dataset(f"{form}:{root}").poses)
    matrices = [Pose.from_array(pose).to_matrix() for pose in found]
    np.testing.assert_allclose(matrices, poses(), atol=1e-9)


@pytest.mark.parametrize("place", [".", "mav0/mocap0", "mav0/mocap0/data.csv", "dso/gt_imu.csv"])
def test_tum_vi_is_interpolated_as_in_training(tmp_path, place, monkeypatch):
    root = tum_vi(tmp_path / "room1", visits=((0.0, 0.5), (0.8, 1.1)), end=1.0)
    poses = root / "mav0" / "mocap0" / "data.csv"
    lines = poses.read_text().splitlines()
    lines[20] = lines[20].rpartition(",")[0] + ",7"  # no quaternion
    poses.write_text("\n".join(lines))
    if place == "dso/gt_imu.csv":
        poses.rename(root / place)
    images = root / "mav0" / "cam0" / "data"
    truth = same_as_training(f"tum-vi:{root}", [images], root / place)
    assert truth.found.note == "moved from the IMU to cam0"
    assert str(truth.skipped).startswith("skipped 1: invalid pose 1 (first in ")
    assert truth.spans(START_NS, START_NS).endswith("at 1520530308.199 .. 1520530309.299 s")
    # Another camera of the recording has its own way from the IMU.
    chain = root / "dso" / "camchain.yaml"
    cameras = yaml.safe_load(chain.read_text())
    T_other_imu = T_CAMERA_IMU @ T_CAMERA_IMU
    cameras["cam1"]["T_cam_imu"] = T_other_imu.tolist()
    chain.write_text(yaml.safe_dump(cameras))
    (root / "mav0" / "cam0").rename(root / "mav0" / "cam1")
    monkeypatch.chdir(root / "mav0" / "cam1" / "data")
    first, *_ = estimates(".")
    T = Pose.from_array(open_ground_truth(root / place, ".").pose_of(first)).to_matrix()
    expected = imu((first.stamp_ns - START_NS) / 1e9) @ np.linalg.inv(T_other_imu)
    np.testing.assert_allclose(T, expected, atol=1e-6)


def test_ace_poses_belong_to_the_images_at_their_place(tmp_path):
    parts = [tmp_path / "train", tmp_path / "test"]
    for part, count in zip(parts, (3, 2), strict=True):
        names = [f"{part.name}-frame-{number:06d}" for number in range(count)]
        ace(part, names, lambda number: "52.5")
        for number, pose in enumerate(sorted((part / "poses").iterdir())):
            pose.rename(pose.with_name(f"{number:04d}.txt"))
    (parts[0] / "poses" / "0001.txt").write_text("nan " * 16)
    same_as_training(f"ace:{tmp_path}", [part / "rgb" for part in parts], tmp_path)
    for place in (parts[1], parts[1] / "poses"):
        same_as_training(f"ace:{parts[1]}", [parts[1] / "rgb"], place)
    with pytest.raises(SourceError, match=rf"found those of {tmp_path}; name one .* {parts[1]}$"):
        open_ground_truth(tmp_path, tmp_path)
    (parts[1] / "poses" / "0001.txt").unlink()
    with pytest.raises(SourceError, match="expected as many files in poses as in rgb, found 1 and"):
        open_ground_truth(parts[1], tmp_path)


def test_kalibr_s_file_is_read_as_by_yaml(tmp_path):
    """In every layout that YAML's writers give it."""
    path = tmp_path / "camchain.yaml"
    T = T_CAMERA_IMU.copy()
    T[0, 3] = -1e-7
    camera = {"T_cam_imu": T.tolist(), "camera_model": "pinhole", "rostopic": "/cam1/image"}
    second = {"cam_overlaps": [0], "T_cn_cnm1": np.eye(4).tolist(), "T_cam_imu": [*range(3)]}
    for flow in (None, False, True):
        for width, order in ((80, True), (20, False), (1000, False)):
            text = yaml.safe_dump(
                {"cam0": camera, "cam1": second},
                default_flow_style=flow,
                width=width,
                sort_keys=order,
            )
            path.write_text(f"%YAML:1.0\n# cam0: T_cam_imu\n{text}")
            written = np.array(yaml.safe_load(text)["cam0"]["T_cam_imu"], float)
            np.testing.assert_array_equal(read_imu_camera(path), np.linalg.inv(written))
            with pytest.raises(SourceError, match=r"T_cam_imu of cam1, 16 numbers .* found \["):
                read_imu_camera(path, "cam1")


EVO = shutil.which("evo_traj")


@pytest.mark.skipif(EVO is None, reason="evo is not installed")
@pytest.mark.parametrize("write", [tum, kitti, euroc])
def test_evo_reads_the_same_poses(tmp_path, write):
    form, root, _, path = write(tmp_path)
    if form == "euroc":
        path = root / "mav0" / "state_groundtruth_estimate0" / "data.csv"
        trajectory = read_euroc(path, np.eye(4))
    else:
        trajectory = read_tum(path) if form == "tum" else read_kitti(path, np.eye(4))
    command = [EVO, form, path, "--save_as_kitti", "--no_warnings"]
    environment = {**os.environ, "HOME": str(tmp_path), "MPLBACKEND": "agg"}
    subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True)
    evo = np.loadtxt(tmp_path / f"{path.stem}.kitti").reshape(-1, 3, 4)
    found = [Pose.from_array(pose).to_matrix()[:3] for pose in trajectory.poses]
    np.testing.assert_allclose(found, evo, atol=1e-9)


def test_what_leads_to_the_camera_is_needed(tmp_path):
    _, root, frames, path = euroc(tmp_path / "a")
    (root / "mav0" / "cam0" / "sensor.yaml").unlink()
    with pytest.raises(SourceError, match=r"expected .*/mav0/cam0/sensor.yaml with T_BS"):
        open_ground_truth(path, frames)
    (tmp_path / "b").mkdir()
    _, root, frames, path = kitti(tmp_path / "b")
    (root / "calib.txt").unlink()
    with pytest.raises(SourceError, match=r"expected .*/07/calib.txt, which leads from camera 0"):
        open_ground_truth(path, frames)
    # Frames that nothing tells about are those of camera 0.
    assert open_ground_truth(path, tmp_path).found.note == ""
    folder = tum_vi(tmp_path / "c", [(0.0, 0.1)], 0.05)
    (folder / "dso" / "camchain.yaml").unlink()
    with pytest.raises(SourceError, match=r"expected .*/dso/camchain.yaml with T_cam_imu"):
        open_ground_truth(folder, tmp_path)


def test_other_files_are_refused_with_the_formats(tmp_path):
    with pytest.raises(SourceError, match=r"a: no such file; expected a folder of"):
        open_ground_truth(tmp_path / "a")
    other = tmp_path / "b.txt"
    other.write_text("# a\n1 2 3\n")
    with pytest.raises(SourceError, match=r"COLMAP .*, found '1 2 3' in line 2$"):
        open_ground_truth(other)


def test_images_of_one_name_need_their_folder(tmp_path):
    frames = [
        {"file_path": f"{folder}/1.png", "transform_matrix": np.diag([1, -1, -1, 1.0]).tolist()}
        for folder in ("a", "b")
    ]
    frames[1]["transform_matrix"][0][3] = 5.0
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": frames}))
    with pytest.raises(SourceError, match=r"found a/1.png and b/1.png; run on one of the folders"):
        open_ground_truth(path, tmp_path)
    folder = images(tmp_path / "b", ["1.png"])
    truth = open_ground_truth(path, folder)
    assert [truth.pose_of(estimate)[0] for estimate in estimates(folder)] == [5.0]
