"""Ground truth: matrices and TUM files, and invalid input."""

import os

import numpy as np
import pytest

from cvo_edge.errors import SourceError
from cvo_edge.estimate import PoseInterval
from cvo_edge.ground_truth import open_ground_truth
from cvo_edge.pose import Chart, Pose
from cvo_edge.record import Status
from cvo_edge.sets import unbounded_set
from cvo_edge.trajectories.poses import read_pose_matrix


def frame(source="", stamp_ns=None):
    pose = Pose.from_array([0, 0, 0, 0, 0, 0, 1])
    return PoseInterval(
        0,
        stamp_ns,
        source,
        Status.OK,
        (),
        pose,
        unbounded_set(),
        0.9,
        "marginal",
        Chart("tangent_predicted"),
    )


def matrix_text(T):
    return "\n".join("\t".join(f"{value:.9e}" for value in row) for row in T)


def test_a_matrix_is_read_and_made_orthonormal(tmp_path):
    T = Pose.from_array([1, 2, 3, 0.1, 0.2, 0.3, 0.9]).to_matrix()
    noisy = T.copy()
    noisy[:3, :3] += 3e-4
    path = tmp_path / "frame-000001.pose.txt"
    path.write_text(matrix_text(noisy))
    found = read_pose_matrix(path)
    np.testing.assert_allclose(Pose.from_array(found).to_matrix(), T, atol=1e-3)
    assert np.linalg.norm(found[3:]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1 2 3",
        "not numbers " * 8,
        matrix_text(np.full((4, 4), np.nan)),
        matrix_text(np.diag([2.0, 2.0, 2.0, 1.0])),
        matrix_text(np.ones((4, 4))),
    ],
)
def test_what_is_no_pose_is_none(tmp_path, text):
    path = tmp_path / "a.pose.txt"
    path.write_text(text)
    assert read_pose_matrix(path) is None


def test_folder_is_matched_by_frame_name(tmp_path):
    (tmp_path / "frame-000007.pose.txt").write_text(matrix_text(np.eye(4)))
    truth = open_ground_truth(tmp_path)
    np.testing.assert_allclose(
        truth.pose_of(frame("frame-000007.color.jpg")), [0, 0, 0, 0, 0, 0, 1]
    )
    assert truth.pose_of(frame("frame-000008.color.jpg")) is None
    for name in ("frame-000007-color.png", "frame-000007_rgb.jpg", "frame-000007.png"):
        assert truth.pose_of(frame(name)) is not None


def test_tum_is_matched_by_the_nearest_stamp_within_twenty_milliseconds(tmp_path):
    path = tmp_path / "truth.txt"
    path.write_text(
        "# a comment\n1305031102.175304 1 0 0 0 0 0 1\n1305031102.275304 2 0 0 0 0 0 1\n"
    )
    truth = open_ground_truth(path)
    start = 1_305_031_102_175_304_000
    assert truth.pose_of(frame(stamp_ns=start))[0] == 1.0
    assert truth.pose_of(frame(stamp_ns=start + 85_000_000))[0] == 2.0
    assert truth.pose_of(frame(stamp_ns=start + 50_000_000)) is None
    assert truth.pose_of(frame(stamp_ns=start - 20_000_001)) is None
    assert truth.pose_of(frame()) is None


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("", "expected a folder of .*, found no line"),
        ("1 2 3\n", "expected a folder of .*, found '1 2 3' in line 1"),
        ("0 0 0 0 0 0 0 0\n", "found no valid one: truth.txt, line 1: a quaternion of norm 0$"),
        ("nan 0 0 0 0 0 0 1\n", "timestamp tx ty tz"),
        ("1" * 5001 + " 0 0 0 0 0 0 1\n", "timestamp tx ty tz"),
        ("-1e290 0 0 0 0 0 0 1\n", "stamps in seconds, found -1e290 in line 1"),
        ("0 0 0 0 1e308 1e308 0 1e308\n", "a quaternion of norm inf$"),
    ],
)
def test_a_broken_trajectory_names_the_rule(tmp_path, text, rule):
    path = tmp_path / "truth.txt"
    path.write_text(text)
    with pytest.raises(SourceError, match=rule):
        open_ground_truth(path)


def test_no_ground_truth_is_refused(tmp_path):
    with pytest.raises(SourceError, match=r"expected a folder of .*, found none of them"):
        open_ground_truth(tmp_path)
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(SourceError, match=r"none\.txt: no such file; expected a folder of"):
        open_ground_truth(tmp_path / "none.txt")
    with pytest.raises(SourceError, match="expected a regular file, found another kind of file"):
        open_ground_truth(tmp_path / "fifo")


def test_a_pose_file_of_another_kind_or_size_is_no_pose(tmp_path):
    os.mkfifo(tmp_path / "a.pose.txt")
    with (tmp_path / "b.pose.txt").open("wb") as stream:
        stream.truncate(2 << 40)
    np.savetxt(tmp_path / "c.pose.txt", np.eye(4))
    truth = open_ground_truth(tmp_path)
    assert truth.pose_of(frame(source="a.color.jpg")) is None
    assert truth.pose_of(frame(source="b.color.jpg")) is None
    assert truth.pose_of(frame(source="c.color.jpg")) is not None
