"""The camera check: evidence of single frames, its sum over a stream, the camera it reports."""

import msgspec
import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.camera_check import (
    PAIR,
    WINDOW,
    CameraCheck,
    LensLimits,
    fitted_limits,
    in_deviations,
    summed,
)
from cvo_edge.pose_solver import PoseSolver
from cvo_edge.reprojection import NU

START = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
FOCAL_PX = 240.0
# Without a verdict on pairs.
NEVER = (1e6, 1e6, 1e6)
# Of a recording: some have hardly moved and are no evidence.
FRAMES = WINDOW + 10
STEP = (1e-3, 1e-3)
LIMITS = LensLimits(log_focal=0.02, distortion=0.05, deviations=NEVER, step=STEP)


def grid_rays():
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 16), np.linspace(-0.4, 0.4, 12))
    return np.column_stack([u.ravel(), v.ravel()])


def solver():
    return PoseSolver(grid_rays(), START, np.ones(6))


def seen_by(lens, generator, noise=0.002):
    """Points, scale and solved pose of a frame whose true camera differs by ``lens``."""
    shown = grid_rays()
    ideal = shown.copy()
    for _ in range(50):  # inverse of the distortion
        radial = 1.0 + lens[2] * np.square(ideal).sum(axis=1, keepdims=True)
        ideal = shown / (np.exp(lens[:2]) * radial)
    ideal += generator.normal(0.0, noise, ideal.shape)
    depth = generator.uniform(1.0, 4.0, (len(ideal), 1))
    local = np.column_stack([ideal, np.ones(len(ideal))]) * depth
    q = geometry.quaternion_exp(generator.normal(0.0, 0.1, 3))
    points = local @ geometry.quaternion_to_matrix(q).T + generator.normal(0.0, 0.1, 3)
    scale = np.full(len(ideal), noise)
    return points, scale, solver().solve(points, scale).pose


def outputs_of(points, scale, pose):
    evidence = solver().solve(points, scale).lens
    return {
        "coordinates": points[np.newaxis],
        "log_scale_px": np.log(scale * FOCAL_PX)[np.newaxis],
        "solved_pose": pose[np.newaxis],
        "lens_gradient": evidence.gradient[np.newaxis],
        "lens_information": evidence.information[np.newaxis],
        "signs": np.array([[1.0, 0.1]]),
    }


def check(limits=LIMITS, **options):
    return CameraCheck(solver(), FOCAL_PX, limits, error_px=1.0, **options)


def test_evidence_is_the_derivative_of_the_profiled_likelihood(optimize):
    # Oracle: scipy fits the pose again for a slightly different camera.
    points, scale, pose = seen_by(np.zeros(3), np.random.default_rng(0))
    evidence = solver().solve(points, scale).lens

    def loss(step, lens):
        q = geometry.quaternion_multiply(pose[3:], geometry.quaternion_exp(step[3:]))
        local = (points - pose[:3] - step[:3]) @ geometry.quaternion_to_matrix(q)
        image = local[:, :2] / local[:, 2:]
        radial = 1.0 + lens[2] * np.square(image).sum(axis=1, keepdims=True)
        squared = np.square(image * radial * np.exp(lens[:2]) - grid_rays()).sum(axis=1)
        return 0.5 * (NU + 2.0) * np.log1p(squared / (NU * np.square(scale))).sum()

    def profiled(lens):
        found = optimize.minimize(
            loss, np.zeros(6), args=(lens,), method="BFGS", options={"gtol": 1e-3}
        )
        return -found.fun

    h = 0.1 / np.sqrt(np.diag(evidence.information))
    at, steps = profiled(np.zeros(3)), np.diag(h)
    up, down = ([profiled(sign * step) for step in steps] for sign in (1.0, -1.0))
    np.testing.assert_allclose(
        evidence.gradient * h, (np.array(up) - np.array(down)) / 2.0, atol=2e-4
    )
    second = 2.0 * at - np.array(up) - np.array(down)
    # The image's own curvature is left out, as in every Gauss-Newton method.
    np.testing.assert_allclose(np.diag(evidence.information) * h * h, second, rtol=0.05)


@pytest.mark.parametrize(
    "lens", [(0.0, 0.0, 0.0), (0.05, 0.05, 0.0), (-0.05, -0.05, 0.0), (0.05, 0.0, 0.0)]
)
def test_a_window_of_frames_shows_five_percent(lens):
    generator = np.random.default_rng(1)
    stream = check()
    found = [
        stream.differs(outputs_of(*seen_by(np.array(lens), generator)), familiar=True)
        for _ in range(WINDOW + 10)
    ]
    assert not any(found[: WINDOW - 1])
    assert set(found[WINDOW - 1 :]) == {any(lens)}


@pytest.mark.parametrize(("narrow", "differs"), [(False, True), (True, False)])
def test_a_camera_that_shows_less_has_wider_limits(narrow, differs):
    generator = np.random.default_rng(14)
    frames = [outputs_of(*seen_by(np.array([0.03, 0.03, 0.0]), generator)) for _ in range(WINDOW)]
    evidence = [(each["lens_gradient"][0], each["lens_information"][0]) for each in frames]
    largest = float(np.abs(summed(evidence)).max())
    stream = check(LensLimits(largest / 1.5, largest / 1.5, NEVER, STEP), narrow=narrow)
    assert [stream.differs(each, familiar=True) for each in frames][-1] == differs


@pytest.mark.parametrize(
    ("drift", "narrow", "differs"),
    [(0.0, False, False), (0.1, False, True), (0.1, True, True), (0.01, True, False)],
)
def test_two_frames_show_a_lens_that_is_off_by_many_deviations(drift, narrow, differs):
    generator = np.random.default_rng(9)
    limits = msgspec.structs.replace(LIMITS, deviations=(3.0, 3.0, 3.0))
    stream = check(limits, narrow=narrow)
    lens = np.array([drift, drift, 0.0])
    frames = [outputs_of(*seen_by(lens, generator, noise=5e-4)) for _ in range(WINDOW - 1)]
    found = [stream.differs(frame, familiar=True) for frame in frames]
    assert not any(found[: PAIR - 1])
    assert any(found[: PAIR + 3]) == differs
    assert differs or not any(found)


def test_what_two_frames_show_holds_for_a_window_of_others():
    generator = np.random.default_rng(11)
    stream = check(msgspec.structs.replace(LIMITS, deviations=(3.0, 3.0, 3.0)))
    for lens, frames in ((np.array([0.1, 0.1, 0.0]), PAIR), (np.zeros(3), WINDOW + 5)):
        found = [
            stream.differs(outputs_of(*seen_by(lens, generator, noise=1e-3)), familiar=True)
            for _ in range(frames)
        ]
    assert all(found[: WINDOW - PAIR])
    assert not any(found[WINDOW:])


def test_a_camera_that_stands_still_is_one_frame_of_evidence():
    generator = np.random.default_rng(12)
    stream = check(msgspec.structs.replace(LIMITS, deviations=(3.0, 3.0, 3.0)))
    points, scale, pose = seen_by(np.array([0.1, 0.1, 0.0]), generator, noise=5e-4)
    for _ in range(2 * WINDOW):
        near = pose.copy()
        near[:3] += generator.normal(0.0, 1e-4, 3)
        assert not stream.differs(outputs_of(points, scale, near), familiar=True)


def test_the_step_is_a_share_of_the_usual_motion():
    outputs, sequence = known_frames([0.0, 0.0], np.random.default_rng(13))
    for row in range(len(sequence)):
        outputs["solved_pose"][row] = (0.04 * row, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    assert fitted_limits(outputs, sequence).step == pytest.approx((0.02, 1e-6))


def test_deviations_are_those_of_the_lens_that_frames_show():
    """Over many frames of the known camera, they are those of a normal variable."""
    generator = np.random.default_rng(10)
    found = []
    for _ in range(200):
        frames = [outputs_of(*seen_by(np.zeros(3), generator)) for _ in range(PAIR)]
        evidence = [(each["lens_gradient"][0], each["lens_information"][0]) for each in frames]
        found.append(in_deviations(evidence))
    rms = np.sqrt(np.square(found).mean(axis=0))
    np.testing.assert_allclose(rms, 1.0, atol=0.5)


def test_frames_that_leave_the_lens_open_are_no_evidence():
    evidence = [(np.ones(3), -np.eye(3))] * PAIR
    np.testing.assert_array_equal(in_deviations(evidence), 0.0)


@pytest.mark.parametrize("lens", [(0.0, 0.0, 0.0), (0.2, 0.2, 0.0), (0.1, 0.0, 0.0), (0, 0, -0.3)])
def test_the_camera_is_reported(lens):
    generator = np.random.default_rng(2)
    stream = check()
    for _ in range(150):
        stream.differs(outputs_of(*seen_by(np.array(lens), generator)), familiar=False)
    fx, fy, k1, frames = stream.estimate()
    np.testing.assert_allclose(np.log([fx, fy]), lens[:2], atol=0.01)
    assert k1 == pytest.approx(lens[2], abs=0.03)
    assert WINDOW <= frames <= 64


def test_frames_of_another_place_show_no_camera():
    generator = np.random.default_rng(3)
    stream = check()
    for _ in range(WINDOW):
        points, scale, _ = seen_by(np.zeros(3), generator)
        shuffled = generator.permutation(points)
        pose = solver().solve(shuffled, scale).pose
        assert not stream.differs(outputs_of(shuffled, scale, pose), familiar=False)
    assert stream.estimate() is None


def test_few_frames_show_no_camera():
    stream = check()
    frame = outputs_of(*seen_by(np.zeros(3), np.random.default_rng(4)))
    for _ in range(WINDOW - 1):
        stream.differs(frame, familiar=True)
    assert stream.estimate() is None


def known_frames(drifts, generator):
    """Outputs of some frames per recording, whose cameras seem to differ by ``drifts``."""
    frames = [
        outputs_of(*seen_by(np.array([drift, 0.0, 0.0]), generator))
        for drift in drifts
        for _ in range(FRAMES)
    ]
    stacked = {name: np.concatenate([each[name] for each in frames]) for name in frames[0]}
    return stacked, np.repeat(np.arange(len(drifts)), FRAMES)


def test_one_strange_recording_does_not_switch_the_check_off():
    generator = np.random.default_rng(5)
    limits = fitted_limits(*known_frames([0.002, 0.004, 0.006, 0.008, 0.3], generator))
    assert 0.006 < limits.log_focal < 0.03
    assert max(limits.deviations) < 40.0
    assert msgspec.json.decode(msgspec.json.encode(limits), type=LensLimits) == limits


def test_limits_lie_beyond_the_known_recording():
    outputs, sequence = known_frames([0.0], np.random.default_rng(6))
    evidence = zip(outputs["lens_gradient"], outputs["lens_information"], strict=True)
    found = np.abs(summed(list(evidence)))
    limits = fitted_limits(outputs, sequence)
    assert limits.log_focal > 2.0 * found[:2].max()
    assert limits.distortion > 2.0 * found[2]
    stream = check(limits)
    for row in range(WINDOW):
        frame = {name: values[row : row + 1] for name, values in outputs.items()}
        assert not stream.differs(frame, familiar=True)


def test_recordings_without_a_window_of_evidence_give_no_limits():
    outputs, sequence = known_frames([0.0], np.random.default_rng(7))
    outputs["signs"][: FRAMES - WINDOW + 1, 1] = 0.9
    assert fitted_limits(outputs, sequence) is None


@pytest.mark.parametrize(
    ("contradicting", "factor", "differs"),
    [(0.1, 0.9, False), (0.1, 1.1, True), (0.4, 1.9, False), (0.4, 2.1, True)],
)
def test_frames_that_contradict_are_weak_evidence(contradicting, factor, differs):
    generator = np.random.default_rng(8)
    frames = [outputs_of(*seen_by(np.array([0.03, 0.03, 0.0]), generator)) for _ in range(WINDOW)]
    evidence = [(each["lens_gradient"][0], each["lens_information"][0]) for each in frames]
    shown = np.abs(summed(evidence))
    limits = LensLimits(float(shown[:2].max()) / factor, float(shown[2]) / factor, NEVER, STEP)
    stream = check(limits)
    for outputs in frames:
        outputs["signs"][0, 1] = contradicting
        found = stream.differs(outputs, familiar=True)
    assert found == differs
