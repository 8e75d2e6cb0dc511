"""What other programs are told of a frame: one rule for every sink, and files that others read."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.output.messages import Placement, ros_messages, spoken
from cvo_edge.output.records import Header, estimate_of, read_records
from cvo_edge.output.sinks import Sink
from cvo_edge.pose import Chart, Pose
from cvo_edge.record import Reason, Status
from cvo_edge.sets import ConformalSet, Ellipsoids, unbounded_set

HALF = np.array([0.02, 0.01, 0.03, 0.008, 0.006, 0.01])
CHART = Chart("tangent_predicted")
HEADER = Header(
    software="cvo-edge 0",
    bundle="b",
    method="mcqr",
    digest="0" * 64,
    precision="fp32",
    provider="onnxruntime",
    frame_id="world",
    child_frame_id="camera",
    rotation="tangent_predicted",
    reference_q_xyzw=None,
    dof=CHART.dof,
    units=("m", "rad"),
    confidence=0.9,
    scope="joint",
    stamps="fps",
)
HERE = Placement("map", "base_link")
LOUD = Placement("map", "base_link", unknown_variance=1e6)


def frame(status=Status.OK, found=None, seq=0, bands=None):
    pose = Pose(np.array([1.0, 2.0, 3.0]), geometry.quaternion_exp([0.3, -0.2, 0.1]))
    middle = CHART.point(pose.to_array())
    if status is not Status.OK:
        found = unbounded_set()
    elif found is None:
        found = ConformalSet(middle - HALF, middle + HALF, bands)
    reasons = () if status is Status.OK else (Reason.IMAGE_BLACK,)
    given = None if status is Status.INVALID else pose
    stamp_ns = 1_700_000_000_123_456_789 + seq * 10**8
    return PoseInterval(
        *(seq, stamp_ns, f"f{seq}.jpg", status, reasons, given, found, 0.9, "joint", CHART),
        {"total": 4.0},
    )


def half_open():
    upper = HALF.copy()
    upper[4] = np.inf
    return frame(found=ConformalSet(-HALF, upper))


def without_width():
    point = CHART.point(frame().pose.to_array())
    return frame(found=ConformalSet(point, point))


# Estimate, whether its pose is given, whether it is with a stated variance, level of diagnostics.
CASES = {
    "ok": (frame(), True, True, 0),
    "ok without width": (without_width(), False, True, 0),
    "ok, a side unbounded": (half_open(), False, True, 1),
    "degraded": (frame(Status.DEGRADED), False, True, 1),
    "invalid": (frame(Status.INVALID), False, False, 2),
}


def numbers(content):
    """Yield every number of a message."""
    if isinstance(content, dict):
        for value in content.values():
            yield from numbers(value)
    elif isinstance(content, list | tuple):
        for value in content:
            yield from numbers(value)
    elif isinstance(content, int | float):
        yield content


@pytest.mark.parametrize(("estimate", "quiet", "loud", "level"), CASES.values(), ids=CASES)
def test_one_rule_says_what_a_frame_may_say(estimate, quiet, loud, level):
    for placement, given in ((HERE, quiet), (LOUD, loud)):
        said = spoken(estimate, placement)
        assert (said is not None) == given
        messages = {each.topic: each.content for each in ros_messages(estimate, placement, HEADER)}
        assert ("/cvo/pose" in messages) == ("/tf" in messages) == given
        assert messages["/diagnostics"]["status"][0]["level"] == level
        boxes = len(messages["/cvo/box"]["markers"]) - 1
        assert boxes == (given and estimate.bounded)
        assert all(map(math.isfinite, numbers(messages)))
        if said is not None:
            assert (np.linalg.eigvalsh(said.covariance) > 0.0).all()


def test_a_set_in_pieces_is_several_boxes():
    bands = (((0.9, 0.95), (1.0, 1.02)), *(((2.0, 2.1),), ((3.0, 3.1),)), *((((0.0, 0.1),),) * 3))
    messages = {each.topic: each.content for each in ros_messages(frame(bands=bands), HERE, HEADER)}
    _, first, second = messages["/cvo/box"]["markers"]
    assert [first["scale"]["x"], second["scale"]["x"]] == pytest.approx([0.05, 0.02])
    assert [first["id"], second["id"]] == [0, 1]


@pytest.mark.parametrize("stamp_ns", [None, -(2**31) * 10**9 - 1, 2**31 * 10**9])
def test_a_stamp_that_ros_cannot_hold_is_refused(stamp_ns):
    with pytest.raises(UsageError, match="stamp: expected one"):
        list(ros_messages(replace(frame(), stamp_ns=stamp_ns), HERE, HEADER))


def test_a_record_gives_its_estimate_back(tmp_path):
    region = Ellipsoids(np.arange(12.0).reshape(2, 6), np.eye(6), 2.0)
    frames = [
        frame(seq=0),
        frame(found=ConformalSet(-HALF, HALF, ellipsoids=region), seq=1),
        frame(Status.DEGRADED, seq=2),
        frame(Status.INVALID, seq=3),
    ]
    path = tmp_path / "a.jsonl"
    with Sink(str(path), "jsonl", HEADER, region=True) as sink:
        for each in frames:
            sink.write(each)
    records = read_records(path)
    for wanted, record in zip(frames, records, strict=True):
        assert estimate_of(record, records.header).to_record(region=True) == wanted.to_record(
            region=True
        )
