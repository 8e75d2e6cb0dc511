"""Heads that solve for the pose: cameras, signs of doubt, sets and fusion."""

import msgspec
import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.bundle.format import Threshold
from cvo_edge.camera import Camera
from cvo_edge.conformal import conformal_quantile
from cvo_edge.errors import CalibrationFileError, UsageError
from cvo_edge.heads import fused as fused_module
from cvo_edge.heads.fused import FusedHead, FusedParameters, Fusion, fuse
from cvo_edge.heads.scr import ScrHead, ScrParameters, Signs
from cvo_edge.input.view import SeenCamera, crop_view, seen_camera
from cvo_edge.pose import Chart
from cvo_edge.record import Reason

CAMERA = Camera(width=640, height=480, fx=585.0, fy=585.0, cx=319.5, cy=239.5)
FISHEYE = msgspec.structs.replace(
    CAMERA, fx=300.0, fy=300.0, distortion="equidistant", coefficients=(0.01, 0.0, 0.0, 0.0)
)
OTHER = CAMERA.zoomed(1.1)
GRID = (12, 16)
PARAMETERS = ScrParameters(
    grid=GRID,
    starts=((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),),
    damping=(1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    deviation_floor=(1e-4,) * 6,
    limits=Signs(error_px=4.0, contradicting=0.3),
    camera_limits=None,
)
CHART = Chart("tangent_predicted")
# The network's input, 192 x 256, when it was trained.
LEARNED = crop_view(480, 640, 192, 256, "none").camera(CAMERA)


def seen(camera: Camera) -> SeenCamera:
    return seen_camera(camera, LEARNED, "none")


def pose_near(generator):
    q = geometry.quaternion_exp(generator.normal(0.0, 0.1, 3))
    return np.concatenate([generator.normal(0.0, 0.1, 3), q])


def outputs_of(camera, pose, generator, noise_px=0.5):
    """What a network would predict for an image that ``camera`` takes at ``pose``."""
    rays = seen(camera).rays(GRID)
    shown = np.isfinite(rays)
    # What the network says of other cells is arbitrary.
    noise = noise_px / seen(camera).camera.focal_px
    rays = np.where(shown, rays, 0.3) + generator.normal(0.0, noise, rays.shape)
    depth = generator.uniform(1.0, 4.0, (len(rays), 1))
    points = np.column_stack([rays, np.ones(len(rays))]) * depth
    world = points @ geometry.quaternion_to_matrix(pose[3:]).T + pose[:3]
    return {
        "coordinates": world[np.newaxis].astype(np.float32),
        "log_scale_px": np.full((1, len(rays)), np.log(noise_px), np.float32),
    }


def error(truth, found):
    return CHART.coordinates(truth, found) - CHART.coordinates(found, found)


@pytest.mark.parametrize(
    "camera",
    [
        CAMERA,
        CAMERA.zoomed(1.4),
        CAMERA.cropped(40, 400, 100, 580),
        FISHEYE,
        CAMERA.scaled(320, 240),
    ],
)
def test_any_camera_works_if_it_is_given(camera):
    generator = np.random.default_rng(0)
    solve = ScrHead(PARAMETERS, "normalised").solver(seen(camera))
    for _ in range(10):
        truth = pose_near(generator)
        found, doubt = solve(outputs_of(camera, truth, generator))
        assert doubt is None
        assert np.abs(error(truth, found["pose"][0])).max() < 0.02


@pytest.mark.parametrize("other", [CAMERA.zoomed(1.4), FISHEYE])
def test_another_camera_is_doubted_if_it_is_not_given(other):
    generator = np.random.default_rng(0)
    solve = ScrHead(PARAMETERS, "normalised").solver(seen(CAMERA))
    for _ in range(10):
        _, doubt = solve(outputs_of(other, pose_near(generator), generator))
        assert doubt is Reason.IMAGE_UNFAMILIAR


def test_a_camera_that_shows_too_little_is_refused():
    head = ScrHead(PARAMETERS, "normalised")
    with pytest.raises(UsageError, match="at least 25% of the model's cells, found 12%"):
        head.solver(seen(CAMERA.zoomed(2.4)))


def test_a_frame_that_errs_more_than_it_says_is_less_certain():
    """Errors three times as large count more for a camera that the network has not learned."""
    ratios = []
    for camera in (CAMERA, OTHER):
        deviations = []
        for factor in (1.0, 3.0):
            generator = np.random.default_rng(7)
            outputs = outputs_of(camera, pose_near(generator), generator, noise_px=0.2 * factor)
            outputs["log_scale_px"][:] = np.log(0.2)
            solve = ScrHead(PARAMETERS, "normalised").solver(seen(camera))
            deviations.append(np.sqrt(np.diag(solve(outputs).outputs["covariance"][0])))
        ratios.append(deviations[1] / deviations[0])
    # The weights alone widen it 1.7 times.
    assert (ratios[0] > 2.3).all()
    assert (ratios[1] > 1.3 * ratios[0]).all()


@pytest.mark.parametrize("camera", [CAMERA, CAMERA.zoomed(1.6)])
def test_the_signs_look_at_the_best_cells_of_those_that_show_the_image(camera):
    generator = np.random.default_rng(8)
    outputs = outputs_of(camera, pose_near(generator), generator)
    shown = np.flatnonzero(np.isfinite(seen(camera).rays(GRID)[:, 0]))
    # Nearly half of the cells are wrong, and say that they are vague.
    wrong = shown[: int(0.4 * len(shown))]
    outputs["coordinates"][0, wrong] += np.float32(50.0)
    outputs["log_scale_px"][0, wrong] = np.log(5.0)
    found = ScrHead(PARAMETERS, "normalised").solver(seen(camera))(outputs)
    error_px, contradicting = found.outputs["signs"][0]
    assert contradicting < 0.2
    assert error_px < 1.0
    assert found.doubt is None


def test_cells_that_are_vague_are_doubted_even_if_they_say_so():
    generator = np.random.default_rng(9)
    head = ScrHead(PARAMETERS, "normalised")
    outputs = outputs_of(CAMERA, pose_near(generator), generator, noise_px=8.0)
    found = head.solver(seen(CAMERA))(outputs)
    assert found.outputs["signs"][0, 1] < PARAMETERS.limits.contradicting
    assert found.doubt is Reason.IMAGE_UNFAMILIAR


def test_without_limits_a_solver_that_has_not_converged_is_doubted():
    generator = np.random.default_rng(10)
    head = ScrHead(msgspec.structs.replace(PARAMETERS, limits=None), "normalised")
    solve = head.solver(seen(CAMERA))
    points = generator.normal(0.0, 2.0, (20, 1, 192, 3)).astype(np.float32)
    logs = np.zeros((1, 192), np.float32)
    doubts = [solve({"coordinates": each, "log_scale_px": logs}).doubt for each in points]
    assert doubts.count(Reason.IMAGE_UNFAMILIAR) > 10


@pytest.mark.parametrize("log_scale", [1e4, -1e4, np.log(0.5)])
def test_absurd_scales_are_doubted_and_give_numbers(log_scale):
    generator = np.random.default_rng(11)
    outputs = outputs_of(CAMERA, pose_near(generator), generator)
    outputs["log_scale_px"][:] = log_scale
    found = ScrHead(PARAMETERS, "normalised").solver(seen(CAMERA))(outputs)
    assert np.isfinite(found.outputs["signs"]).all()
    assert (found.doubt is None) == (log_scale == np.log(0.5))


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"starts": ((0.0,) * 7,)}, "starts: expected unit quaternions, found one of length 0"),
        ({"damping": (1e-300,) * 6}, "damping: expected 1e-07 to 1e\\+06, found"),
        ({"deviation_floor": (1e-300,) * 6}, "deviation_floor: expected 1e-07 to"),
    ],
)
def test_parameters_that_no_solver_works_with_are_refused(changes, problem):
    head = ScrHead(msgspec.structs.replace(PARAMETERS, **changes), "normalised")
    with pytest.raises(CalibrationFileError, match=problem):
        head.check((), "max")


def test_cells_that_are_not_square_are_refused():
    head = ScrHead(msgspec.structs.replace(PARAMETERS, grid=(16, 12)), "normalised")
    with pytest.raises(CalibrationFileError, match="grid: expected square cells"):
        head.solver(seen(CAMERA))


def test_points_of_no_place_are_doubted():
    generator = np.random.default_rng(0)
    solve = ScrHead(PARAMETERS, "normalised").solver(seen(CAMERA))
    for scale in (0.3, 3.0, 30.0):
        points = generator.normal(0.0, 2.0, (1, 192, 3)).astype(np.float32)
        logs = np.full((1, 192), np.log(scale), np.float32)
        found = solve({"coordinates": points, "log_scale_px": logs})
        assert found.doubt is Reason.IMAGE_UNFAMILIAR


def test_without_intrinsics_it_is_refused():
    with pytest.raises(CalibrationFileError, match="camera: expected intrinsics, which the solver"):
        ScrHead(PARAMETERS, "normalised").solver(None)


def stacked(frames):
    return {name: np.concatenate([each[name] for each in frames]) for name in frames[0]}


def test_limits_accept_every_known_frame():
    generator = np.random.default_rng(0)
    head = ScrHead(msgspec.structs.replace(PARAMETERS, limits=None), "normalised")
    solve = head.solver(seen(CAMERA))
    frames = [outputs_of(CAMERA, pose_near(generator), generator) for _ in range(50)]
    known = stacked([solve(frame).outputs for frame in frames])
    tuned = ScrHead(head.tuned(known, np.empty((0, 7)), known, np.zeros(50, int)), "normalised")
    again = tuned.solver(seen(CAMERA))
    assert all(again(frame).doubt is None for frame in frames)
    assert tuned.candidates()[0].parameters.limits is None


@pytest.mark.parametrize("floor", [1e-4, 0.02])
@pytest.mark.parametrize("scope", ["marginal", "joint"])
def test_the_set_holds_exactly_the_poses_with_a_smaller_score(scope, floor):
    generator = np.random.default_rng(1)
    parameters = msgspec.structs.replace(PARAMETERS, deviation_floor=(floor,) * 6)
    head = ScrHead(parameters, "normalised")
    solve = head.solver(seen(CAMERA))
    point = np.zeros(6)
    threshold = Threshold(confidence=0.9, scope=scope, q_hat=(2.0,) * 6, q_hat_upper=None)
    for _ in range(50):
        outputs = solve(outputs_of(CAMERA, pose_near(generator), generator)).outputs
        found = head.conformal_set(outputs, point, threshold)
        deviation = np.maximum(np.sqrt(np.diag(outputs["covariance"][0])), floor)
        y = point + generator.normal(0.0, 1.5, 6) * deviation
        scores = head.scores(outputs, point[np.newaxis], y[np.newaxis], scope)[0, 0]
        if scope == "marginal":
            np.testing.assert_array_equal(found.covers(y), scores <= 2.0)
        else:
            assert found.contains(y) == (scores[0] <= 2.0)
            assert not found.contains(y) or found.covers(y).all()


FUSED = FusedParameters(
    **{name: getattr(PARAMETERS, name) for name in PARAMETERS.__struct_fields__},
    fusion=None,
    disagreement_limit=None,
)


def regression_of(truth, generator, deviation):
    step = deviation * generator.standard_normal(6)
    q = geometry.quaternion_multiply(truth[3:], geometry.quaternion_exp(step[3:]))
    return np.concatenate([truth[:3] + step[:3], q])


def fused_frames(generator, count, deviation):
    """Outputs of the fused network, with a regression of this deviation, and true poses."""
    solve = FusedHead(FUSED, "normalised").solver(seen(CAMERA))
    truths, found = [], []
    for _ in range(count):
        truth = pose_near(generator)
        outputs = outputs_of(CAMERA, truth, generator, noise_px=2.0)
        regression = regression_of(truth, generator, deviation)
        outputs["regression"] = regression[np.newaxis].astype(np.float32)
        outputs["half_width"] = np.tile(1.7 * deviation, (1, 1)).astype(np.float32)
        truths.append(truth)
        found.append(solve(outputs).outputs)
    return stacked(found), np.array(truths), found


def position_error(solve, frames, truths):
    poses = [solve(frame).outputs["pose"][0] for frame in frames]
    return np.median(np.linalg.norm(np.array(poses)[:, :3] - truths[:, :3], axis=1))


def test_two_poses_are_better_than_either():
    generator = np.random.default_rng(2)
    deviation = np.array([0.005, 0.005, 0.005, 0.002, 0.002, 0.002])
    val, truths, frames = fused_frames(generator, 200, deviation)
    tuned = FusedHead(FUSED, "normalised").tuned(val, truths, val, np.arange(200))
    assert tuned.fusion.share > 0.0
    together = position_error(FusedHead(tuned, "normalised").solver(seen(CAMERA)), frames, truths)
    solved = position_error(FusedHead(FUSED, "normalised").solver(seen(CAMERA)), frames, truths)
    regressed = np.median(np.linalg.norm(val["regression"][:, :3] - truths[:, :3], axis=1))
    assert together < 0.9 * min(solved, regressed)


def test_a_regression_that_hardly_helps_has_no_part(monkeypatch):
    """What wins on val by a few percent may lose in the next recording."""
    generator = np.random.default_rng(2)
    deviation = np.array([0.02, 0.02, 0.02, 0.008, 0.008, 0.008])
    val, truths, _ = fused_frames(generator, 200, deviation)
    assert FusedHead(FUSED, "normalised").tuned(val, truths, val, np.arange(200)).fusion.share == 0
    monkeypatch.setattr(fused_module, "_CLEARLY", 0.0)
    assert FusedHead(FUSED, "normalised").tuned(val, truths, val, np.arange(200)).fusion.share > 0


def test_a_useless_regression_does_no_harm():
    generator = np.random.default_rng(3)
    val, truths, frames = fused_frames(generator, 200, np.full(6, 0.5))
    tuned = FusedHead(FUSED, "normalised").tuned(val, truths, val, np.arange(200))
    together = position_error(FusedHead(tuned, "normalised").solver(seen(CAMERA)), frames, truths)
    solved = position_error(FusedHead(FUSED, "normalised").solver(seen(CAMERA)), frames, truths)
    assert together < 1.02 * solved


@pytest.mark.parametrize("other", [CAMERA.zoomed(1.2), CAMERA.cropped(0, 480, 0, 600)])
def test_the_regression_is_left_out_with_another_camera(other):
    generator = np.random.default_rng(4)
    fusion = Fusion(kappa=1.0, rho=(1e-3,) * 6, share=1.0)
    head = FusedHead(msgspec.structs.replace(FUSED, fusion=fusion), "normalised")
    truth = pose_near(generator)
    outputs = outputs_of(other, truth, generator)
    outputs["regression"] = np.array([[9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 1.0]], np.float32)
    outputs["half_width"] = np.full((1, 6), 0.01, np.float32)
    found = head.solver(seen(other))(outputs).outputs["pose"][0]
    assert np.abs(error(truth, found)).max() < 0.02


def test_disagreement_beyond_that_of_known_frames_is_a_doubt():
    generator = np.random.default_rng(6)
    deviation = np.array([0.005, 0.005, 0.005, 0.002, 0.002, 0.002])
    val, truths, frames = fused_frames(generator, 100, deviation)
    tuned = FusedHead(FUSED, "normalised").tuned(val, truths, val, np.arange(100))
    solve = FusedHead(tuned, "normalised").solver(seen(CAMERA))
    assert all(solve(frame).doubt is None for frame in frames)
    for frame in frames:
        frame["regression"] = frame["regression"] + np.float32([0.3, 0, 0, 0, 0, 0, 0])
        assert solve(frame).doubt is Reason.IMAGE_UNFAMILIAR


def test_the_fused_pose_minimises_the_sum_of_both_losses(optimize):
    generator = np.random.default_rng(12)
    root = generator.normal(0.0, 30.0, (6, 6))
    information = root @ root.T + 100.0 * np.eye(6)
    half_width = generator.uniform(0.01, 0.05, 6)
    fusion = Fusion(kappa=0.3, rho=tuple(generator.uniform(0.5, 2.0, 6).tolist()), share=0.7)
    solved = pose_near(generator)
    regression = regression_of(solved, generator, np.full(6, 0.02))
    offset = error(regression, solved)

    def loss(e):
        apart = (e - offset) / (np.array(fusion.rho) * half_width)
        return fusion.kappa * e @ information @ e + fusion.share * apart @ apart

    oracle = optimize.minimize(loss, np.zeros(6), method="BFGS", options={"gtol": 1e-9})
    pose, found, disagreement = fuse(solved, information, regression, half_width, fusion)
    np.testing.assert_allclose(error(pose, solved), oracle.x, atol=1e-5)
    assert disagreement == pytest.approx(oracle.fun / 6.0, rel=1e-3)
    weight = fusion.share / np.square(np.array(fusion.rho) * half_width)
    expected = (fusion.kappa * information + np.diag(weight)) / max(1.0, disagreement)
    np.testing.assert_allclose(found, expected)


def test_the_solver_alone_is_as_certain_as_val_has_shown():
    generator = np.random.default_rng(13)
    fusion = Fusion(kappa=0.04, rho=(1.0,) * 6, share=1.0)
    outputs = outputs_of(OTHER, pose_near(generator), generator)
    outputs["regression"] = np.zeros((1, 7), np.float32) + np.float32([0, 0, 0, 0, 0, 0, 1])
    outputs["half_width"] = np.full((1, 6), 0.01, np.float32)
    covariances = [
        FusedHead(msgspec.structs.replace(FUSED, fusion=each), "normalised")
        .solver(seen(OTHER))(outputs)
        .outputs["covariance"]
        for each in (None, fusion)
    ]
    np.testing.assert_allclose(covariances[1], covariances[0] / 0.04)


def test_disagreement_widens_the_covariance():
    solved = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    fusion = Fusion(kappa=1.0, rho=(1.0,) * 6, share=1.0)
    variances = []
    for offset in (0.0, 0.1, 1.0):
        regression = solved.copy()
        regression[0] = offset
        pose, information, disagreement = fuse(
            solved, 1e4 * np.eye(6), regression, np.full(6, 0.01), fusion
        )
        assert pose[0] == pytest.approx(offset / 2)
        variances.append(np.linalg.inv(information)[0, 0])
        # Each pose is half the offset away, over deviations of 1 cm.
        assert disagreement == pytest.approx(2 * (offset / 2 / 0.01) ** 2 / 6)
    assert variances[0] == pytest.approx(0.5e-4)
    assert variances[0] < variances[1] < variances[2]


def test_coverage_of_exchangeable_frames():
    generator = np.random.default_rng(5)
    head = ScrHead(msgspec.structs.replace(PARAMETERS, limits=None), "normalised")
    solve = head.solver(seen(CAMERA))
    scores = []
    for _ in range(600):
        truth = pose_near(generator)
        outputs = solve(outputs_of(CAMERA, truth, generator)).outputs
        point = np.zeros((1, 6))
        point[0, :3] = outputs["pose"][0, :3]
        scores.append(head.scores(outputs, point, CHART.coordinates(truth, outputs["pose"]))[0, 0])
    scores = np.array(scores)
    q_hat = np.array([conformal_quantile(column, 0.9) for column in scores[:300].T])
    assert np.abs((scores[300:] <= q_hat).mean(axis=0) - 0.9).max() < 0.06
