"""Recordings for the viewer rerun: its own reader finds the numbers of the records."""

import socket
import sys

import numpy as np
import pytest

from cvo_edge.errors import SinkError, UsageError
from cvo_edge.output import rerun as ours
from cvo_edge.output.messages import Placement, StoredImage
from cvo_edge.output.rerun import RerunSink
from cvo_edge.pose import Pose
from cvo_edge.record import Status

from .test_messages import CHART, HEADER, LOUD, frame, half_open

TURNED = Pose(np.array([5.0, 0.0, 1.0]), np.array([0.0, 0.0, np.sin(0.4), np.cos(0.4)]))
PLACE = Placement("map", "base_link", T_map_world=TURNED)
FRAMES = [frame(seq=0), frame(Status.DEGRADED, seq=1), frame(Status.INVALID, seq=2), frame(seq=3)]


@pytest.fixture(scope="module")
def columns(tmp_path_factory):
    """Entity and component -> {frame: value}, by rerun's own reader."""
    reader = pytest.importorskip("rerun.chunk").RrdReader
    path = tmp_path_factory.mktemp("rrd") / "a.rrd"
    with RerunSink(str(path), HEADER, PLACE) as sink:
        for each in FRAMES:
            sink.write(each, StoredImage("png", b"image %d" % each.seq))
    found = {}
    for chunk in reader(str(path)).stream():
        batch = chunk.to_record_batch()
        rows = {
            name: (column.cast("int64") if name == "stamp" else column).to_pylist()
            for name, column in zip(batch.schema.names, batch.columns, strict=True)
        }
        for column, values in rows.items() if "frame" in rows else ():
            for seq, value in zip(rows["frame"], values, strict=True):
                if value is not None:
                    found.setdefault((chunk.entity_path, column), {})[seq] = value
    return found


def test_the_numbers_are_those_of_the_records(columns):
    positions = columns["/world/camera", "Transform3D:translation"]
    turns = columns["/world/camera", "Transform3D:quaternion"]
    centres = columns["/world/box", "Boxes3D:centers"]
    sizes = columns["/world/box", "Boxes3D:half_sizes"]
    for each in (FRAMES[0], FRAMES[3]):
        pose = each.pose_of(T_map_world=TURNED)
        np.testing.assert_allclose(positions[each.seq][0], pose.t_m, rtol=1e-7)
        np.testing.assert_allclose(turns[each.seq][0], pose.q_xyzw, rtol=1e-6)
        (low, high) = each.position_boxes()[0].T
        middle = TURNED.then(Pose(0.5 * (low + high), np.array([0.0, 0.0, 0.0, 1.0])))
        np.testing.assert_allclose(centres[each.seq][0], middle.t_m, rtol=1e-6)
        np.testing.assert_allclose(sizes[each.seq][0], 0.5 * (high - low), rtol=1e-6)
        point = CHART.point(each.pose.to_array())
        for dof, name in enumerate(CHART.dof):
            band = columns[f"/bands/{name}", "Scalars:scalars"][each.seq]
            assert band == [each.lower[dof], point[dof], each.upper[dof]]
    assert columns["/status", "stamp"] == {each.seq: each.stamp_ns for each in FRAMES}
    assert columns["/latency/total", "Scalars:scalars"] == {seq: [4.0] for seq in range(4)}
    images = columns["/image", "EncodedImage:blob"]
    assert [bytes(images[seq][0]) for seq in range(4)] == [b"image %d" % seq for seq in range(4)]


def test_a_frame_that_may_not_say_a_pose_clears_the_one_before(columns):
    levels = columns["/status", "TextLog:level"]
    assert [levels[seq] for seq in range(4)] == [["INFO"], ["WARN"], ["ERROR"], ["INFO"]]
    for entity in ("/world/camera", "/world/box", "/bands"):
        assert set(columns[entity, "Clear:is_recursive"]) == {1, 2}
    assert set(columns["/world/camera", "Transform3D:translation"]) == {0, 3}
    assert set(columns["/bands/rz", "Scalars:scalars"]) == {0, 3}
    # The path has no piece across frames without a pose.
    assert ("/world/path", "LineStrips3D:strips") not in columns


def test_a_stated_variance_gives_a_pose_and_no_box(tmp_path):
    reader = pytest.importorskip("rerun.chunk").RrdReader
    with RerunSink(str(tmp_path / "a.rrd"), HEADER, LOUD) as sink:
        sink.write(half_open())
    found = {
        (chunk.entity_path, name)
        for chunk in reader(str(tmp_path / "a.rrd")).stream()
        for name in chunk.to_record_batch().schema.names
    }
    assert ("/world/camera", "Transform3D:translation") in found
    assert ("/world/box", "Clear:is_recursive") in found
    assert not any(name.startswith("Boxes3D") for _, name in found)


def test_a_full_disk_is_told(tmp_path):
    pytest.importorskip("rerun")
    full = pytest.raises(SinkError, match="/dev/full: cannot be written: No space left")
    with full, RerunSink("/dev/full", HEADER, PLACE) as sink:
        sink.write(FRAMES[0])


def test_without_library_or_display_one_line_says_what_to_do(monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        # Bound, but nobody listens.
        monkeypatch.setattr(ours, "_PORT", taken.getsockname()[1])
        for name in ("DISPLAY", "WAYLAND_DISPLAY"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setitem(sys.modules, "rerun", sys)
        with pytest.raises(UsageError, match=r"^--view: .* or write -o FILE.rrd$"):
            RerunSink(None, HEADER, PLACE)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UsageError, match=r'pip install "cvo-edge\[rerun\]"'):
        RerunSink("a.rrd", HEADER, PLACE)
