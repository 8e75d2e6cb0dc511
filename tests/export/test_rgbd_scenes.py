"""RGB-D Scenes v2: scalar-first quaternions, one world per scene, skipped and refused input."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvo_edge.errors import SourceError
from cvo_edge.pose import Pose
from cvo_export.datasets import open_dataset
from cvo_export.datasets.describe import describe
from cvo_export.datasets.rgbd_scenes import open_rgbd_scenes

TURN = Rotation.from_rotvec([0.3, -0.5, 2.9])  # all quaternion components differ
X, Y, Z, W = TURN.as_quat()
LINES = [
    "1 0 0 0 0 0 0",
    f"{W:.6f} {X:.6f} {Y:.6f} {Z:.6f} 0.5 -0.25 1.5",
    f"{-W:.6f} {-X:.6f} {-Y:.6f} {-Z:.6f} 1 2 3",
]


def scene(root, name="01", lines=LINES, images=3, end="\n"):
    folder = root / "imgs" / f"scene_{name}"
    folder.mkdir(parents=True)
    (root / "pc").mkdir(exist_ok=True)
    (root / "pc" / f"{name}.pose").write_bytes((end.join(lines) + end).encode())
    for number in range(images):
        image = np.full((48, 64, 3), 10 * number, np.uint8)
        cv2.imwrite(str(folder / f"{number:05d}-color.png"), image)
        cv2.imwrite(str(folder / f"{number:05d}-depth.png"), np.zeros((48, 64), np.uint16))
    return folder


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_line_is_a_scalar_first_quaternion_then_a_position(tmp_path, end):
    found = open_rgbd_scenes(str(scene(tmp_path, end=end)))
    assert found.name == "scene_01"
    assert found.sequence_names == ("scene_01",)
    assert found.frame_names == ("scene_01/00000", "scene_01/00001", "scene_01/00002")
    np.testing.assert_array_equal(found.poses[0], [0, 0, 0, 0, 0, 0, 1])
    T = Pose.from_array(found.poses[1]).to_matrix()
    np.testing.assert_allclose(T[:3, :3], TURN.as_matrix(), atol=2e-6)
    np.testing.assert_array_equal(T[:3, 3], [0.5, -0.25, 1.5])
    # The camera looks along its z axis, so this point is one metre ahead of it.
    ahead = np.add(TURN.apply([0, 0, 1]), [0.5, -0.25, 1.5])
    np.testing.assert_allclose((T @ [0, 0, 1, 1])[:3], ahead, atol=2e-6)
    # Both signs of a quaternion are the same rotation, which is read with qw >= 0.
    np.testing.assert_allclose(found.poses[2][3:], found.poses[1][3:], atol=1e-12)
    assert (found.poses[:, 6] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(found.poses[:, 3:], axis=1), 1, atol=1e-12)


def test_images_are_colour_and_the_camera_is_scaled_to_them(tmp_path):
    found = open_rgbd_scenes(str(scene(tmp_path)))
    assert found.read_image(2).shape == (48, 64, 3)
    assert found.read_image(2)[0, 0].tolist() == [20, 20, 20]
    assert found.left_out == {"marked depth": 3}
    assert "left out    3 files: marked depth 3" in describe(found)
    assert found.intrinsics == pytest.approx((57.03, 57.03, 32, 24))


def test_a_root_will_do_where_it_holds_one_scene(tmp_path):
    scene(tmp_path)
    found = open_dataset(f"rgbd-scenes:{tmp_path}")
    assert (found.name, len(found)) == ("scene_01", 3)


def test_several_scenes_are_refused_by_name(tmp_path):
    scene(tmp_path, "02")
    first = scene(tmp_path, "01")
    with pytest.raises(SourceError) as refusal:
        open_rgbd_scenes(str(tmp_path))
    assert str(refusal.value) == (
        f"{tmp_path}: expected one scene imgs/scene_NN, because each has its own world frame, "
        f"found scene_01, scene_02; choose one, e.g. {first}"
    )


def test_frames_without_counterpart_and_invalid_poses_are_skipped_and_counted(tmp_path):
    lines = [*LINES, "nan 0 0 0 0 0 0", "0 0 0 0 1 1 1", "0.5 0 0 0 0 0 0", "1 0 0 0 inf 0 0"]
    folder = scene(tmp_path, lines=lines, images=9)
    (folder / "00001-color.png").unlink()
    found = open_rgbd_scenes(str(folder))
    # Lines are matched to images by frame number, not by position in the listing.
    assert found.frame_names == ("scene_01/00000", "scene_01/00002")
    np.testing.assert_array_equal(found.poses[1][:3], [1, 2, 3])
    assert found.skipped == {"image missing": 1, "invalid pose": 4, "no pose": 2}


@pytest.mark.parametrize(
    ("lines", "found"),
    [
        (["1 0 0 0 0 0"], "'1 0 0 0 0 0' in line 1"),
        (["1 0 0 0 0 0 0", "", "1 0 0 0 0 0 0"], "'' in line 2"),
        (["1 0 0 0 0 0 0", "1 0 0 0 0 0 x"], "'1 0 0 0 0 0 x' in line 2"),
    ],
)
def test_a_line_that_is_no_frame_is_refused(tmp_path, lines, found):
    folder = scene(tmp_path, lines=lines)
    with pytest.raises(SourceError) as refusal:
        open_rgbd_scenes(str(folder))
    path = tmp_path / "pc" / "01.pose"
    assert str(refusal.value) == f"{path}: expected a b c d x y z, found {found}"


def test_what_is_missing_is_said(tmp_path):
    folder = scene(tmp_path)
    (tmp_path / "pc" / "01.pose").unlink()
    with pytest.raises(SourceError, match=r"pc/01.pose: expected a file of .*, found none$"):
        open_rgbd_scenes(str(folder))
    with pytest.raises(SourceError, match=r"expected a scene imgs/scene_NN, found none$"):
        open_rgbd_scenes(str(tmp_path / "pc"))
