"""Laws of the rotation group, tested with hypothesis."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cvo_edge import geometry as g

component = st.floats(-1.0, 1.0, width=32)
quaternions = (
    arrays(np.float64, 4, elements=component)
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(g.quaternion_normalise)
)
vectors = arrays(np.float64, 3, elements=st.floats(-1.8, 1.8))


def same_rotation(p, q, tolerance=1e-9):
    return abs(abs(float(np.dot(p, q))) - 1.0) < tolerance


@given(quaternions, quaternions, quaternions)
def test_product_is_associative(p, q, r):
    left = g.quaternion_multiply(g.quaternion_multiply(p, q), r)
    right = g.quaternion_multiply(p, g.quaternion_multiply(q, r))
    np.testing.assert_allclose(left, right, atol=1e-12)


@given(quaternions)
def test_inverse_gives_the_identity(q):
    identity = g.quaternion_multiply(q, g.quaternion_conjugate(q))
    np.testing.assert_allclose(identity, [0, 0, 0, 1], atol=1e-12)


@given(quaternions, quaternions)
def test_matrices_multiply_as_quaternions_do(p, q):
    product = g.quaternion_to_matrix(g.quaternion_multiply(p, q))
    np.testing.assert_allclose(
        product, g.quaternion_to_matrix(p) @ g.quaternion_to_matrix(q), atol=1e-12
    )


@given(quaternions)
def test_matrix_round_trip(q):
    R = g.quaternion_to_matrix(q)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert same_rotation(g.matrix_to_quaternion(R), q)


@given(vectors)
def test_exp_and_log_are_inverse_inside_the_ball(v):
    if np.linalg.norm(v) < 3.1:
        np.testing.assert_allclose(g.quaternion_log(g.quaternion_exp(v)), v, atol=1e-9)


@given(quaternions)
def test_log_is_no_longer_than_half_a_turn(q):
    v = g.quaternion_log(q)
    assert np.linalg.norm(v) <= np.pi + 1e-9
    assert same_rotation(g.quaternion_exp(v), q)


@given(quaternions)
def test_euler_round_trip(q):
    euler = g.quaternion_to_euler_zyx(q)
    assert same_rotation(g.euler_zyx_to_quaternion(euler), q, 1e-8)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_euler_round_trip_at_the_poles(pitch):
    q = g.euler_zyx_to_quaternion([0.0, pitch, 0.7])
    assert same_rotation(g.euler_zyx_to_quaternion(g.quaternion_to_euler_zyx(q)), q, 1e-8)


@given(st.floats(-1e3, 1e3))
def test_wrapping_changes_by_whole_turns(angle):
    wrapped = float(g.wrap_angle(angle))
    assert -np.pi - 1e-9 <= wrapped <= np.pi + 1e-9
    turns = (angle - wrapped) / (2 * np.pi)
    assert abs(turns - round(turns)) < 1e-9


@given(quaternions, arrays(np.float64, (3, 3), elements=st.floats(-1e-4, 1e-4)))
def test_nearest_rotation_undoes_a_small_disturbance(q, noise):
    R = g.quaternion_to_matrix(q)
    found = g.nearest_rotation(R + noise)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)
    np.testing.assert_allclose(found, R, atol=1e-3)


def test_nearest_rotation_never_reflects():
    assert np.linalg.det(g.nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)


@given(quaternions)
def test_mean_of_a_rotation_and_its_negative_is_itself(q):
    assert same_rotation(g.mean_rotation(np.stack([q, -q, q])), q)


def test_a_zero_quaternion_is_no_rotation():
    assert np.isnan(g.quaternion_normalise(np.zeros(4))).all()


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@given(quaternions, vectors)
def test_agrees_with_scipy(q, v):
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    np.testing.assert_allclose(
        g.quaternion_to_matrix(q), rotation.from_quat(q).as_matrix(), atol=1e-12
    )
    assert same_rotation(g.quaternion_exp(v), rotation.from_rotvec(v).as_quat())
    rolled = rotation.from_quat(q).as_euler("ZYX")[::-1]
    if abs(abs(rolled[1]) - np.pi / 2) > 1e-3:
        difference = g.wrap_angle(g.quaternion_to_euler_zyx(q) - rolled)
        np.testing.assert_allclose(difference, 0.0, atol=1e-7)
