"""Motion of an estimator as messages: velocities with covariances, read by other programs."""

import msgspec
import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.errors import UsageError
from cvo_edge.motion.annotation import annotate
from cvo_edge.motion.conformalize import conformalize
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.intervals import MotionCalibration
from cvo_edge.motion.messages import motion_messages, velocity_of
from cvo_edge.motion.records import motion_header
from cvo_edge.programs.cli import app
from cvo_edge.spread import Here

from .simulated_drives import composed, drive, twist


def se3(xi):
    """Exp of (rho, w) (..., 6) as poses (..., 7), by the integral of the rotation."""
    steps = 2000
    small = np.concatenate([xi[..., :3] / steps, geometry.quaternion_exp(xi[..., 3:] / steps)], -1)
    # The position moves by the velocity in the middle of each piece.
    half = geometry.quaternion_exp(xi[..., 3:] / (2 * steps))
    R = geometry.quaternion_to_matrix(half)
    small[..., :3] = (R @ small[..., :3, np.newaxis])[..., 0]
    found = small
    total = np.zeros_like(found)
    total[..., 6] = 1.0
    for bit in range(steps.bit_length()):
        if steps >> bit & 1:
            total = composed(total, found)
        found = composed(found, found)
    return total


@pytest.mark.parametrize("xi", [[2.7, 0.1, -0.3, 0.02, -0.1, 0.4], [1.0, 2.0, 3.0, 0.0, 0.0, 0.0]])
def test_a_velocity_leads_from_pose_to_pose_and_has_the_covariance_of_samples(xi):
    generator, seconds = np.random.default_rng(0), 0.1
    step = se3(np.array(xi))
    root = np.tril(generator.normal(size=(6, 6))) * 1e-3
    found = velocity_of(step, seconds, root @ root.T)
    np.testing.assert_allclose(found.twist * seconds, xi, atol=1e-6)
    drawn = generator.normal(size=(4000, 6))
    # Samples with exactly the covariance: only what is left out of the formula shows.
    x = np.linalg.solve(np.linalg.cholesky(drawn.T @ drawn / 4000), drawn.T).T @ root.T
    true = composed(np.tile(step, (len(x), 1)), twist(x))
    off = np.array([velocity_of(each, seconds, np.eye(6)).twist for each in true]) - found.twist
    scale = np.sqrt(np.diag(found.covariance))
    error = np.abs((off.T @ off / len(off) - found.covariance) / np.outer(scale, scale)).max()
    assert error < 0.01


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Records of a drive that starts, is lost for a while, and jumps, and their header."""
    calibration = MotionCalibration(
        conformalize(Here([drive(seed, 300) for seed in (1, 2)]), "vio", [Horizon.parse("1f")], [])
    )
    pair = drive(3, 120)
    poses = pair.estimate.copy()
    # An anchor of times that ROS can hold, and a tracker that is lost.
    poses[40:44] = np.nan
    poses[80:, 0] += 100.0
    stamps = pair.stamps_ns + 1_700_000_000_000_000_000
    level = calibration.level()
    records = list(annotate(calibration, level, stamps, poses, {}, covariance="integrated"))
    header = motion_header(calibration, level)
    path = tmp_path_factory.mktemp("motion") / "a.jsonl"
    lines = [msgspec.json.encode(each) for each in (header, *records)]
    path.write_bytes(b"".join(line + b"\n" for line in lines))
    return path, header, records


def test_only_an_ok_step_has_a_velocity(recorded):
    _, header, records = recorded
    kinds = {}
    for record, messages in motion_messages(records, header, "odom", "base_link"):
        topics = {each.topic for each in messages}
        assert "/diagnostics" in topics
        ok = record.status == "ok"
        assert ("/cvo/twist" in topics) == ("/cvo/pose_alone" in topics) == ok
        (status,) = messages[0].content["status"]
        assert status["level"] == {"ok": 0, "degraded": 1, "invalid": 2}[record.status]
        kinds[str(record.status)] = kinds.get(str(record.status), 0) + 1
    assert set(kinds) == {"ok", "degraded", "invalid"}


def test_other_programs_read_the_same_numbers(recorded, tmp_path):
    AnyReader = pytest.importorskip("rosbags.highlevel").AnyReader
    pytest.importorskip("mcap.writer")
    path, _, records = recorded
    target = tmp_path / "a.mcap"
    words = ["convert", str(path), "-o", str(target), "--child-frame-id", "lidar"]
    app(words, standalone_mode=False)
    with AnyReader([target]) as reader:
        read = [
            (one.topic, stamp, reader.deserialize(raw, one.msgtype))
            for one, stamp, raw in reader.messages()
        ]
    ok = {each.stamp_ns: each for each in records if each.status == "ok"}
    poses = {stamp: each for topic, stamp, each in read if topic == "/cvo/pose_alone"}
    twists = {stamp: each for topic, stamp, each in read if topic == "/cvo/twist"}
    assert set(poses) == set(twists) == set(ok)
    assert sum(topic == "/diagnostics" for topic, _, _ in read) == len(records)
    for stamp, record in ok.items():
        position, turn = poses[stamp].pose.position, poses[stamp].pose.orientation
        found = [getattr(position, axis) for axis in "xyz"], [getattr(turn, a) for a in "xyzw"]
        assert found == (list(record.pose.t_m), list(record.pose.q_xyzw))
        assert poses[stamp].header.frame_id == "odom"
        got, before = twists[stamp], records[record.seq - 1]
        assert got.header.frame_id == "lidar"
        xi = [getattr(part, axis) for part in (got.twist.twist.linear, got.twist.twist.angular)
              for axis in "xyz"]  # fmt: skip
        seconds = 1e-9 * (stamp - before.stamp_ns)
        start = np.array([*before.pose.t_m, *before.pose.q_xyzw])
        np.testing.assert_allclose(
            composed(start, se3(seconds * np.array(xi)))[:3], record.pose.t_m, atol=1e-6
        )
        covariance = np.array(got.twist.covariance).reshape(6, 6)
        np.linalg.cholesky(covariance)


def test_records_that_cannot_be_fused_are_refused(recorded, tmp_path):
    path, header, records = recorded
    plain = [msgspec.structs.replace(each, covariance=msgspec.UNSET) for each in records[:3]]
    with pytest.raises(UsageError, match="annotate with --covariance integrated"):
        list(motion_messages(plain, header, "odom", "base_link"))
    for more in (["--base", "0,0,0,0,0,0,1"], ["--to", "csv"], ["--unknown-variance", "1e6"]):
        words = ["convert", str(path), "-o", str(tmp_path / "a.mcap"), *more]
        if "--to" in more:
            words[3] = str(tmp_path / "a.csv")
        with pytest.raises(UsageError, match="for records of motion"):
            app(words, standalone_mode=False)
    assert not list(tmp_path.iterdir())
