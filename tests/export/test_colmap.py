"""COLMAP models and transforms.json: poses, cameras, sequences; pycolmap writes the same model."""

import json
import struct
import tracemalloc

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.pose import Pose
from cvo_edge.trajectories.colmap import read_images
from cvo_export.datasets import open_dataset
from cvo_export.datasets.colmap_cameras import MODELS, camera_of, read_cameras

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
    folder.mkdir(parents=True, exist_ok=True)
    numbers = " ".join(map(str, CAMERA[3]))
    (folder / "cameras.txt").write_text(f"# a comment\n1 OPENCV 64 48 {numbers}\n")
    lines = [
        f"{i} {' '.join(map(repr, values))} 1 {name}\n" + ("\n" if i else "1.5 2.5 -1\n")
        for i, (name, values) in enumerate(rows())
    ]
    (folder / "images.txt").write_text("# a comment\n" + "".join(lines))
    (folder / "points3D.txt").write_text("")


def write_binary(folder):
    folder.mkdir(parents=True, exist_ok=True)
    model, width, height, values = CAMERA
    camera = struct.pack("<QiiQQ8d", 1, 1, model, width, height, *values)
    (folder / "cameras.bin").write_bytes(camera)
    content = struct.pack("<Q", len(NAMES))
    for i, (name, numbers) in enumerate(rows()):
        content += struct.pack("<i7di", i, *numbers, 1) + name.encode() + b"\0"
        content += struct.pack("<Qddq", 1, 1.5, 2.5, -1)
    (folder / "images.bin").write_bytes(content)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 0))


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
    model.read_text(str(tmp_path / "text"))
    (tmp_path / "sparse").mkdir()
    model.write_binary(str(tmp_path / "sparse"))
    write_images(tmp_path / "images")
    check(open_dataset(f"colmap:{tmp_path}"))


@pytest.mark.parametrize("write", [write_text, write_binary])
def test_pycolmap_reads_the_same_names_poses_and_cameras(tmp_path, write):
    pycolmap = pytest.importorskip("pycolmap")
    write(tmp_path)
    theirs = pycolmap.Reconstruction(str(tmp_path))
    suffix = next(tmp_path.glob("images.*")).suffix
    images = {image.name: image for image in theirs.images.values()}
    found = list(read_images(tmp_path / f"images{suffix}"))
    assert sorted(image.name for image in found) == sorted(images)
    for image in found:
        T = np.linalg.inv(np.vstack([images[image.name].cam_from_world().matrix(), [0, 0, 0, 1]]))
        np.testing.assert_allclose(Pose.from_array(image.pose).to_matrix(), T, atol=1e-9)
        assert image.camera == images[image.name].camera_id
    cameras = read_cameras(tmp_path / f"cameras{suffix}")
    assert set(cameras) == set(theirs.cameras)
    for number, camera in theirs.cameras.items():
        stated = cameras[number]
        assert (stated.model, stated.size) == (camera.model.name, (camera.width, camera.height))
        np.testing.assert_allclose(stated.values, camera.params, atol=1e-9)


def test_every_model_of_pycolmap_projects_to_the_same_pixels_or_is_refused():
    pycolmap = pytest.importorskip("pycolmap")
    points = np.array([[0.3, -0.2, 1.0], [-0.4, 0.1, 1.5]])
    lens = [0.05, -0.02, 0.003, -0.002, 0.001, 0.002, -0.001, 0.0005]
    for number, (name, count, distortion) in enumerate(MODELS):
        assert int(getattr(pycolmap.CameraModelId, name)) == number
        camera = pycolmap.Camera.create_from_model_name(1, name, 50.0, 64, 48)
        assert len(camera.params) == count
        if distortion is not None:
            focal = [50.0, 51.0][: len(camera.focal_length_idxs())]
            camera.params = [*focal, 32.5, 24.5, *lens][:count]
            ours = camera_of("x", name, (64, 48), list(camera.params)).project(points)
            theirs = camera.img_from_cam(points) - 0.5
            np.testing.assert_allclose(ours, theirs, atol=1e-9, err_msg=name)


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


PHONE, ACTION = "SIMPLE_RADIAL 64 48", "OPENCV_FISHEYE 32 24 20 20 16 12 0.1 0 0 0"


def several(root, cameras, folders):
    """Write a model with one camera for each image, in folders, of the cameras' sizes."""
    (root / "sparse").mkdir(parents=True)
    names = [f"{folder}/{i}.png" for i, folder in enumerate(folders)]
    text = "".join(f"{i + 1} {camera}\n" for i, camera in enumerate(cameras))
    (root / "sparse" / "cameras.txt").write_text(text)
    lines = [f"{i} 1 0 0 0 {i} 0 0 {i + 1} {name}\n\n" for i, name in enumerate(names)]
    (root / "sparse" / "images.txt").write_text("".join(lines))
    for camera, name in zip(cameras, names, strict=True):
        width, height = map(int, camera.split()[1:3])
        write_images(root / "images", [name], (height, width))
    return f"colmap:{root}"


def test_nearly_equal_cameras_count_as_their_median(tmp_path):
    # A lens counts by what it does in the image: these coefficients differ by a third.
    cameras = [f"{PHONE} {f} 32 24 {k}" for f, k in ((50.2, 0.012), (49.8, 0.009), (50, 0.01))]
    found = open_dataset(several(tmp_path / "a", cameras, "ppp"))
    assert found.intrinsics == (50.0, 50.0, 31.5, 23.5)
    assert found.lens.coefficients == (0.01, 0.0, 0.0, 0.0)
    text = "3 cameras count as one, the median of focal lengths 49.8 to 50.2 px"
    assert (len(found), found.chosen) == (3, text)
    found = open_dataset(several(tmp_path / "b", [ACTION] * 2, "aa"))
    assert found.chosen == "2 equal cameras count as one"


def test_one_of_several_cameras_is_chosen_with_those_like_it(tmp_path):
    cameras = [*(f"{PHONE} {f} 32 24 0" for f in (50, 50.1, 60)), ACTION, "FOV 64 48 9 9 32 24 0"]
    text = several(tmp_path / "scene", cameras, "pqpax")
    with pytest.raises(SourceError) as refusal:
        open_dataset(text)
    assert str(refusal.value) == (
        f"{tmp_path}/scene/sparse: expected images of one camera, within 1%, found cameras 1, 2 "
        "(SIMPLE_RADIAL 64x48, 2 images in folders p, q), camera 3 (SIMPLE_RADIAL 64x48, 1 image "
        "in folder p), camera 4 (OPENCV_FISHEYE 32x24, 1 image in folder a), camera 5 (FOV 64x48, "
        f"1 image in folder x); choose one, e.g. {text},camera=1, which leaves the images of the "
        "others out"
    )
    found = open_dataset(f"{text},camera=2")
    assert found.frame_names == ("p/0", "q/1")
    assert found.skipped == {"of another camera": 3}
    assert found.chosen.startswith("cameras 1, 2 (SIMPLE_RADIAL 64x48, 2 images in folders p, q); ")
    found = open_dataset(f"{text},camera=4")
    assert (found.frame_names, found.intrinsics) == (("a/3",), (20.0, 20.0, 15.5, 11.5))
    with pytest.raises(SourceError, match=r"camera= to name one of cameras 1, 2 .*found '7'$"):
        open_dataset(f"{text},camera=7")
    with pytest.raises(SourceError, match=r"line 5: expected a camera model .*, found FOV"):
        open_dataset(f"{text},camera=5")
    with pytest.raises(UsageError, match="colmap: expected PATH and any of camera= once, found"):
        open_dataset(f"{text},lens=2")
    # Cameras whose images are not there do not count.
    for name in ("p/2", "a/3", "x/4"):
        (tmp_path / "scene" / "images" / f"{name}.png").unlink()
    assert open_dataset(text).skipped == {"image missing": 3}


def test_keypoints_take_no_memory(tmp_path):
    """60 GB of keypoints, in a file with a hole, and a line of 30 MB."""
    head = struct.pack("<Qi7di", 2, 1, 1, *[0.0] * 6, 1) + b"a.png\0"
    rest = struct.pack("<i7di", 2, 1, *[0.0] * 6, 1) + b"b.png\0" + bytes(8)
    binary, text = tmp_path / "images.bin", tmp_path / "images.txt"
    with binary.open("wb") as stream:
        stream.write(head + struct.pack("<Q", 2_500_000_000))
        stream.seek(24 * 2_500_000_000, 1)
        stream.write(rest)
    line = "1 1 0 0 0 0 0 0 1 a.png\n"
    text.write_text(line + "1.5 2.5 -1 " * 3_000_000 + "\n" + line.replace("a.png", "b.png"))
    for path in (binary, text):
        tracemalloc.start()
        assert [image.name for image in read_images(path)] == ["a.png", "b.png"]
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
        tracemalloc.stop()


IMAGE = "1 1 0 0 0 0 0 0 1 a.png\n"


@pytest.mark.parametrize(
    ("file", "content", "expected"),
    [
        ("images.txt", IMAGE * 2, f"a line of keypoints.*, found '{IMAGE[:-1]}' in line 2"),
        ("images.txt", IMAGE.replace("a.png", "a" * 9000), "of less than 8192 bytes, .* in line 1"),
        ("images.txt", b"1 1 0 0 0 0 0 0 1 \xff.png\n", "IMAGE_ID .* in line 1"),
        ("images.bin", struct.pack("<Q", 1 << 40), "at most 0 images, not 1099511627776, .*byte 8"),
        ("images.bin", struct.pack("<Q", 1) + b"x" * 5000, "a name that ends, found 5008 bytes"),
        ("cameras.bin", struct.pack("<Q", 9) + bytes(80), "at most 2 cameras, not 9, .*byte 8"),
        ("cameras.txt", "1 PINHOLE 4 4 1 1 1 1\n" * 2, "each camera once .*, found camera 1 again"),
        ("cameras.txt", "1 PINHOLE 4 4\n", "line 1: expected 4 parameters of PINHOLE, found 0"),
    ],
)
def test_malformed_files_are_refused_with_their_place(tmp_path, file, content, expected):
    write_images(tmp_path / "images")
    (write_text if file.endswith(".txt") else write_binary)(tmp_path)
    (tmp_path / file).write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(SourceError, match=f"{tmp_path / file}: .*{expected}"):
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
