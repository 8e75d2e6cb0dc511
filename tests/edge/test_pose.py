"""Charts, sets, records."""

import json

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cvo_edge import geometry
from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.pose import Chart, Pose
from cvo_edge.record import Reason, Status
from cvo_edge.sets import ConformalSet, unbounded_set

rotvecs = arrays(np.float64, 3, elements=st.floats(-1.0, 1.0))
translations = arrays(np.float64, 3, elements=st.floats(-5.0, 5.0))


def pose_at(t, rotvec):
    return np.concatenate([t, geometry.quaternion_exp(rotvec)])


def estimate(region, pose=None, chart=None, status=Status.OK):
    return PoseInterval(
        seq=0,
        stamp_ns=None,
        source="a.png",
        status=status,
        reasons=(),
        pose=Pose.from_array(pose if pose is not None else [0, 0, 0, 0, 0, 0, 1]),
        conformal_set=region,
        confidence=0.9,
        scope="marginal",
        chart=chart or Chart("tangent_predicted"),
    )


@given(translations, rotvecs)
def test_the_prediction_is_its_own_origin(t, v):
    pose = pose_at(t, v)
    found = Chart("tangent_predicted").coordinates(pose, pose)
    np.testing.assert_allclose(found, [*t, 0, 0, 0], atol=1e-7)


@given(translations, rotvecs)
def test_tangent_at_a_reference_gives_back_the_rotation_vector(t, v):
    reference = geometry.quaternion_exp([0.3, -0.2, 0.5])
    pose = np.concatenate([t, geometry.quaternion_multiply(reference, geometry.quaternion_exp(v))])
    found = Chart("tangent_reference", reference).coordinates(pose, pose)
    np.testing.assert_allclose(found, [*t, *v], atol=1e-7)


@pytest.mark.parametrize("rotation", ["tangent_reference", "tangent_predicted", "euler_zyx"])
@given(translations, arrays(np.float64, 3, elements=st.floats(-1.8, 1.8)))
def test_the_point_is_the_poses_own_coordinates(rotation, t, v):
    reference = geometry.quaternion_exp([0.3, -0.2, 0.5])
    chart = Chart(rotation, reference if rotation == "tangent_reference" else None)
    pose = pose_at(t, v)
    expected = chart.coordinates(pose, pose)
    if np.linalg.norm(expected[3:]) < 3.14:  # at half a turn both signs are right
        np.testing.assert_allclose(chart.point(pose), expected, atol=1e-9)


def test_yaw_across_the_cut_is_near_the_prediction():
    chart = Chart("euler_zyx")
    at = [
        np.concatenate([np.zeros(3), geometry.euler_zyx_to_quaternion([0, 0, y])])
        for y in (3.1, -3.1)
    ]
    assert chart.coordinates(at[1], at[0])[5] == pytest.approx(2 * np.pi - 3.1)
    centre = np.array([0, 0, 0, 0, 0, 3.1])
    interval = ConformalSet(centre - 0.1, centre + 0.1)
    assert interval.upper[5] > np.pi
    assert estimate(interval, at[0], chart).contains(at[1])


@pytest.mark.parametrize("rotation", ["tangent_reference", "tangent_predicted", "euler_zyx"])
@given(
    st.booleans(),
    arrays(np.float64, (2, 4), elements=st.floats(-1.0, 1.0)).filter(
        lambda q: (np.linalg.norm(q, axis=1) > 0.1).all()
    ),
    arrays(np.float64, (2, 6), elements=st.floats(0.0, 9.0) | st.just(np.inf)),
)
# A band beyond half a turn, and a pose at half a turn.
@example(True, np.array([[0.0, 1.0, 1.0, -1e-218], [0.0, 1.0, 0.0, 1.0]]), np.full((2, 6), 7.0))
def test_a_set_trimmed_to_half_a_turn_covers_the_same_poses(rotation, disjoint, turns, reach):
    chart = Chart(rotation, np.array([0.5, 0.5, -0.5, 0.5]) if "reference" in rotation else None)
    poses = [np.concatenate([np.zeros(3), geometry.quaternion_normalise(q)]) for q in turns]
    point, truth = (chart.coordinates(pose, poses[0]) for pose in poses)
    lower, upper = point - reach[0], point + reach[1]
    bands = None
    if disjoint:
        cuts = zip(
            lower.tolist(),
            point.tolist(),
            (point + reach[1] / 2).tolist(),
            upper.tolist(),
            strict=True,
        )
        bands = tuple(((a, b), (c, d)) if np.isfinite(d - a) else ((a, d),) for a, b, c, d in cuts)
    whole = ConformalSet(lower, upper, bands)
    trimmed = whole.trimmed(chart.turn_centre(point))
    np.testing.assert_array_equal(trimmed.covers(truth), whole.covers(truth))
    np.testing.assert_array_equal(np.isfinite(trimmed.lower), np.isfinite(whole.lower))
    np.testing.assert_array_equal(np.isfinite(trimmed.upper), np.isfinite(whole.upper))
    width = trimmed.width()
    assert (width[3:][np.isfinite(width[3:])] <= 2 * np.pi + 1e-9).all()
    np.testing.assert_array_equal(width[:3], whole.width()[:3])


def test_bands_respect_the_gap_and_width_is_that_of_the_union():
    bands = (((-1.0, -0.5), (0.5, 1.0)),) + (((-1.0, 1.0),),) * 5
    region = ConformalSet(np.full(6, -1.0), np.full(6, 1.0), bands)
    assert region.covers(np.zeros(6)).tolist() == [False] + [True] * 5
    assert region.covers(np.full(6, 0.7)).all()
    np.testing.assert_array_equal(region.width(), [1.0] + [2.0] * 5)
    np.testing.assert_array_equal(region.distance(np.zeros(6)), [0.5] + [0.0] * 5)


def test_distance_is_zero_exactly_inside():
    region = ConformalSet(np.zeros(6), np.ones(6))
    np.testing.assert_array_equal(region.distance([0, 0.5, 1, 2, -1, 1.5]), [0, 0, 0, 1, 1, 0.5])


def test_unbounded_is_null_in_the_record_and_infinite_in_the_covariance():
    found = estimate(unbounded_set())
    record = json.loads(msgspec.json.encode(found.to_dict()))
    assert record["interval"]["lower"] == [None] * 6
    assert record["interval"]["bounded"] is False
    assert np.isinf(np.diag(found.covariance())).all()
    assert found.contains([9, 9, 9, 0, 0, 1, 0])


def test_covariance_is_the_square_of_half_width_over_z():
    found = estimate(ConformalSet(np.full(6, -1.6448536), np.full(6, 1.6448536)))
    np.testing.assert_allclose(found.covariance(), np.eye(6), rtol=1e-6)


def test_an_invalid_frame_has_no_set_to_ask():
    found = PoseInterval(
        3,
        None,
        "",
        Status.INVALID,
        (Reason.IMAGE_UNREADABLE,),
        None,
        unbounded_set(),
        0.9,
        "marginal",
        Chart("tangent_predicted"),
    )
    with pytest.raises(UsageError, match="frame 3 is invalid"):
        found.contains(np.array([0, 0, 0, 0, 0, 0, 1]))
    assert found.to_dict()["pose"] is None
    assert found.to_dict()["interval"] is None


@given(translations, rotvecs)
def test_pose_round_trips_through_its_matrix(t, v):
    pose = Pose.from_array(pose_at(t, v))
    np.testing.assert_allclose(
        Pose.from_matrix(pose.to_matrix()).to_array(), pose.to_array(), atol=1e-9
    )


@pytest.mark.parametrize("bad", [[0] * 7, [np.nan, 0, 0, 0, 0, 0, 1], [0, 0, 0, 1], "abc"])
def test_what_is_no_pose_is_refused(bad):
    with pytest.raises(UsageError, match="expected 7 finite numbers"):
        Pose.from_array(bad)


def test_results_are_frozen():
    with pytest.raises(AttributeError):
        estimate(unbounded_set()).seq = 5
    with pytest.raises(ValueError, match="read-only"):
        unbounded_set().lower[0] = 0.0
