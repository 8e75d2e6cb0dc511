"""Records from two processors: measured differences and tolerances."""

import copy
import math

import msgspec
import numpy as np
import pytest

from boards.compare import (
    Tolerance,
    coverage,
    difference,
    exceeded,
    mean_width,
    stacked,
)
from cvo_edge import Record, geometry
from cvo_edge.pose import Chart

TOLERANCE = Tolerance(share=0.05, moved_share=0.1)
CHART = Chart("tangent_reference", np.array([0.0, 0.0, 0.0, 1.0]))
IDENTITY = [0.0, 0.0, 0.0, 1.0]


def record(number=0, half_width=0.5, bands=None):
    """Return a record of a frame at the origin with sets of +-``half_width``."""
    return {
        "source": f"{number}.jpg",
        "status": "ok",
        "pose": {"t_m": [0.0, 0.0, 0.0], "q_xyzw": IDENTITY},
        "interval": {
            "lower": [-half_width] * 6,
            "upper": [half_width] * 6,
            "bands": bands,
            "bounded": True,
        },
    }


def invalid(number=0):
    return {"source": f"{number}.jpg", "status": "invalid", "pose": None, "interval": None}


def run_of(lines):
    """Return records with the given keys and default values for all others."""
    rest = {"seq": 0, "stamp_ns": None, "reasons": [], "latency_ms": {}}
    chart = {"confidence": 0.9, "scope": "marginal", "rotation": "tangent_reference"}
    return stacked(
        msgspec.convert(
            rest | line | {"interval": line["interval"] and chart | line["interval"]}, Record
        )
        for line in lines
    )


def compared(first, second, tolerance=TOLERANCE):
    return difference(run_of(first), run_of(second), tolerance)


def test_a_run_does_not_differ_from_itself_whatever_is_in_it():
    unbounded = record(1)
    unbounded["interval"].update(lower=[None, *[-0.5] * 5], upper=[None, *[0.5] * 5])
    bands = [[[-0.5, -0.1], [0.1, 0.5]]] * 6
    run = [record(0), unbounded, invalid(2), record(3, bands=bands)]
    found = compared(run, run)
    assert (found.frames, found.statuses, found.bands, found.moved) == (4, 0, 0, 0)
    assert found.position_m == found.rotation_rad == found.bound_m == found.bound_rad == 0.0
    assert exceeded(found, TOLERANCE, stepwise=False) == []


def test_poses_differ_by_distance_and_angle_and_in_units_of_the_mean_width():
    other = record()
    angle = np.array([0.0, 0.03, 0.04])
    other["pose"] = {"t_m": [0.0, 0.3, 0.4], "q_xyzw": geometry.quaternion_exp(angle).tolist()}
    found = compared([record(half_width=1.0)], [other | {"interval": record(0, 1.0)["interval"]}])
    assert found.position_m == pytest.approx(0.5)
    assert found.rotation_rad == pytest.approx(0.05)
    assert found.position_share == pytest.approx(0.25)
    assert found.rotation_share == pytest.approx(0.025)


def test_a_quaternion_and_its_negative_are_one_rotation():
    other = copy.deepcopy(record())
    other["pose"]["q_xyzw"] = [-value for value in IDENTITY]
    assert compared([record()], [other]).rotation_rad == 0.0


@pytest.mark.parametrize("end", ["lower", "upper"])
@pytest.mark.parametrize(("dof", "unit"), [(1, "bound_m"), (4, "bound_rad")])
def test_one_bound_that_moves_is_found(end, dof, unit):
    other = copy.deepcopy(record())
    other["interval"][end][dof] += 0.1
    found = compared([record()], [other])
    assert getattr(found, unit) == pytest.approx(0.1)
    assert found.bound_share == pytest.approx(0.1)
    assert (found.bound_m, found.bound_rad).count(0.0) == 1
    assert found.moved == 1
    assert exceeded(found, TOLERANCE, stepwise=False) != []


def test_a_bound_on_one_side_only_is_infinitely_far():
    other = copy.deepcopy(record())
    other["interval"]["upper"][0] = None
    found = compared([record()], [other])
    assert math.isinf(found.bound_m)
    assert exceeded(found, TOLERANCE, stepwise=False) != []
    assert exceeded(found, Tolerance(share=0.05, moved_share=1.0), stepwise=True) != []


def test_a_status_of_its_own_is_too_much():
    found = compared([record(0), record(1)], [record(0), invalid(1)])
    assert found.statuses == 1
    assert math.isinf(found.position_m)
    assert any(line.startswith("status:") for line in exceeded(found, TOLERANCE, stepwise=True))


def test_few_sets_with_bands_may_change_as_a_class_enters_or_leaves():
    whole, split = [[[-0.5, 0.5]]] * 6, [[[-0.5, -0.1], [0.1, 0.5]], *[[[-0.5, 0.5]]] * 5]
    first = [record(number, bands=whole) for number in range(2)]
    once, both = [record(0, bands=split), first[1]], [record(n, bands=split) for n in range(2)]
    assert compared(first, once).bands == 1
    assert exceeded(compared(first, once), TOLERANCE, stepwise=True) == []
    assert compared(first, both).moved == 2
    assert exceeded(compared(first, both), TOLERANCE, stepwise=True) != []


def test_a_gap_is_no_width():
    gap = [[[-0.5, -0.1], [0.1, 0.5]]] * 6
    assert mean_width(run_of([record(bands=gap)])) == pytest.approx(np.full(6, 0.8))


def test_other_frames_are_refused():
    with pytest.raises(ValueError, match="same frames"):
        compared([record(0)], [record(1)])


def test_coverage_is_the_share_of_frames_whose_set_holds_the_truth():
    truth = {
        "0.jpg": np.array([0.0, 0.0, 0.0, *IDENTITY]),
        "1.jpg": np.array([0.6, 0.0, 0.0, *IDENTITY]),
        "2.jpg": np.array([0.0, 0.0, 0.0, *IDENTITY]),
    }
    # Frame 2 has no pose, and frame 3 has no truth.
    run = run_of([record(0), record(1), invalid(2), record(3)])
    found = coverage(run, CHART, truth)
    assert found == {"frames": 2, "per_dof": [0.5, 1.0, 1.0, 1.0, 1.0, 1.0], "all_six": 0.5}


def test_the_truth_in_a_gap_is_not_covered():
    gap = [[[-0.5, -0.1], [0.1, 0.5]], *[[[-0.5, 0.5]]] * 5]
    truth = {"0.jpg": np.array([0.0, 0.0, 0.0, *IDENTITY])}
    assert coverage(run_of([record(bands=gap)]), CHART, truth)["per_dof"][0] == 0.0
