"""Every sink says of each kind of frame what one table says, to a reader that is not ours."""

import csv
import json
from collections import Counter
from typing import get_args
from urllib.request import urlopen

import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.output.messages import Placement
from cvo_edge.output.opening import open_sink
from cvo_edge.record import Status
from cvo_edge.sets import ConformalSet
from cvo_edge.vocabulary import Format

from .test_messages import CHART, HALF, HEADER, frame

PLACE = Placement(HEADER.frame_id, HEADER.child_frame_id)
OPEN = HALF.copy()
OPEN[4] = np.inf
MIDDLE = CHART.point(frame().pose.to_array())
# Frames; whether a record gives the pose, and whether a message for other programs does.
FRAMES = [
    frame(seq=0),
    frame(found=ConformalSet(MIDDLE - HALF, MIDDLE + OPEN), seq=1),
    frame(Status.DEGRADED, seq=2),
    frame(Status.INVALID, seq=3),
]
RECORDED, SPOKEN = [True, True, True, False], [True, False, False, False]
STATUSES, LEVELS = ["ok", "ok", "degraded", "invalid"], [0, 1, 1, 2]
WANTED = frame().pose.to_array()


def written(tmp_path, format):
    path = tmp_path / f"a.{format}"
    with open_sink(str(path), format, HEADER) as sink:
        for each in FRAMES:
            sink.write(each)
    return path


def by_seq(found):
    """Values by sequence number -> a list for all frames, None where there is none."""
    return [found.get(seq) for seq in range(len(FRAMES))]


def poses_are(found, given):
    """The poses given are those of these frames, with these numbers."""
    assert [each is not None for each in found] == given
    for each in found:
        if each is not None:
            np.testing.assert_allclose(each, WANTED, rtol=1e-6, atol=1e-8)


def bounds_are(lower, upper):
    """Bounds (6,) of all frames; None for an unbounded side, and for all of a frame without."""
    for seq, (one, half) in enumerate(zip((lower, upper), (-HALF, HALF), strict=True)):
        wanted = (MIDDLE + half).tolist()
        assert one[0] == pytest.approx(wanted)
        assert (one[1][4] is None) == bool(seq)
        assert [*one[1][:4], one[1][5]] == pytest.approx([*wanted[:4], wanted[5]])
        assert not any(each is not None for frame in one[2:] for each in frame or ())


def check_jsonl(path):
    _, *records = map(json.loads, path.read_text().splitlines())
    assert [each["status"] for each in records] == STATUSES
    poses = [each["pose"] and [*each["pose"]["t_m"], *each["pose"]["q_xyzw"]] for each in records]
    poses_are(poses, RECORDED)
    intervals = [each["interval"] or {} for each in records]
    bounds_are(*([each.get(side) for each in intervals] for side in ("lower", "upper")))


def check_csv(path):
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    assert [each["status"] for each in rows] == STATUSES
    names = ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")
    numbers = [{key: float(text) if text else None for key, text in row.items()
                if key in names or key.endswith(("_lower", "_upper"))} for row in rows]  # fmt: skip
    poses = [[each[name] for name in names] for each in numbers]
    poses_are([None if None in each else each for each in poses], RECORDED)
    sides = ("lower", "upper")
    bounds_are(
        *([[row[f"{dof}_{side}"] for dof in CHART.dof] for row in numbers] for side in sides)
    )


def check_tum(path):
    rows = np.loadtxt(path)
    stamps = [FRAMES[seq].stamp_ns * 1e-9 for seq in range(3)]
    np.testing.assert_allclose(rows[:, 0], stamps, rtol=1e-15)
    poses_are([*rows[:, 1:], None], RECORDED)


def check_table(path):
    lines = [line.split() for line in path.read_text().splitlines()[-len(FRAMES) :]]
    assert [words[1] for words in lines] == STATUSES
    assert [words[2:5] == ["1.000", "2.000", "3.000"] for words in lines] == RECORDED
    assert ["inf" in words for words in lines] == [False, True, False, False]
    assert ["±2.0" in words for words in lines] == [True, True, False, False]


def check_mcap(path):
    read = pytest.importorskip("mcap_ros2.reader").read_ros2_messages
    poses, levels = {}, []
    stamps = {each.stamp_ns: each.seq for each in FRAMES}
    for each in read(str(path)):
        message = each.ros_msg
        if each.channel.topic == "/cvo/pose":
            position, turn = message.pose.pose.position, message.pose.pose.orientation
            found = [position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w]
            poses[stamps[each.log_time_ns]] = found
            assert message.pose.covariance == FRAMES[0].covariance().ravel().tolist()
        if each.channel.topic == "/diagnostics":
            level = message.status[0].level
            levels.append(level[0] if isinstance(level, bytes) else level)
    poses_are(by_seq(poses), SPOKEN)
    assert levels == LEVELS


def check_rrd(path):
    reader = pytest.importorskip("rerun.chunk").RrdReader
    found, statuses = {}, {}
    for chunk in reader(str(path)).stream():
        batch = chunk.to_record_batch()
        rows = {name: batch[name] for name in batch.schema.names if name != "stamp"}
        for name, column in rows.items() if "frame" in rows else ():
            for seq, value in zip(rows["frame"].to_pylist(), column.to_pylist(), strict=True):
                if value is not None:
                    found.setdefault((chunk.entity_path, name), {})[seq] = value
    positions = found["/world/camera", "Transform3D:translation"]
    turns = found["/world/camera", "Transform3D:quaternion"]
    poses_are(by_seq({seq: [*positions[seq][0], *turns[seq][0]] for seq in positions}), SPOKEN)
    statuses = found["/status", "TextLog:level"]
    assert [statuses[seq][0] for seq in range(4)] == ["INFO", "WARN", "WARN", "ERROR"]


CHECKS = {
    "jsonl": check_jsonl,
    "csv": check_csv,
    "tum": check_tum,
    "table": check_table,
    "mcap": check_mcap,
    "rrd": check_rrd,
}


def test_every_format_is_checked():
    assert set(CHECKS) == set(get_args(Format))


@pytest.mark.parametrize("format", CHECKS)
def test_a_file_says_what_the_table_says(format, tmp_path):
    pytest.importorskip({"mcap": "mcap.writer", "rrd": "rerun"}.get(format, "json"))
    CHECKS[format](written(tmp_path, format))


def test_an_autopilot_hears_what_the_table_says():
    mavutil = pytest.importorskip("pymavlink.mavutil")
    pytest.importorskip("serial", reason="pymavlink needs pyserial")
    from cvo_edge.output.mavlink import MavlinkSink

    peer = mavutil.mavlink_connection("udpin:127.0.0.1:0")
    address = f"udpout:127.0.0.1:{peer.port.getsockname()[1]}"
    with MavlinkSink(address, PLACE) as sink:
        for each in FRAMES:
            sink.write(each)
    stamps, poses = {each.stamp_ns // 1000: each.seq for each in FRAMES}, {}
    for _ in range(sink.sent):
        got = peer.recv_match(type="VISION_POSITION_ESTIMATE", blocking=True, timeout=5)
        turn = geometry.euler_zyx_to_quaternion(np.array([got.roll, got.pitch, got.yaw]))
        poses[stamps[got.usec]] = [got.x, got.y, got.z, *turn]
    peer.close()
    poses_are(by_seq(poses), SPOKEN)


def test_metrics_count_what_the_table_says():
    parser = pytest.importorskip("prometheus_client.parser")
    from cvo_edge.output.metrics import MetricsSink

    with MetricsSink(0) as sink:
        for each in FRAMES:
            sink.write(each)
        with urlopen(f"http://127.0.0.1:{sink.port}/metrics") as answer:
            text = answer.read().decode()
    samples = {
        (each.name, *each.labels.values()): each.value
        for family in parser.text_string_to_metric_families(text)
        for each in family.samples
    }
    counts = {status: samples["cvo_frames_total", status] for status in set(STATUSES)}
    assert counts == Counter(STATUSES)
    assert samples["cvo_unbounded_frames_total",] == SPOKEN.count(False)
    widths = [samples["cvo_width", dof] for dof in CHART.dof]
    np.testing.assert_allclose(widths, 2.0 * HALF)
