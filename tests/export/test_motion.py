"""What ``dataset`` says of a recording: motion, wrong readings of poses, splits, a picture."""

import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvo_edge.conformal import capped_quantile, conformal_quantile
from cvo_edge.errors import UsageError
from cvo_export.bundles.supported import supported
from cvo_export.cli.app import app
from cvo_export.data.splits import make_split
from cvo_export.datasets import Intrinsics, PoseDataset, open_dataset
from cvo_export.datasets.agreement import READ, agreement_of
from cvo_export.datasets.describe import describe, suspicions
from cvo_export.datasets.motion import motion_of, up_of

FOCAL, WIDTH, HEIGHT, FRAMES = 120.0, 160, 120, 24


def _walk(frames: int = FRAMES) -> PoseDataset:
    """Blobs in space that a turning and moving camera sees; z is up."""
    generator = np.random.default_rng(0)
    points = generator.uniform((-4, 1.5, -2), (4, 6, 2), (400, 3))
    shades = generator.integers(60, 256, 400)
    t = np.linspace(0.0, 1.0, frames)
    # Right, down and forward of a camera that looks along y are x, -z and y.
    level = Rotation.from_matrix(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    yaw = Rotation.from_euler("z", (0.9 * t - 0.4)[:, None])
    R = yaw * level * Rotation.from_euler("x", 0.3 * np.sin(3 * t)[:, None])
    position = np.stack([0.8 * t, 0.5 * np.sin(4 * t), 0.3 * t], axis=1)

    @cache
    def read_image(index: int) -> np.ndarray:
        image = np.zeros((HEIGHT, WIDTH), np.uint8)
        seen = R[index].inv().apply(points - position[index])
        for (x, y, z), shade in zip(seen, shades, strict=True):
            if z > 0.5:
                pixel = (8 * (FOCAL * np.array([x, y]) / z + (79.5, 59.5))).round().astype(int)
                cv2.circle(image, tuple(pixel.tolist()), 12, int(shade), -1, cv2.LINE_AA, 3)
        return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)

    return PoseDataset(
        name="walk",
        poses=np.concatenate([position, R.as_quat(canonical=True)], axis=1),
        sequence=np.zeros(frames, np.int64),
        sequence_names=("walk",),
        frame_names=tuple(f"walk/{i}" for i in range(frames)),
        read_image=read_image,
        intrinsics=Intrinsics(FOCAL, FOCAL, 79.5, 59.5),
        stamps_ns=np.arange(frames) * 50_000_000,
    )


WALK = _walk()


def _told(dataset: PoseDataset) -> list[str]:
    return suspicions(motion_of(dataset), agreement_of(dataset))


def _read_as(pose: np.ndarray, reading: str) -> np.ndarray:
    """A file that holds something else, read as camera-to-world with scalar-last quaternions."""
    position, R = pose[:, :3], Rotation.from_quat(pose[:, 3:])
    if "world-to-camera" in reading:
        position, R = -R.inv().apply(position), R.inv()
    if "OpenGL" in reading:
        R *= Rotation.from_euler("x", np.pi)
    if "body" in reading:
        R *= Rotation.from_matrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])).inv()
    q = R.as_quat(canonical=True)
    if "w x y z" in reading:
        q = np.roll(q, 1, axis=1)
    return np.concatenate([position, q], axis=1)


@pytest.mark.parametrize(
    "reading",
    [
        "quaternions in the order w x y z",
        "world-to-camera poses",
        "world-to-camera poses with quaternions in the order w x y z",
        "OpenGL camera axes (y up, z backwards)",
        "poses of a body with x forward and z up",
    ],
)
@pytest.mark.parametrize("stated", [True, False])
def test_poses_of_another_convention_are_told(reading, stated):
    wrong = replace(WALK, poses=_read_as(WALK.poses, reading))
    (told,) = _told(wrong if stated else replace(wrong, intrinsics=None))
    assert told.startswith(f"the poses look like {reading}: ")


def test_right_poses_are_not_suspected_and_millimetres_are():
    agreement = agreement_of(WALK)
    assert agreement is not None
    assert agreement.fits[READ] > 0.8
    assert agreement.depth == pytest.approx(3.0, abs=1.5)
    for right in (WALK, replace(WALK, intrinsics=None), replace(WALK, stamps_ns=None)):
        assert _told(right) == []
    millimetres = WALK.poses * ([1000.0] * 3 + [1.0] * 4)
    for stamps in (WALK.stamps_ns, None):
        (told,) = _told(replace(WALK, poses=millimetres, stamps_ns=stamps))
        assert told.startswith("positions look like millimetres")
        assert ("m/s" in told) == (stamps is not None)
    # Far from the world's origin, metres are still metres.
    far = replace(WALK, poses=WALK.poses + np.array([5e5, 5e6, 0, 0, 0, 0, 0]))
    assert _told(far) == []
    assert any(line.startswith("origin      500000 5000000 0 m") for line in describe(far))


def test_images_of_other_poses_do_not_belong_to_them():
    (told,) = _told(replace(WALK, read_image=lambda index: WALK.read_image(FRAMES - 1 - index)))
    assert "do not belong together" in told or "world-to-camera" in told


@pytest.mark.parametrize("far", [0.0, 5e6])
def test_poses_that_are_all_the_same_are_no_other_reading(far):
    same = np.tile(WALK.poses[:1], (FRAMES, 1)) + np.array([far, far, 0, 0, 0, 0, 0])
    (told,) = _told(replace(WALK, poses=same))
    assert "do not belong together" in told


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_up_turns_with_the_world(axis, sign):
    direction = sign * np.eye(3)[axis]
    turn, _ = Rotation.align_vectors([direction], [[0.0, 0.0, 1.0]])
    poses = WALK.poses.copy()
    poses[:, 3:] = (turn * Rotation.from_quat(poses[:, 3:])).as_quat()
    up = up_of(poses)
    assert up.direction == pytest.approx(direction, abs=0.05)
    assert up.doubt == ""
    assert up_of(poses[:1]).doubt


def test_jumps_gaps_and_repeated_stamps_are_found_where_they_are():
    long = _walk(80)
    poses, stamps = long.poses.copy(), np.arange(80) * 50_000_000
    poses[30:, :3] += (0.0, 2.0, 0.0)
    stamps[50:] += 1_000_000_000
    stamps[60] = stamps[59]
    motion = motion_of(replace(long, poses=poses, stamps_ns=stamps))
    assert np.flatnonzero(motion.jumps).tolist() == [29]
    assert np.flatnonzero(motion.gaps).tolist() == [49]
    assert np.flatnonzero(motion.repeated).tolist() == [59]
    # No step leads from one recording to the next.
    two = replace(
        long, poses=poses, sequence=np.repeat([0, 1], [30, 50]), sequence_names=("a", "b")
    )
    assert not motion_of(two).jumps.any()
    assert [line.split(",")[0] for line in describe(two)[-2:]] == [
        "sequence    a: 30 frames",
        "sequence    b: 50 frames",
    ]


@pytest.mark.parametrize("seed", range(6))
def test_what_is_supported_is_what_training_and_thresholds_give(seed):
    generator = np.random.default_rng(seed)
    lengths = generator.integers(20, 300, generator.integers(1, 60))
    n = int(lengths.sum())
    made = replace(
        WALK,
        poses=np.tile(WALK.poses[0], (n, 1)),
        sequence=np.repeat(np.arange(lengths.size), lengths),
        sequence_names=tuple(f"s{i}" for i in range(lengths.size)),
        frame_names=tuple(map(str, range(n))),
        stamps_ns=None,
    )
    for each in supported(made):
        if each.split is None:
            with pytest.raises(UsageError, match=f"split {each.kind}"):
                make_split(made, each.kind, 0)
            continue
        split = make_split(made, each.kind, 0)
        assert split.digest(made) == each.split.digest(made)
        cal = split.roles["cal"]
        scores = generator.normal(size=cal.size)
        for level in (0.5, 0.8, 0.9, 0.95, 0.99):
            q_hat = conformal_quantile(scores, level)
            if each.kind == "sequence":
                assert each.rule == "capped"
                q_hat = capped_quantile(scores, made.sequence[cal], level, 0.5)
            assert np.isfinite(q_hat) == (level in each.finite)


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_command_draws_a_picture(suffix, tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("cvo_export.datasets.open_dataset", lambda _: WALK)
    out = tmp_path / f"walk{suffix}"
    app(["dataset", "made:walk", "--picture", str(out)], standalone_mode=False)
    start = out.read_bytes()[:5]
    assert start == {".png": b"\x89PNG\r", ".svg": b"<?xml"}[suffix]
    assert capsys.readouterr().out.endswith(f"picture     {out}\n")


@pytest.mark.parametrize(("name", "code"), [("a.jpg", 2), ("missing/a.png", 7), ("", 2)])
def test_a_picture_that_cannot_be_written_is_refused_before_any_work(
    name, code, tmp_path, monkeypatch
):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("cvo_export.datasets.open_dataset", lambda _: pytest.fail("was opened"))
    with pytest.raises(Exception, match=r"picture: expected|cannot be written") as refused:
        app(["dataset", "made:walk", "--picture", str(tmp_path / name)], standalone_mode=False)
    assert refused.value.exit_code == code
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif("CVO_DATA" not in os.environ, reason="CVO_DATA names no folder")
@pytest.mark.parametrize(
    "text", ["7scenes:redkitchen", "euroc:euroc_mh05", "kitti:kitti_00/sequences/00"]
)
def test_real_recordings_are_not_suspected(text):
    kind, _, path = text.partition(":")
    folder = Path(os.environ["CVO_DATA"]) / path
    if not folder.is_dir():
        pytest.skip(f"CVO_DATA has no {path}")
    found = open_dataset(f"{kind}:{folder}")
    motion = motion_of(found)
    assert suspicions(motion, agreement_of(found)) == []
    assert not motion.jumps.any()
