"""COLMAP models and transforms.json: poses, cameras, sequences; pycolmap writes the same model."""

import json
import struct

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvo_edge.errors import SourceError
from cvo_edge.pose import Pose
from cvo_export.datasets import open_dataset
from cvo_export.datasets.colmap import camera_of

NAMES = ("b/2.png", "a/10.png", "a/9.png")
CAMERA = (4, 64, 48, (50.0, 51.0, 32.5, 24.5, 0.1, -0.2, 0.01, 0.02))


def poses():
    count = len(NAMES)
    generator = np.random.default_rng(0)
    turns = Rotation.random(count, random_state=0)
    found = np.tile(np.eye(4), (count, 1, 1))
    found[:, :3, :3], found[:, :3, 3] = turns.as_matrix(), generator.normal(size=(count, 3))
    return found


def write_images(root, names=NAMES, size=(48, 64)):
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.full((*size, 3), 90, np.uint8))


def rows():
    """Each image's name and its world-to-camera quaternion (scalar first) and translation."""
    for name, T in zip(NAMES, poses(), strict=True):
        inverse = np.linalg.inv(T)
        q = np.roll(Rotation.from_matrix(inverse[:3, :3]).as_quat(), 1)
        yield name, [*q.tolist(), *inverse[:3, 3].tolist()]


def write_text(folder):
    folder.mkdir(parents=True)
    numbers = " ".join(map(str, CAMERA[3]))
    (folder / "cameras.txt").write_text(f"# a comment\n1 OPENCV 64 48 {numbers}\n")
    lines = [
        f"{i} {' '.join(map(repr, values))} 1 {name}\n" + ("\n" if i else "1.5 2.5 -1\n")
        for i, (name, values) in enumerate(rows())
    ]
    (folder / "images.txt").write_text("# a comment\n" + "".join(lines))


def write_binary(folder):
    folder.mkdir(parents=True)
    model, width, height, values = CAMERA
    camera = struct.pack("<QiiQQ8d", 1, 1, model, width, height, *values)
    (folder / "cameras.bin").write_bytes(camera)
    content = struct.pack("<Q", len(NAMES))
    for i, (name, numbers) in enumerate(rows()):
        content += struct.pack("<i7di", i, *numbers, 1) + name.encode() + b"\0"
        content += struct.pack("<Qddq", 1, 1.5, 2.5, -1)
    (folder / "images.bin").write_bytes(content)


def check(found):
    assert found.frame_names == ("a/9", "a/10", "b/2")
    assert found.sequence_names == ("a", "b")
    for pose, T in zip(found.poses, poses()[::-1], strict=True):
        np.testing.assert_allclose(Pose.from_array(pose).to_matrix(), T, atol=1e-12)
    assert found.intrinsics == (50.0, 51.0, 32.0, 24.0)
    assert found.lens == ("radial_tangential", (0.1, -0.2, 0.01, 0.02))


@pytest.mark.parametrize("write", [write_text, write_binary])
@pytest.mark.parametrize("below", ["", "sparse/0"])
def test_a_model_gives_poses_camera_and_sequences(tmp_path, write, below):
    write(tmp_path / "sparse" / "0")
    write_images(tmp_path / "images")
    check(open_dataset(f"colmap:{tmp_path if not below else tmp_path / below}"))


def test_pycolmap_writes_what_is_read(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    write_text(tmp_path / "text")
    model = pycolmap.Reconstruction()
    (tmp_path / "text" / "points3D.txt").write_text("")
    model.read_text(str(tmp_path / "text"))
    (tmp_path / "sparse").mkdir()
    model.write_binary(str(tmp_path / "sparse"))
    write_images(tmp_path / "images")
    check(open_dataset(f"colmap:{tmp_path}"))


def test_pixel_centres_agree_with_opencv_and_the_model_without_a_counterpart_is_refused():
    for model, values in (
        ("SIMPLE_RADIAL", [50.0, 32.0, 24.0, 0.1]),
        ("RADIAL", [50.0, 32.0, 24.0, 0.1, 0.02]),
        ("SIMPLE_PINHOLE", [50.0, 32.0, 24.0]),
    ):
        camera = camera_of("x", model, (64, 48), values)
        point = np.array([[0.3, -0.2, 1.0]])
        r2 = 0.3**2 + 0.2**2
        k = [*values[3:], 0.0, 0.0]
        expected = 50.0 * point[:, :2] * (1 + k[0] * r2 + k[1] * r2**2) + [31.5, 23.5]
        np.testing.assert_allclose(camera.project(point), expected)
    fisheye = camera_of("x", "OPENCV_FISHEYE", (64, 48), [50, 50, 32, 24, 0.1, 0, 0, 0])
    assert fisheye.distortion == "equidistant"
    with pytest.raises(SourceError, match=r"x: expected a camera model .*, found FOV; undistort"):
        camera_of("x", "FOV", (64, 48), [50, 50, 32, 24, 0.1])
    with pytest.raises(SourceError, match="x: expected 4 parameters of PINHOLE, found 3"):
        camera_of("x", "PINHOLE", (64, 48), [50, 32, 24])


def test_broken_models_are_refused_with_their_place(tmp_path):
    with pytest.raises(SourceError, match=r"expected cameras\.bin and images\.bin, or"):
        open_dataset(f"colmap:{tmp_path}")
    write_binary(tmp_path / "sparse")
    with pytest.raises(SourceError, match="expected the images in a folder images"):
        open_dataset(f"colmap:{tmp_path}")
    write_images(tmp_path / "images")
    file = tmp_path / "sparse" / "images.bin"
    whole = file.read_bytes()
    for length in (0, 7, 40, 70, len(whole) - 1):
        file.write_bytes(whole[:length])
        with pytest.raises(SourceError, match=r"images.bin: expected .*, found \d+ bytes"):
            open_dataset(f"colmap:{tmp_path}")
    write_text(tmp_path / "t" / "sparse")
    write_images(tmp_path / "t" / "images")
    (tmp_path / "t" / "sparse" / "images.txt").write_text("1 1 0 0 0 0 0 zero 1 a/9.png\n\n")
    with pytest.raises(SourceError, match=r"images.txt: expected IMAGE_ID .* in line 1"):
        open_dataset(f"colmap:{tmp_path / 't'}")


@pytest.mark.parametrize("name", ["../secret.png", "/etc/secret.png"])
def test_an_image_outside_the_folder_of_images_is_refused(tmp_path, name):
    write_images(tmp_path / "images")
    write_text(tmp_path / "sparse/0")
    listed = tmp_path / "sparse/0/images.txt"
    listed.write_text(listed.read_text().replace(NAMES[0], name))
    with pytest.raises(SourceError, match=f"expected names of images below .*found '{name}'"):
        open_dataset(f"colmap:{tmp_path}")


def transforms(root, shared, each=lambda i: {}):
    axes = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": f"images/{i}", "transform_matrix": (T @ axes).tolist(), **each(i)}
        for i, T in enumerate(poses())
    ]
    root.mkdir(exist_ok=True)
    write_images(root / "images", [f"{i}.png" for i in range(3)])
    (root / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    return open_dataset(f"nerfstudio:{root}")


def test_transforms_have_opengl_axes_and_a_camera(tmp_path):
    camera = {"fl_x": 50.0, "fl_y": 51.0, "cx": 32.5, "cy": 24.5, "w": 64, "h": 48}
    lens = {"k1": 0.1, "k2": -0.2, "p1": 0.01, "p2": 0.02, "camera_model": "OPENCV"}
    found = transforms(tmp_path / "a", {**camera, **lens})
    for pose, T in zip(found.poses, poses(), strict=True):
        np.testing.assert_allclose(Pose.from_array(pose).to_matrix(), T, atol=1e-12)
    assert found.intrinsics == (50.0, 51.0, 32.0, 24.0)
    assert found.lens == ("radial_tangential", (0.1, -0.2, 0.01, 0.02))
    found = transforms(tmp_path / "b", {}, lambda i: camera)
    assert found.intrinsics == (50.0, 51.0, 32.0, 24.0)
    assert found.lens == ("none", ())
    found = transforms(tmp_path / "c", {"camera_angle_x": np.pi / 2})
    np.testing.assert_allclose(found.intrinsics, (32.0, 32.0, 31.5, 23.5))
    assert transforms(tmp_path / "d", {}).intrinsics is None
    with pytest.raises(SourceError, match="different cameras in frame 0 and frame 1"):
        transforms(tmp_path / "e", {}, lambda i: {**camera, "fl_x": 50.0 + i})


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("{", "expected JSON"),
        ("[]", "expected a list frames"),
        ('{"frames": [{"file_path": 1}]}', "expected file_path and transform_matrix in frame 0"),
    ],
)
def test_broken_transforms_are_refused(tmp_path, text, rule):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(SourceError, match=rule):
        open_dataset(f"nerfstudio:{tmp_path}")
