"""The front end: rotation and direction from shared points, and the command ``odometry``."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from cvo_edge import geometry
from cvo_edge.camera import Camera
from cvo_edge.frontend.essential import LEAST_PARALLAX_PX, solve
from cvo_edge.frontend.lens import Lens
from cvo_edge.frontend.odometry import FrontEnd
from cvo_edge.frontend.refine import rotation, sampson_slopes, tangent
from cvo_edge.frontend.steps import StepReason
from cvo_edge.motion.files import read_poses
from cvo_edge.motion.relative import motion
from cvo_edge.programs.cli import app
from cvo_edge.programs.demo import BUNDLE
from cvo_edge.record import Status
from cvo_edge.trajectories.poses import read_pose_matrix

CLIP = BUNDLE.parent / "clip"
CAMERA = "320x240,292.5,292.5,159.5,119.5"
FOCAL = 500.0
TURN = rotation(np.array([0.02, -0.03, 0.01]))


def rays(
    R: np.ndarray, t: np.ndarray, *, plane: bool = False, noise_px: float = 0.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Rays (3, n) of points that a camera sees before and after a motion X1 = R X2 + t."""
    rng = np.random.default_rng(seed)
    x2 = np.vstack([rng.uniform(-0.6, 0.6, 200), rng.uniform(-0.4, 0.4, 200), np.ones(200)])
    depth = 5.0 / (1.0 + 0.5 * x2[0] + 0.3 * x2[1]) if plane else rng.uniform(2.0, 9.0, 200)
    X1 = R @ (depth * x2) + t[:, np.newaxis]
    x1 = X1 / X1[2]
    for x in (x1, x2):
        x[:2] += noise_px / FOCAL * rng.normal(size=(2, 200))
    return x1, x2


def off(R: np.ndarray, S: np.ndarray) -> float:
    return float(np.linalg.norm(R - S))


@pytest.mark.parametrize(
    "t", [(0.3, 0.0, 0.0), (0.0, -0.2, 0.1), (0.0, 0.0, 0.5), (0.1, 0.1, -0.4)]
)
def test_exact_points_give_the_exact_motion(t: tuple[float, ...]) -> None:
    direction = np.array(t) / np.linalg.norm(t)
    found = solve(*rays(TURN, np.array(t)), FOCAL)
    assert found is not None
    assert found.direction is not None
    assert off(found.R, TURN) < 1e-5
    assert np.linalg.norm(found.direction - direction) < 1e-4
    assert found.inliers == 200


@pytest.mark.parametrize("t", [(0.3, 0.0, 0.0), (0.0, -0.2, 0.1), (0.0, 0.0, 0.5)])
def test_of_the_two_motions_of_a_plane_the_smoother_one_is_found(t: tuple[float, ...]) -> None:
    x1, x2 = rays(TURN, np.array(t), plane=True)
    found = solve(x1, x2, FOCAL, TURN @ rotation(np.array([0.0, 0.005, 0.0])))
    assert found is not None
    assert found.direction is not None
    assert off(found.R, TURN) < 1e-4
    assert found.direction @ t > 0.9999 * np.linalg.norm(t)


def test_points_that_do_not_belong_to_each_other_are_left_out() -> None:
    x1, x2 = rays(TURN, np.array([0.3, 0.1, 0.2]), noise_px=0.2)
    x1[:2, :60] = np.random.default_rng(1).uniform(-0.5, 0.5, (2, 60))
    found = solve(x1, x2, FOCAL)
    assert found is not None
    assert found.direction is not None
    assert off(found.R, TURN) < 5e-3
    assert 130 < found.inliers < 160
    assert solve(x1[:, :60], x2[:, :60], FOCAL) is None
    assert solve(x1[:, -10:], x2[:, -10:], FOCAL) is None


@pytest.mark.parametrize("noise_px", [0.0, 0.1])
def test_a_turn_alone_has_a_rotation_and_no_direction(noise_px: float) -> None:
    found = solve(*rays(TURN, np.zeros(3), noise_px=noise_px), FOCAL)
    assert found is not None
    assert found.direction is None
    assert off(found.R, TURN) < 1e-4
    assert found.parallax_px < LEAST_PARALLAX_PX


def test_a_camera_that_rests_stays_where_it_is() -> None:
    x, _ = rays(np.eye(3), np.zeros(3))
    found = solve(x, x, FOCAL)
    assert found is not None
    assert found.direction is None
    assert off(found.R, np.eye(3)) == 0.0


def test_little_parallax_never_gives_the_twisted_solution() -> None:
    for seed in range(20):
        t = 0.02 * np.random.default_rng(seed).normal(size=3)
        found = solve(*rays(TURN, t, noise_px=0.1, seed=seed), FOCAL)
        assert found is not None
        assert off(found.R, TURN) < 0.02
        if found.direction is not None:
            assert found.direction @ t > 0.0


def test_the_sampson_error_has_its_derivatives() -> None:
    x1, x2 = rays(TURN, np.array([0.3, 0.1, 0.2]), noise_px=3.0)
    R, t = TURN @ rotation(np.array([0.01, 0.02, -0.02])), np.array([0.6, 0.64, 0.48])
    _, J = sampson_slopes(x1, x2, R, t)
    h = 1e-6 * np.eye(3)
    for k in range(3):
        turned = [sampson_slopes(x1, x2, R @ rotation(s * h[k]), t)[0] for s in (1, -1)]
        moved = [sampson_slopes(x1, x2, R, t + s * h[k])[0] for s in (1, -1)]
        assert np.allclose((turned[0] - turned[1]) / 2e-6, J[k], atol=1e-7)
        assert np.allclose((moved[0] - moved[1]) / 2e-6, J[3 + k], atol=1e-7)
    assert np.allclose(np.column_stack([tangent(t), t]).T @ tangent(t), np.eye(3)[:, :2])


def test_a_rotation_is_rodrigues_formula() -> None:
    for w in np.array([[0.0, 0.0, 0.0], [1e-9, 0.0, 0.0], [0.3, -0.2, 2.0]]):
        assert np.allclose(rotation(w), geometry.quaternion_to_matrix(geometry.quaternion_exp(w)))


@pytest.mark.parametrize(
    ("distortion", "coefficients"),
    [
        ("none", ()),
        ("radial_tangential", (-0.28, 0.07, 2e-4, 2e-5)),
        ("equidistant", (-0.01, 0.02, -0.01, 0.002)),
    ],
)
def test_rays_are_those_of_the_camera(distortion: str, coefficients: tuple[float, ...]) -> None:
    camera = Camera(
        width=640,
        height=480,
        fx=380.0,
        fy=385.0,
        cx=321.0,
        cy=242.0,
        distortion=distortion,
        coefficients=coefficients,
    )
    pixels = np.random.default_rng(0).uniform((0, 0), (639, 479), (300, 2)).astype(np.float32)
    found = Lens(camera).rays(pixels)
    expected = camera.rays(pixels)
    known = np.isfinite(expected).all(axis=1) & np.isfinite(found).all(axis=0)
    assert known.sum() > 250
    assert np.abs(found[:2, known].T - expected[known]).max() < 1e-6


def texture(height: int = 240, width: int = 320) -> np.ndarray:
    small = np.random.default_rng(0).integers(0, 256, (height // 4, width // 4), np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)


def camera(width: int = 320, height: int = 240) -> Camera:
    return Camera(width=width, height=height, fx=300.0, fy=300.0, cx=160.0, cy=120.0)


def test_a_lost_step_has_no_pose_and_the_next_ones_go_on() -> None:
    image = texture()
    turned = np.roll(image, 5, axis=1)
    black = np.zeros_like(image)
    front = FrontEnd(camera())
    images = [image, turned, black, image, turned, None, image[:200], image, turned]
    steps = [front.step(each, seq) for seq, each in enumerate(images)]
    assert [step.status for step in steps] == [
        *(Status.DEGRADED, Status.OK, Status.INVALID, Status.INVALID, Status.OK),
        *(Status.INVALID, Status.INVALID, Status.DEGRADED, Status.OK),
    ]
    assert [step.reasons[0] for step in steps if step.status is Status.INVALID] == [
        *(StepReason.TRACKS_FEW, StepReason.TRACKS_FEW),
        *(StepReason.IMAGE_UNREADABLE, StepReason.IMAGE_SIZE),
    ]
    for step in steps:
        assert np.isnan(step.pose).all() == (step.status is Status.INVALID)


def test_grey_colour_and_16_bits_give_the_same_step() -> None:
    first, second = texture(), np.roll(texture(), 3, axis=1)
    found = []
    for form in (
        lambda each: each,
        lambda each: np.dstack([each] * 3),
        lambda each: each.astype(np.uint16) << 8,
    ):
        front = FrontEnd(camera())
        front.step(form(first))
        found.append(front.step(form(second)).pose)
    assert np.array_equal(found[0], found[1])
    assert np.array_equal(found[0], found[2])


def test_another_exposure_changes_no_rotation() -> None:
    first, second = texture() // 2 + 40, np.roll(texture() // 2 + 40, 3, axis=1)
    turns = []
    for gain in (1.0, 0.7):
        front = FrontEnd(camera())
        front.step(first)
        step = front.step(cv2.convertScaleAbs(second, alpha=gain))
        assert step.motion is not None
        turns.append(step.motion.R)
    assert off(*turns) < 2e-4


def test_a_cover_over_half_of_the_image_moves_nothing() -> None:
    image = texture()
    front = FrontEnd(camera())
    front.step(image)
    step = front.step(np.where(np.arange(320) < 150, image, 0).astype(np.uint8))
    assert step.motion is not None
    assert step.motion.direction is None
    assert off(step.motion.R, np.eye(3)) < 1e-4


def run(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=True)
    error = result.exception
    code = getattr(error, "exit_code", result.exit_code)
    return code, f"{result.output}{error if code else ''}"


def test_the_command_finds_the_motion_of_the_clip(tmp_path: Path) -> None:
    options = ("--camera", CAMERA, "--fps", 30)
    assert run("odometry", CLIP, *options, "-o", tmp_path / "steps.jsonl")[0] == 0
    assert run("odometry", CLIP, *options, "-o", tmp_path / "steps.tum", "--quiet") == (0, "")
    truth = np.array([read_pose_matrix(path) for path in sorted(CLIP.glob("*.pose.txt"))])
    true = motion(truth[:-1], truth[1:])
    head, first, *records = map(json.loads, (tmp_path / "steps.jsonl").read_text().splitlines())
    assert head["kind"] == "odometry"
    assert first["reasons"] == ["nothing_before"]
    q = np.array([each["q_xyzw"] for each in records])
    turns = geometry.quaternion_log(
        geometry.quaternion_multiply(geometry.quaternion_conjugate(q), true[:, 3:])
    )
    assert np.rad2deg(np.median(np.linalg.norm(turns, axis=1))) < 0.2
    pointed = [each["direction"] is not None for each in records]
    t = true[pointed, :3] / np.linalg.norm(true[pointed, :3], axis=1, keepdims=True)
    cosines = np.sum(t * [each["direction"] for each in records if each["direction"]], axis=1)
    assert np.rad2deg(np.arccos(np.median(cosines))) < 10.0
    # The same steps, added up.
    poses = read_poses(tmp_path / "steps.tum")
    moved = motion(poses.poses[:-1], poses.poses[1:])
    assert np.allclose(moved[:, 3:], q, atol=1e-6)
    assert np.allclose(np.linalg.norm(moved[:, :3], axis=1), pointed, atol=1e-6)
    assert next(iter(poses.columns)) == "inliers"


def test_lengths_come_from_another_trajectory(tmp_path: Path) -> None:
    wheels = tmp_path / "wheels.tum"
    wheels.write_text("".join(f"{k / 30:.9f} {0.5 * k} 0 0 0 0 0 1\n" for k in range(30)))
    output = tmp_path / "steps.jsonl"
    options = ("--camera", CAMERA, "--fps", 30, "--scale", wheels, "-o", output)
    assert run("odometry", CLIP, *options)[0] == 0
    records = list(map(json.loads, output.read_text().splitlines()))[2:]
    assert np.allclose([each["length_m"] for each in records[:29]], 0.5)
    assert records[-1]["status"] == "invalid"
    assert records[-1]["reasons"] == ["length_missing"]


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("--camera", "640x480,500,500,320,240"), 2, "expected images of 640x480 pixels"),
        (("--camera", "320x240,500"), 2, "expected WIDTHxHEIGHT,FX,FY,CX,CY"),
        (("--camera", CAMERA, "--format", "tum"), 2, "give --fps"),
        (("--camera", CAMERA, "--scale", "none.tum"), 6, "none.tum: expected a file"),
        (("--camera", CAMERA, "--max-frames", "1"), 6, "found no step with a motion in 1 frames"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(
    tmp_path: Path, words: tuple[str, ...], code: int, message: str
) -> None:
    found, output = run("odometry", CLIP, *words, "-o", tmp_path / "steps", "--quiet")
    assert found == code
    assert message in output
    assert "\n" not in output.strip()


def test_the_whole_chain_puts_intervals_on_rotation_and_direction(tmp_path: Path) -> None:
    pairs: list[Path] = []
    for part in range(2):
        folder = tmp_path / f"part-{part}"
        folder.mkdir()
        rows = ""
        for seq, image in enumerate(sorted(CLIP.glob("*.color.jpg"))[25 * part : 25 * part + 25]):
            (folder / image.name).symlink_to(image)
            pose = read_pose_matrix(image.with_name(image.name.replace("color.jpg", "pose.txt")))
            assert pose is not None
            rows += " ".join(map(str, [seq / 30, *pose.tolist()])) + "\n"
        steps, truth = tmp_path / f"steps-{part}.tum", tmp_path / f"truth-{part}.tum"
        truth.write_text(rows)
        options = ("--camera", CAMERA, "--fps", 30, "--quiet")
        assert run("odometry", folder, *options, "-o", steps) == (0, "")
        pairs += [steps, truth]
    intervals = tmp_path / "motion.json"
    code, report = run("conformalize", *pairs, "-o", intervals, "--scale", "inliers,parallax")
    assert (code, "not compared, as the drives are too short" in report) == (0, True)
    output = tmp_path / "records.jsonl"
    assert run("odometry", CLIP, *options, "--motion", intervals, "-o", output) == (0, "")
    head, _, *records = map(json.loads, output.read_text().splitlines())
    assert head["motion"]["horizons"] == ["1f"]
    for record in records:
        (found,) = record["motion"]
        assert found["bounded"] == (record["status"] == "ok")
        if found["direction"] is not None:
            assert np.allclose(found["direction"]["xyz"], record["direction"], atol=1e-6)
            assert found["rotation"] > 0.0
    # Another estimator's thresholds are not for steps in metres.
    wheels = tmp_path / "truth-0.tum"
    code, text = run("odometry", CLIP, *options, "--motion", intervals, "--scale", wheels)
    assert (code, "expected steps without a scale" in text) == (2, True)
