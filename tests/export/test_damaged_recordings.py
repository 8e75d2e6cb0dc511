"""Recordings with numbers, names and files that no reader expects: one line, or a counted frame."""

import json
import re

import cv2
import numpy as np
import pytest

from cvo_edge.errors import SourceError, UsageError
from cvo_export.datasets import FORMATS, open_dataset
from cvo_export.datasets.describe import describe
from cvo_export.datasets.sizes import one_size
from cvo_export.training.loop import train

from .conftest import ignore_progress, tiny_config


@pytest.fixture
def scene(tmp_path):
    """A ``transforms.json`` of two cameras' folders with images, each called ``images``."""
    frames = []
    for number in range(4):
        name = f"{'ab'[number % 2]}/images/{number // 2}.png"
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / name), np.full((48, 64, 3), 90, np.uint8))
        frames.append({"file_path": name, "transform_matrix": np.eye(4).tolist()})
    document = {"w": 64, "h": 48, "fl_x": 58.5, "frames": frames}

    def written(change=None):
        if change:
            change(document)
        (tmp_path / "transforms.json").write_text(json.dumps(document))
        return open_dataset(f"nerfstudio:{tmp_path}")

    return written


def test_folders_of_one_name_are_recordings_of_their_own(scene):
    found = scene()
    assert len(found) == 4
    assert found.sequence_names == ("a/images", "b/images")


@pytest.mark.parametrize(
    "camera",
    [
        {"w": float("inf")},
        {"fl_x": 10**400},
        {"fl_x": None, "camera_angle_x": 10**400},
        {"w": 48, "h": 64},
        {"w": 10**30},
    ],
)
def test_cameras_that_are_not_those_of_the_images_are_refused(scene, camera):
    with pytest.raises(SourceError, match=r"transforms.json: expected"):
        scene(lambda document: document.update(camera))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        ({"file_path": "x" * 300}, "image missing"),
        ({"transform_matrix": [[10**400] * 4] * 4}, "invalid pose"),
        ({"transform_matrix": [[float("inf")] * 4] * 4}, "invalid pose"),
        ({"transform_matrix": (np.eye(4) + np.diag([1e200] * 3, 1)).tolist()}, "invalid pose"),
        ({"transform_matrix": np.c_[np.eye(4, 3), [1e200, 0, 0, 1]].tolist()}, "invalid pose"),
    ],
)
def test_frames_that_cannot_be_are_counted(scene, frame, reason):
    found = scene(lambda document: document["frames"][1].update(frame))
    assert len(found) == 3
    assert found.skipped == {reason: 1}


@pytest.mark.parametrize("kind", sorted(FORMATS.keys() - {"synthetic"}))
def test_a_path_too_long_is_refused_by_every_reader(kind):
    with pytest.raises(SourceError, match=r"name too long|found"):
        open_dataset(f"{kind}:{'a' * 300}")


@pytest.mark.parametrize("stamp", ["9403636579763555584", "1" + "0" * 19])
def test_stamps_beyond_64_bits_are_refused(tmp_path, stamp):
    folder = tmp_path / "mav0" / "cam0"
    folder.mkdir(parents=True)
    (folder / "data.csv").write_text(f"{stamp},{stamp}.png\n")
    (folder / "sensor.yaml").write_text("T_BS: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]\n")
    with pytest.raises(SourceError, match="line 1"):
        open_dataset(f"euroc:{tmp_path}")


@pytest.mark.parametrize(("size", "focal"), [((48, 64), 58.5), ((24, 32), 29.25), ((32, 32), None)])
def test_a_sensor_s_camera_is_that_of_resized_images(tmp_path, size, focal):
    folder = tmp_path / "mav0" / "cam0"
    (folder / "data").mkdir(parents=True)
    cv2.imwrite(str(folder / "data" / "5.png"), np.full(size, 90, np.uint8))
    (folder / "data.csv").write_text("5,5.png\n")
    (folder / "sensor.yaml").write_text(
        "T_BS: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]\nresolution: [64, 48]\ncamera_model: pinhole\n"
        "intrinsics: [58.5, 58.5, 32, 24]\ndistortion_model: radtan\n"
        "distortion_coefficients: [0, 0, 0, 0]\n"
    )
    poses = tmp_path / "mav0" / "state_groundtruth_estimate0"
    poses.mkdir()
    (poses / "data.csv").write_text("5,0,0,0,1,0,0,0\n")
    if focal is None:
        with pytest.raises(SourceError, match=re.escape("expected images of 64x48")):
            open_dataset(f"euroc:{tmp_path}")
    else:
        assert open_dataset(f"euroc:{tmp_path}").intrinsics.fx == focal


def test_damaged_and_tiny_images_are_refused_before_training(tmp_path):
    for number in range(3):
        (tmp_path / f"frame-{number}.pose.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1")
        cv2.imwrite(str(tmp_path / f"frame-{number}.color.png"), np.full((8, 8), 90, np.uint8))
    with pytest.raises(SourceError, match=r"at least 16 px per side, found 8x8 \(3\)"):
        one_size(open_dataset(f"7scenes:{tmp_path}"))
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"frame-{number}.color.png"), np.full((48, 64), 90, np.uint8))
    (tmp_path / "frame-1.color.png").write_bytes(b"")
    with pytest.raises(SourceError, match=r"found 1 damaged of 3, the first .*frame-1;"):
        one_size(open_dataset(f"7scenes:{tmp_path}"))
    assert "1 damaged image" in "\n".join(describe(open_dataset(f"7scenes:{tmp_path}")))


def test_a_camera_that_never_moves_is_refused_before_training(tmp_path):
    for number in range(100):
        (tmp_path / f"frame-{number}.pose.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1")
        cv2.imwrite(str(tmp_path / f"frame-{number}.color.png"), np.full((48, 64), 90, np.uint8))
    config = tiny_config(dataset=f"7scenes:{tmp_path}")
    with pytest.raises(UsageError, match="expected a camera that moves"):
        train(tmp_path / "run", config, ignore_progress)
    assert not (tmp_path / "run").exists()
