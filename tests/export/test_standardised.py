"""Laws of the network's target: any rotation and any motion become numbers and come back."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from cvo_edge.pose import Chart
from cvo_export.datasets.motion import STILL_M, STILL_RAD
from cvo_export.networks.standardised import PoseDecoder, Target, fit_target


def _poses(rotations: Rotation, seed: int = 0) -> np.ndarray:
    position = np.random.default_rng(seed).normal(size=(len(rotations), 3))
    return np.concatenate([position, rotations.as_quat()], axis=1)


# A ball of 1 rad, all rotations, and full turns about one axis, upside down among them.
_NEAR = _poses(Rotation.from_rotvec(0.3 * np.random.default_rng(1).normal(size=(300, 3))))
_ANY = _poses(Rotation.random(300, rng=np.random.default_rng(2)))
_TURNS = _poses(
    Rotation.from_euler("z", np.linspace(0, 4 * np.pi, 300)[:, None])
    * Rotation.from_euler("x", -1.6)
)


@pytest.mark.parametrize("poses", [_NEAR, _ANY, _TURNS])
def test_poses_come_back_from_their_standardised_numbers(poses: np.ndarray) -> None:
    target = fit_target(poses)
    decoder = PoseDecoder(target)
    y = torch.tensor(target.standardised(poses), dtype=torch.float32)
    found = decoder.pose(decoder(y)).double().numpy()
    assert found[:, :3] == pytest.approx(poses[:, :3], abs=1e-5)
    turned = Rotation.from_quat(poses[:, 3:]).inv() * Rotation.from_quat(found[:, 3:])
    assert turned.magnitude().max() < 2e-3


def test_only_wide_rotations_get_nine_numbers() -> None:
    assert [fit_target(poses).size for poses in (_NEAR, _ANY, _TURNS)] == [6, 9, 9]


def test_numbers_of_any_two_near_rotations_are_near() -> None:
    target = fit_target(_ANY)
    step = Rotation.from_rotvec(1e-3 * np.random.default_rng(3).normal(size=(300, 3)))
    moved = _ANY.copy()
    moved[:, 3:] = (Rotation.from_quat(_ANY[:, 3:]) * step).as_quat()
    difference = target.standardised(moved) - target.standardised(_ANY)
    assert np.linalg.norm(difference[:, 3:], axis=1).max() < 0.02


@pytest.mark.parametrize("poses", [_ANY, _TURNS])
def test_errors_are_those_of_the_chart_at_the_prediction(poses: np.ndarray) -> None:
    target = fit_target(poses)
    decoder = PoseDecoder(target)
    generator = np.random.default_rng(4)
    predicted = torch.tensor(
        target.standardised(poses) + 0.1 * generator.normal(size=(300, 9)), dtype=torch.float32
    )
    y = torch.tensor(target.standardised(poses), dtype=torch.float32)
    pose = decoder.pose(decoder(predicted)).double().numpy()
    chart = Chart("tangent_predicted")
    expected = chart.coordinates(poses, pose) - chart.coordinates(pose, pose)
    found = decoder.errors(predicted, y).double().numpy() * target.deviation
    assert found == pytest.approx(expected, abs=3e-3)


def test_bounds_about_a_prediction_hold_exactly_the_errors_within() -> None:
    target = fit_target(_ANY)
    decoder = PoseDecoder(target)
    point = torch.tensor(target.standardised(_ANY[:5]), dtype=torch.float32)
    offset = torch.full((5, 6), 0.5)
    pose, lower, upper = decoder.interval(point, -offset, 2 * offset)
    origin = Chart("tangent_predicted").coordinates(pose.numpy(), pose.numpy())
    assert lower.numpy() - origin == pytest.approx(
        np.tile(-0.5 * target.deviation, (5, 1)), abs=1e-5
    )
    assert upper.numpy() - origin == pytest.approx(np.tile(target.deviation, (5, 1)), abs=1e-5)


def test_decoding_and_its_gradient_are_finite_where_columns_vanish_or_agree() -> None:
    decoder = PoseDecoder(fit_target(_ANY))
    numbers = torch.zeros((3, 9), requires_grad=True)
    with torch.no_grad():
        numbers[1, 3:] = torch.tensor([1.0, 0, 0, 1.0, 0, 0])
        numbers[2, 3:] = torch.tensor([1.0, 0, 0, -1.0, 0, 0])
    pose = decoder.pose(numbers)
    pose.sum().backward()
    assert torch.isfinite(pose).all()
    assert numbers.grad is not None
    assert torch.isfinite(numbers.grad).all()


def test_what_stands_still_has_a_floor_and_a_name() -> None:
    wheeled = _NEAR.copy()
    wheeled[:, 2] = 0.4
    wheeled[:, 3:] = Rotation.from_rotvec(
        np.outer(np.linspace(-0.5, 0.5, 300), [0, 1, 0])
    ).as_quat()
    target = fit_target(wheeled)
    assert target.still_dof == ("tz", "rx", "rz")
    assert target.deviation[2] == pytest.approx(0.01 * wheeled[:, :2].std(axis=0).max())
    assert target.deviation[[3, 5]] == pytest.approx(STILL_RAD, rel=1e-6)
    at_rest = np.tile(_NEAR[:1], (20, 1))
    assert fit_target(at_rest).deviation == pytest.approx([STILL_M] * 3 + [STILL_RAD] * 3)
    assert np.isfinite(fit_target(at_rest).standardised(at_rest)).all()


def test_a_stored_target_is_restored_also_from_earlier_runs() -> None:
    target = fit_target(_ANY)
    restored = Target.of_arrays(target.arrays())
    assert restored.standardised(_ANY) == pytest.approx(target.standardised(_ANY), abs=0)
    earlier = Target.of_arrays(fit_target(_NEAR).arrays()[:3])
    assert earlier.still_dof == ()
    assert earlier.standardised(_NEAR) == pytest.approx(fit_target(_NEAR).standardised(_NEAR))
