"""MCAP files are read by independent readers, and survive what kills their writer."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cvo_edge.errors import SinkError, SourceError, UsageError
from cvo_edge.output.messages import Placement, StoredImage
from cvo_edge.output.named import reopen_files
from cvo_edge.output.sinks import Sink
from cvo_edge.pose import Pose
from cvo_edge.programs.conversion import convert
from cvo_edge.programs.placing import Placing
from cvo_edge.record import Status

from .test_messages import HEADER, frame

pytest.importorskip("mcap.writer")
read_ros2 = pytest.importorskip("mcap_ros2.reader").read_ros2_messages
AnyReader = pytest.importorskip("rosbags.highlevel").AnyReader

from cvo_edge.output.mcap import McapSink, recover  # noqa: E402 - after the libraries are known

TURNED = Pose(np.array([5.0, 0.0, 1.0]), np.array([0.0, 0.0, np.sin(0.4), np.cos(0.4)]))
PLACE = Placement("map", "base_link", T_map_world=TURNED)
NOWHERE = Placing(None, None, None, None, None)
FRAMES = [frame(seq=0), frame(Status.DEGRADED, seq=1), frame(Status.INVALID, seq=2), frame(seq=3)]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("mcap") / "a.mcap"
    with McapSink(str(path), HEADER, PLACE) as sink:
        for each in FRAMES:
            sink.write(each, StoredImage("jpeg", b"image %d" % each.seq))
    return path


def of_topic(path, topic):
    return [each.ros_msg for each in read_ros2(str(path)) if each.channel.topic == topic]


def test_an_independent_decoder_reads_the_same_numbers(written):
    poses = of_topic(written, "/cvo/pose")
    assert len(poses) == 2
    for got, wanted in zip(poses, (FRAMES[0], FRAMES[3]), strict=True):
        stamp = got.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == wanted.stamp_ns
        assert got.header.frame_id == "map"
        pose = wanted.pose_of(T_map_world=TURNED)
        position, turn = got.pose.pose.position, got.pose.pose.orientation
        found = [position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w]
        assert found == pose.to_array().tolist()
        covariance = wanted.covariance(T_map_world=TURNED)
        assert got.pose.covariance == covariance.ravel().tolist()
    assert [each.data for each in of_topic(written, "/cvo/image")] == [
        b"image %d" % seq for seq in range(4)
    ]
    levels = [each.status[0].level for each in of_topic(written, "/diagnostics")]
    assert [int.from_bytes(each) if isinstance(each, bytes) else each for each in levels] == [
        *(0, 1, 2, 0)
    ]
    (transform,) = of_topic(written, "/tf")[0].transforms
    assert transform.child_frame_id == "base_link"


def test_a_strict_reader_takes_every_message(written):
    with AnyReader([written]) as reader:
        found = [
            reader.deserialize(raw, connection.msgtype) for connection, _, raw in reader.messages()
        ]
    # Diagnostics, boxes and images of four frames; pose, pose alone and transform of two.
    assert len(found) == 4 * 3 + 2 * 3


def record_ends(content):
    """Return where each record of an MCAP file ends."""
    ends = [8]
    while ends[-1] + 9 <= len(content) - 8:
        (length,) = struct.unpack_from("<Q", content, ends[-1] + 1)
        ends.append(ends[-1] + 9 + length)
    return ends


def test_whatever_was_flushed_is_recovered_at_any_cut(written, tmp_path):
    content = written.read_bytes()
    ends = record_ends(content)
    kinds = [content[begin] for begin in ends[:-1]]
    torn, whole = tmp_path / "torn.mcap", str(tmp_path / "whole.mcap")
    cuts = {end + more for end in ends for more in (-1, 0, 1)} | {8, 9, 20}
    for cut in sorted(cut for cut in cuts if 8 <= cut <= len(content)):
        torn.write_bytes(content[:cut])
        found = recover(torn, whole)
        complete = sum(kind == 5 for kind, end in zip(kinds, ends[1:], strict=True) if end <= cut)
        assert found.messages == complete
        assert found.finished == (cut == len(content))
        assert len(list(read_ros2(whole))) == complete
    with AnyReader([Path(whole)]) as reader:
        assert len(list(reader.messages())) == 18


def test_a_frame_is_in_the_file_when_it_is_written(tmp_path):
    path = tmp_path / "live.mcap"
    with McapSink(str(path), HEADER, PLACE) as sink:
        sizes = []
        for each in FRAMES:
            sink.write(each)
            sizes.append(path.stat().st_size)
            copy = tmp_path / "copy.mcap"
            copy.write_bytes(path.read_bytes())
            assert recover(copy, str(tmp_path / "whole.mcap")).messages >= 2 * len(sizes)
    assert sizes == sorted(set(sizes))


def test_an_old_file_is_kept_until_there_is_a_frame(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"old")
    unstamped = replace(FRAMES[0], stamp_ns=None)
    with McapSink(str(path), HEADER, PLACE) as sink, pytest.raises(UsageError):
        sink.write(unstamped)
    assert path.read_bytes() == b"old"


def test_one_file_has_one_writer(tmp_path):
    path = tmp_path / "a.mcap"
    with McapSink(str(path), HEADER, PLACE) as sink:
        sink.write(FRAMES[0])
        other = McapSink(str(path), HEADER, PLACE)
        with pytest.raises(SinkError, match="another run is writing to this file"):
            other.write(FRAMES[0])
        sink.write(FRAMES[3])
    assert len(of_topic(path, "/cvo/pose")) == 2


def test_a_renamed_file_is_told_once_finished_when_asked_and_followed_by_another(tmp_path):
    path, rotated, told = tmp_path / "a.mcap", tmp_path / "old.mcap", []
    with McapSink(str(path), HEADER, PLACE, told.append) as sink:
        reopen_files()
        # It still has its name: nothing is to be done.
        sink.write(FRAMES[0])
        path.rename(rotated)
        for seq in (1, 2):
            sink.write(frame(seq=seq))
        assert told == [f"{path}: was renamed or removed; records still go to that file. SIGHUP "
                        "opens a new one"]  # fmt: skip
        reopen_files()
        sink.write(FRAMES[3])
        with AnyReader([rotated]) as reader:
            assert len([one for one, *_ in reader.messages() if one.topic == "/cvo/pose"]) == 3
    assert [each.header.stamp.nanosec for each in of_topic(path, "/cvo/pose")] == [
        FRAMES[3].stamp_ns % 10**9
    ]


@pytest.mark.parametrize("content", [b"", b"\x89MCAP", b"no MCAP file at all"])
def test_another_file_is_not_recovered(tmp_path, content):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(SourceError, match="expected an MCAP file"):
        recover(path, str(tmp_path / "b.mcap"))
    assert not (tmp_path / "b.mcap").exists()


def test_stamps_that_go_back_leave_a_file_that_a_strict_reader_takes(tmp_path):
    path, again = tmp_path / "a.mcap", tmp_path / "b.mcap"
    frames = [frame(seq=seq) for seq in (5, 6, 0, 1, 7)]
    impossible = replace(frame(Status.DEGRADED, seq=8), stamp_ns=-5)
    with McapSink(str(path), HEADER, PLACE) as sink:
        for each in frames:
            sink.write(each)
        sink.write(impossible)
    recover(path, str(again))
    for file in (path, again):
        with AnyReader([file]) as reader:
            read = [stamp for one, stamp, _ in reader.messages() if one.topic == "/cvo/pose"]
        assert read == sorted(read)
        stamps = [each.header.stamp.nanosec for each in of_topic(file, "/cvo/pose")]
        assert stamps == [each.stamp_ns % 10**9 for each in frames]
        last = of_topic(file, "/diagnostics")[-1].header.stamp
        assert (last.sec, last.nanosec) == (-1, 10**9 - 5)


def records_of(path, *estimates):
    with Sink(str(path), "jsonl", HEADER) as sink:
        for each in estimates:
            sink.write(each)
    return path


@pytest.mark.parametrize("source", ["../secret.png", "/etc/secret.png", "a/../../secret.png"])
def test_a_record_does_not_name_an_image_outside_the_folder(tmp_path, source):
    (tmp_path / "frames" / "a").mkdir(parents=True)
    (tmp_path / "secret.png").write_bytes(b"secret")
    records = records_of(tmp_path / "a.jsonl", replace(FRAMES[0], source=source))
    with pytest.raises(SourceError, match="found a path out of it"):
        convert(records, str(tmp_path / "a.mcap"), "mcap", tmp_path / "frames", NOWHERE)
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize("format", ["mcap", "csv"])
def test_a_header_alone_makes_no_file(tmp_path, format):
    records = records_of(tmp_path / "a.jsonl", FRAMES[0])
    records.write_bytes(records.read_bytes().partition(b"\n")[0] + b"\n")
    with pytest.raises(SourceError, match="found a header alone"):
        convert(records, str(tmp_path / f"b.{format}"), format, None, NOWHERE)
    assert [each.name for each in tmp_path.iterdir()] == ["a.jsonl"]
