"""What an autopilot at the other end of a link reads is the frame's pose and covariance."""

import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.errors import SinkError
from cvo_edge.estimate import PoseInterval
from cvo_edge.input.clock import Clock
from cvo_edge.output.messages import Placement
from cvo_edge.pose import Chart, Pose
from cvo_edge.record import Reason, Status
from cvo_edge.sets import ConformalSet, unbounded_set

mavutil = pytest.importorskip("pymavlink.mavutil")
pytest.importorskip("serial", reason="pymavlink needs pyserial")

HALF = np.array([0.02, 0.01, 0.03, 0.008, 0.006, 0.01])
PLACE = Placement("ned", "frd")


class Still(Clock):
    """A clock that stands still: one heartbeat."""

    def now_s(self):
        return 0.0


def frame(seq, x=1.0, status=Status.OK, turn=(0.1, -0.2, 0.7)):
    q = geometry.euler_zyx_to_quaternion(np.array(turn))
    pose = Pose(np.array([x, 2.0, 3.0]), q)
    chart = Chart("euler_zyx")
    middle = chart.point(pose.to_array())
    found = ConformalSet(middle - HALF, middle + HALF) if status is Status.OK else unbounded_set()
    reasons = () if status is Status.OK else (Reason.IMAGE_UNFAMILIAR,)
    given = None if status is Status.INVALID else pose
    return PoseInterval(
        seq, 10**18 + seq * 10**8, "", status, reasons, given, found, 0.9, "marginal", chart
    )


@pytest.fixture
def exchange():
    """Return a function from frames to the poses that a peer on loopback receives."""
    from cvo_edge.output.mavlink import MavlinkSink

    peer = mavutil.mavlink_connection("udpin:127.0.0.1:0")
    port = peer.port.getsockname()[1]

    def send(frames, placement=PLACE):
        with MavlinkSink(f"udpout:127.0.0.1:{port}", placement, Still()) as sink:
            for each in frames:
                sink.write(each)
        assert peer.recv_match(type="HEARTBEAT", blocking=True, timeout=5) is not None
        return [
            peer.recv_match(type="VISION_POSITION_ESTIMATE", blocking=True, timeout=5)
            for _ in range(sink.sent)
        ]

    yield send
    peer.close()


def test_a_pose_arrives_with_its_covariance(exchange):
    (got,) = exchange([frame(7)])
    assert got.usec == 10**15 + 7 * 10**5
    np.testing.assert_allclose([got.x, got.y, got.z], [1.0, 2.0, 3.0])
    np.testing.assert_allclose([got.roll, got.pitch, got.yaw], [0.1, -0.2, 0.7], atol=1e-6)
    covariance = np.zeros((6, 6))
    covariance[np.triu_indices(6)] = got.covariance
    # The chart's own numbers are roll, pitch and yaw.
    np.testing.assert_allclose(covariance, frame(7).covariance("chart"), rtol=1e-5, atol=1e-12)


def test_frames_that_are_not_ok_are_not_sent(exchange):
    bad = [frame(1, status=Status.DEGRADED), frame(2, status=Status.INVALID)]
    assert [got.usec for got in exchange([frame(0), *bad, frame(3)])] == [10**15, 10**15 + 300_000]


def test_a_pose_straight_up_is_not_sent(exchange):
    assert len(exchange([frame(0, turn=(0.0, 1.55, 0.0)), frame(1)])) == 1


def test_pauses_and_jumps_count_as_resets(exchange):
    got = exchange([frame(0), frame(1), frame(2, x=30.0), frame(3, x=30.0), frame(30, x=30.0)])
    assert [each.reset_counter for each in got] == [0, 0, 1, 1, 2]


@pytest.mark.parametrize(
    ("address", "match"),
    [
        ("udpout:127.0.0.1:99999", "expected a port from 1 to 65535, found 99999"),
        ("udpout:127.0.0.1:0", "expected a port from 1 to 65535, found 0"),
        ("udpout:no host:14550", "does not open"),
    ],
)
def test_an_address_that_nothing_can_be_sent_to_is_refused(address, match, capsys):
    from cvo_edge.output.mavlink import MavlinkSink

    with pytest.raises(SinkError, match=match):
        MavlinkSink(address, PLACE)
    assert capsys.readouterr().out == ""


def test_a_refused_connection_prints_nothing_among_the_records(monkeypatch, capsys):
    from cvo_edge.output.mavlink import MavlinkSink

    def refused(*_args, **_options):
        print("[Errno 111] Connection refused sleeping")
        raise ConnectionRefusedError(111, "Connection refused")

    monkeypatch.setattr(mavutil, "mavlink_connection", refused)
    with pytest.raises(SinkError, match=r"does not open: .*Connection refused"):
        MavlinkSink("tcp:127.0.0.1:1", PLACE)
    assert capsys.readouterr().out == ""
