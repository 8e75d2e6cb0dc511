"""Output formats: the content of each line, and the file after a failed write."""

import csv
import dataclasses
import errno
import json
import os
import signal
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cvo_edge import (
    ConformalSet,
    Odometer,
    Pose,
    Reason,
    SinkError,
    Status,
    UsageError,
    open_source,
    process,
)
from cvo_edge.ground_truth import open_ground_truth
from cvo_edge.output.lines import LineFile
from cvo_edge.output.named import reopen_files
from cvo_edge.output.records import header_of
from cvo_edge.output.sinks import Sink, format_of
from cvo_edge.pose import Chart
from cvo_edge.sets import unbounded_set


@pytest.fixture(scope="module")
def header(bundle):
    pose = bundle.calibration.pose
    chart = Chart(pose.rotation, np.array(pose.reference_q_xyzw))
    return header_of(bundle.calibration, chart, 0.9, "marginal")


@pytest.fixture(scope="module")
def estimates(bundle_dir, clip_dir):
    frames = list(open_source(str(clip_dir), fps=30))[:3]
    with Odometer.load(bundle_dir) as odometer:
        good = list(odometer.stream(frames))
        return [*good, odometer.step(None, stamp_ns=99_000_000, source="lost.png")]


def write(path, format, estimates, header=None):
    with Sink(str(path), format, header) as sink:
        for estimate in estimates:
            sink.write(estimate)
    return path.read_text()


def test_json_lines_are_the_record(tmp_path, estimates):
    lines = write(tmp_path / "a.jsonl", "jsonl", estimates).splitlines()
    for line, estimate in zip(lines, estimates, strict=True):
        record = json.loads(line)
        assert list(record) == [
            "seq",
            "stamp_ns",
            "source",
            "status",
            "reasons",
            "pose",
            "interval",
            "latency_ms",
            "novelty",
            "drift",
        ]
        if estimate.pose is not None:
            assert record["interval"]["lower"] == estimate.lower.tolist()
            assert record["pose"]["q_xyzw"] == estimate.pose.q_xyzw.tolist()
    lost = json.loads(lines[-1])
    assert (lost["status"], lost["pose"], lost["interval"]) == ("invalid", None, None)
    assert lost["reasons"] == ["image_unreadable"]


def test_csv_holds_the_same_numbers(tmp_path, estimates, header):
    lines = write(tmp_path / "a.csv", "csv", estimates, header).splitlines()
    comments = [line for line in lines if line.startswith("# ")]
    assert lines[: len(comments)] == comments
    pairs = dict(line[2:].split(": ", 1) for line in comments)
    said = msgspec.to_builtins(header)
    assert pairs.keys() == said.keys()
    assert pairs["bundle"] == header.bundle
    assert tuple(json.loads(pairs["reference_q_xyzw"])) == header.reference_q_xyzw
    rows = list(csv.DictReader(lines[len(comments) :]))
    assert len(rows) == len(estimates)
    first = estimates[0]
    assert [float(rows[0][f"{dof}_lower"]) for dof in first.chart.dof] == first.lower.tolist()
    assert float(rows[0]["ty_m"]) == first.pose.t_m[1]
    assert rows[-1]["tx_m"] == ""
    assert rows[-1]["reasons"] == "image_unreadable"


def test_tum_has_eight_columns_and_skips_what_has_no_pose(tmp_path, estimates, header):
    path = tmp_path / "a.txt"
    text = write(path, "tum", estimates, header)
    assert f"# frame_id: {header.frame_id}\n" in text
    assert np.loadtxt(path).shape == (3, 8)
    truth = open_ground_truth(path)
    np.testing.assert_allclose(truth.pose_of(estimates[1]), estimates[1].pose.to_array(), atol=1e-8)
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    assert len(lines) == 3
    assert all(len(line.split()) == 8 for line in lines)
    assert lines[1].split()[0] == "0.033333333"
    np.testing.assert_allclose(
        [float(value) for value in lines[1].split()[1:]], estimates[1].pose.to_array(), atol=1e-9
    )


@pytest.mark.parametrize(("stamp_ns", "text"), [(-1, "-0.000000001"), (-1_500_000_000, "-1.5")])
def test_tum_times_before_zero_are_what_they_are(tmp_path, estimates, stamp_ns, text):
    named = dataclasses.replace(estimates[0], stamp_ns=stamp_ns)
    assert write(tmp_path / "a.txt", "tum", [named]).split()[0].rstrip("0") == text


def test_tum_without_stamps_is_refused(tmp_path, bundle_dir, clip_dir):
    frame = next(iter(open_source(str(clip_dir))))
    with Odometer.load(bundle_dir) as odometer:
        estimate = odometer.step(frame.image)
    with Sink(str(tmp_path / "a.txt"), "tum") as sink, pytest.raises(UsageError, match="--fps"):
        sink.write(estimate)


def table(path, estimates):
    """Return heading and rows of a table; no line is wider than a terminal."""
    lines = write(path, "table", estimates).splitlines()
    assert all(len(line) <= 80 for line in lines)
    return lines[:4], lines[4:]


@pytest.mark.parametrize("method", ["cjp", "cqr", "csp", "mcqr"])
def test_a_table_has_positions_and_half_widths_whatever_the_chart(
    tmp_path, artifacts_dir, clip_dir, method
):
    frames = list(open_source(str(clip_dir)))[:4]
    with Odometer.load(artifacts_dir / f"synthetic-room-{method}", threads=1) as odometer:
        estimates = list(odometer.stream(frames))
    heading, rows = table(tmp_path / "a.txt", estimates)
    assert "0.9 (marginal)" in heading[1]
    assert heading[2].split() == ["frame", "status", "tx", "ty", "tz", *estimates[0].chart.dof]
    for row, estimate in zip(rows, estimates, strict=True):
        name, status, *numbers = row.split()
        assert (name, status) == (estimate.source.split(".")[0], "ok")
        np.testing.assert_allclose([float(n) for n in numbers[:3]], estimate.pose.t_m, atol=5e-4)
        half = 0.5 * (estimate.upper - estimate.lower)
        half = np.concatenate([100 * half[:3], np.rad2deg(half[3:])])
        found = [float(n.strip("±*")) for n in numbers[3:]]
        np.testing.assert_allclose(found, half, atol=0.0501)
        pieces = [len(row) > 1 for row in estimate.bands or [()] * 6]
        assert [n.endswith("*") for n in numbers[3:]] == pieces


@given(
    st.lists(st.floats(-1e9, 1e9), min_size=3, max_size=3),
    st.lists(st.floats(0.0, 1e9), min_size=6, max_size=6),
    st.booleans(),
)
def test_no_number_breaks_the_columns_of_a_table(estimates, tmp_path_factory, t_m, half, pieces):
    half = np.array(half)
    bands = (((-1.0, -0.5), (0.5, 1.0)),) * 6 if pieces else None
    large = dataclasses.replace(
        estimates[0],
        pose=Pose(np.array(t_m), np.array([0.0, 0.0, 0.0, 1.0])),
        conformal_set=ConformalSet(-half, half, bands),
    )
    _, (row,) = table(tmp_path_factory.getbasetemp() / "large.txt", [large])
    for value, (begin, end) in zip(t_m, ((21, 29), (29, 37), (37, 44)), strict=True):
        assert row[begin] == " "
        assert float(row[begin:end]) == pytest.approx(value, rel=0.06, abs=5e-4)
    cells = [row[begin : begin + 6] for begin in range(44, 80, 6)]
    assert [cell.strip()[0] for cell in cells] == ["±"] * 6
    cm_or_deg = half * ([100.0] * 3 + [np.rad2deg(1.0)] * 3)
    found = [float(cell.strip(" ±*")) for cell in cells]
    # Numbers with an exponent keep one digit.
    np.testing.assert_allclose(found, cm_or_deg, rtol=0.34, atol=0.0501)
    assert [cell.endswith("*") for cell in cells] == [pieces] * 6


def test_a_table_of_a_world_in_utm_keeps_the_metres(tmp_path, estimates):
    pose = Pose(np.array([500_123.456, 5_412_345.678, 312.3]), estimates[0].pose.q_xyzw)
    _, (row,) = table(tmp_path / "a.txt", [dataclasses.replace(estimates[0], pose=pose)])
    assert row.split()[2:5] == ["500123", "5412346", "312.30"]


def test_a_table_says_where_nothing_is_bounded_and_why(tmp_path, estimates):
    wide = dataclasses.replace(estimates[0], conformal_set=unbounded_set())
    degraded = dataclasses.replace(
        wide, status=Status.DEGRADED, reasons=(Reason.IMAGE_BLACK, Reason.FRAME_STALE)
    )
    many = dataclasses.replace(degraded, reasons=tuple(Reason))
    _, rows = table(tmp_path / "a.txt", [wide, degraded, many, estimates[-1]])
    assert rows[0].split()[-6:] == ["inf"] * 6
    assert rows[1].endswith(" image_black, frame_stale")
    assert rows[2].endswith(f" +{len(Reason) - 1}")
    assert rows[3].split() == ["lost", "invalid", "image_unreadable"]


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("frame-000007.color.jpg", "frame-000007"),
        ("1305031102.175304.png", "31102.175304"),
        ("a-rather-long-name-0042.jpeg", "ng-name-0042"),
        ("clip.avi#1234", "lip.avi#1234"),
        ("图像图像图像图像-0001.jpg", "像图像-0001"),
        (".jpg", ".jpg"),
        ("", "0"),
    ],
)
def test_a_table_keeps_the_end_of_a_name(tmp_path, estimates, source, shown):
    _, (row,) = table(tmp_path / "a.txt", [dataclasses.replace(estimates[0], source=source)])
    assert row.split()[0] == shown


@pytest.mark.parametrize(
    ("name", "format", "expected"),
    [
        ("a.jsonl", None, "jsonl"),
        ("a.csv", None, "csv"),
        ("a.b/A.TUM", None, "tum"),
        ("a.txt", None, "jsonl"),
        ("-", None, "jsonl"),
        ("a.csv", "csv", "csv"),
        ("a.txt", "tum", "tum"),
        ("csv", "table", "table"),
    ],
)
def test_a_suffix_chooses_the_format_unless_it_is_given(name, format, expected):
    assert format_of(name, format) == expected


@pytest.mark.parametrize(
    ("name", "format"), [("a.csv", "jsonl"), ("a.JSONL", "table"), ("a.tum", "csv")]
)
def test_a_suffix_that_contradicts_the_format_is_refused(name, format):
    with pytest.raises(UsageError, match=rf"{name}.*{format}"):
        format_of(name, format)


@pytest.mark.parametrize("name", ["a.mcap", "a.rrd", "a.csv"])
def test_a_suffix_of_a_format_that_a_command_does_not_write_is_refused(name):
    with pytest.raises(UsageError, match=rf"expected jsonl or tum, found the file name {name}"):
        format_of(name, None, ("jsonl", "tum"))


def test_an_old_file_is_kept_until_there_is_a_line_to_put_in_its_place(tmp_path, estimates):
    path = tmp_path / "a.txt"
    path.write_text("# software: cvo-edge 0\n" * 9)
    unstamped = dataclasses.replace(estimates[0], stamp_ns=None)
    with Sink(str(path), "tum") as sink, pytest.raises(UsageError):
        sink.write(unstamped)
    assert path.read_text() == "# software: cvo-edge 0\n" * 9
    assert len(write(path, "jsonl", estimates).splitlines()) == len(estimates)


def test_a_file_that_cannot_be_opened_is_a_sink_error(tmp_path):
    with pytest.raises(SinkError, match="cannot be written"):
        Sink(str(tmp_path / "none" / "a.jsonl"), "jsonl")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_a_full_disk_is_a_sink_error(estimates):
    with Sink("/dev/full", "jsonl") as sink, pytest.raises(SinkError, match="No space left"):
        sink.write(estimates[0])


def test_a_table_is_one_line_a_frame_whatever_a_file_is_called(tmp_path, estimates):
    named = dataclasses.replace(estimates[0], source="x\x1b[2J\nframe-9  ok.jpg")
    _, rows = table(tmp_path / "a.txt", [named])
    assert len(rows) == 1
    assert rows[0].isprintable()


@pytest.mark.parametrize("format", ["jsonl", "csv", "tum", "table"])
@pytest.mark.parametrize("fits", [1, 50, 80])
def test_a_line_that_fits_in_part_only_is_taken_back(
    tmp_path, monkeypatch, estimates, header, format, fits
):
    path = tmp_path / "a"
    with Sink(str(path), format, header) as sink:
        sink.write(estimates[0])
        whole = path.read_bytes()
        real, rest = os.write, [fits]

        def full(descriptor, line):
            if rest[0] == 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            line, rest[0] = line[: rest[0]], max(0, rest[0] - len(line))
            return real(descriptor, line)

        monkeypatch.setattr(os, "write", full)
        with pytest.raises(SinkError, match="No space left"):
            sink.write(estimates[1])
        monkeypatch.undo()
        assert path.read_bytes() == whole
        # With space available, writing continues after the last complete line.
        sink.write(estimates[2])
    assert (
        path.read_bytes()
        == whole
        + write(tmp_path / "b", format, [estimates[2]]).encode().splitlines(keepends=True)[-1]
    )


def test_one_file_has_one_writer(tmp_path, estimates):
    path = tmp_path / "a.jsonl"
    with Sink(str(path), "jsonl") as sink:
        sink.write(estimates[0])
        with pytest.raises(SinkError, match="another run is writing to this file"):
            Sink(str(path), "jsonl")
        sink.write(estimates[1])
    assert len(path.read_text().splitlines()) == 2
    assert len(write(path, "jsonl", estimates).splitlines()) == len(estimates)


def test_a_file_of_another_program_is_replaced_only_by_force(tmp_path):
    path = tmp_path / "thesis.txt"
    path.write_text("precious\n")
    with pytest.raises(UsageError, match="--force to replace it"):
        LineFile(str(path))
    assert path.read_text() == "precious\n"
    with LineFile(str(path), "force") as lines:
        lines.write(b"line\n")
    assert path.read_text() == "line\n"


def test_appending_removes_an_incomplete_line_alone(tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_bytes(b'{"seq":0}\n{"seq":1')
    with LineFile(str(path), "append") as lines:
        lines.write(b'{"seq":2}\n')
    assert path.read_bytes() == b'{"seq":0}\n{"seq":2}\n'


def test_a_file_that_is_truncated_meanwhile_goes_on_at_its_end(tmp_path):
    path = tmp_path / "a.jsonl"
    with LineFile(str(path)) as lines:
        lines.write(b"first\n")
        os.truncate(path, 0)
        lines.write(b"second\n")
    assert path.read_bytes() == b"second\n"


def test_a_renamed_file_is_told_once_and_reopened_when_asked(tmp_path):
    path, told = tmp_path / "a.jsonl", []
    with LineFile(str(path), told=told.append) as lines:
        lines.write(b"first\n")
        path.rename(tmp_path / "a.jsonl.1")
        lines.write(b"second\n")
        lines.write(b"third\n")
        reopen_files()
        lines.write(b"fourth\n")
    assert [line.split(": ")[1][:11] for line in told] == ["was renamed"]
    assert (tmp_path / "a.jsonl.1").read_bytes() == b"first\nsecond\nthird\n"
    assert path.read_bytes() == b"fourth\n"


def test_a_file_that_is_opened_again_has_a_header_of_its_own(tmp_path, estimates):
    path = tmp_path / "a.csv"
    with Sink(str(path), "csv") as sink:
        sink.write(estimates[0])
        path.rename(tmp_path / "a.csv.1")
        reopen_files()
        sink.write(estimates[1])
        reopen_files()
        sink.write(estimates[2])
    heading = (tmp_path / "a.csv.1").read_text().splitlines()[0]
    lines = path.read_text().splitlines()
    assert lines[0] == heading
    assert len(lines) == 3


@pytest.mark.parametrize("terminal", [False, True])
def test_a_hang_up_opens_files_again_unless_a_terminal_is_gone(monkeypatch, tmp_path, terminal):
    path = tmp_path / "a.jsonl"
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    monkeypatch.setattr(process, "_has_terminal", lambda: terminal)
    try:
        process.follow_hang_ups()
        with LineFile(str(path)) as lines:
            lines.write(b"first\n")
            path.unlink()
            if terminal:
                with pytest.raises(process.Terminated) as ended:
                    signal.raise_signal(signal.SIGHUP)
                assert ended.value.code == 129
                return
            signal.raise_signal(signal.SIGHUP)
            lines.write(b"second\n")
        assert path.read_bytes() == b"second\n"
    finally:
        signal.signal(signal.SIGHUP, before)
