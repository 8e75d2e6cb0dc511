"""Formats: what each line holds, and what a disk that refuses leaves behind."""

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from cvo_edge import Odometer, SinkError, UsageError, open_source
from cvo_edge.output.sinks import Sink
from cvo_edge.sets import unbounded_set


@pytest.fixture(scope="module")
def estimates(bundle_dir, clip_dir):
    frames = list(open_source(str(clip_dir), fps=30))[:3]
    with Odometer.load(bundle_dir) as odometer:
        good = list(odometer.stream(frames))
        return [*good, odometer.step(None, stamp_ns=99_000_000, source="lost.png")]


def write(path, format, estimates):
    with Sink(str(path), format) as sink:
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
        ]
        if estimate.pose is not None:
            assert record["interval"]["lower"] == estimate.lower.tolist()
            assert record["pose"]["q_xyzw"] == estimate.pose.q_xyzw.tolist()
    lost = json.loads(lines[-1])
    assert (lost["status"], lost["pose"], lost["interval"]) == ("invalid", None, None)
    assert lost["reasons"] == ["image_unreadable"]


def test_csv_holds_the_same_numbers(tmp_path, estimates):
    rows = list(csv.DictReader(write(tmp_path / "a.csv", "csv", estimates).splitlines()))
    assert len(rows) == len(estimates)
    first = estimates[0]
    assert [float(rows[0][f"{dof}_lower"]) for dof in first.chart.dof] == first.lower.tolist()
    assert float(rows[0]["ty_m"]) == first.pose.t_m[1]
    assert rows[-1]["tx_m"] == ""
    assert rows[-1]["reasons"] == "image_unreadable"


def test_tum_has_eight_columns_and_skips_what_has_no_pose(tmp_path, estimates):
    lines = write(tmp_path / "a.txt", "tum", estimates).splitlines()
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


def test_table_says_unbounded_in_words(tmp_path, estimates):
    wide = [dataclasses.replace(estimates[0], conformal_set=unbounded_set())]
    assert write(tmp_path / "a.txt", "table", wide).count("unbounded") == 6


def test_an_old_file_is_kept_until_there_is_a_line_to_put_in_its_place(tmp_path, estimates):
    path = tmp_path / "a.txt"
    path.write_text("precious\n" * 9)
    unstamped = dataclasses.replace(estimates[0], stamp_ns=None)
    with Sink(str(path), "tum") as sink, pytest.raises(UsageError):
        sink.write(unstamped)
    assert path.read_text() == "precious\n" * 9
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
    lines = write(tmp_path / "a.txt", "table", [named]).splitlines()
    assert len(lines) == 2
    assert lines[1].isprintable()


def test_one_file_has_one_writer(tmp_path, estimates):
    path = tmp_path / "a.jsonl"
    with Sink(str(path), "jsonl") as sink:
        sink.write(estimates[0])
        with pytest.raises(SinkError, match="no other run writes to"):
            Sink(str(path), "jsonl")
        sink.write(estimates[1])
    assert len(path.read_text().splitlines()) == 2
    assert len(write(path, "jsonl", estimates).splitlines()) == len(estimates)
