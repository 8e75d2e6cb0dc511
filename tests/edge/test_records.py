"""Records can be read back without their bundle, even from a truncated file."""

import dataclasses
import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cvo_edge import (
    Chart,
    ConformalSet,
    Ellipsoids,
    Odometer,
    Pose,
    PoseInterval,
    Reason,
    Record,
    SourceError,
    Status,
    open_source,
    read_records,
)
from cvo_edge.output.records import header_of
from cvo_edge.output.sinks import Sink
from cvo_edge.sets import unbounded_set

# Pre-release records, written before headers existed.
OLD = Path(__file__).parent / "pre_release_records"
OLD_JSON_LINES = sorted(OLD.glob("*.jsonl"))


def infinite(values, sign):
    return [sign * np.inf if value is None else value for value in values]


def band_of(band):
    low, high = band
    return infinite([low], -1)[0], infinite([high], 1)[0]


def estimate_of(record):
    """Return the estimate that a record describes, from the decoded JSON line."""
    pose, interval = record["pose"], record["interval"]
    found, chart = unbounded_set(), Chart("tangent_predicted")
    if interval is not None:
        bands, region = interval["bands"], interval.get("region")
        found = ConformalSet(
            np.array(infinite(interval["lower"], -1)),
            np.array(infinite(interval["upper"], 1)),
            bands and tuple(tuple(map(band_of, row)) for row in bands),
            ellipsoids=region
            and Ellipsoids(
                np.array(region["centres"]), np.array(region["scale"]), region["radius"]
            ),
        )
        chart = Chart(interval["rotation"])
    return PoseInterval(
        record["seq"],
        record["stamp_ns"],
        record["source"],
        Status(record["status"]),
        tuple(map(Reason, record["reasons"])),
        pose and Pose(np.array(pose["t_m"]), np.array(pose["q_xyzw"])),
        found,
        interval["confidence"] if interval else 0.9,
        interval["scope"] if interval else "marginal",
        chart,
        record["latency_ms"],
    )


def written(path, estimates, format="jsonl", header=None, *, region=False):
    with Sink(str(path), format, header, region=region) as sink:
        for estimate in estimates:
            sink.write(estimate)
    return path.read_bytes()


@pytest.fixture(scope="module", params=["cjp", "cqr", "csp", "mcqr"])
def recorded(request, artifacts_dir, clip_dir, tmp_path_factory):
    """A file of a few records, its header, and the estimates in it."""
    path = tmp_path_factory.mktemp("records") / "records.jsonl"
    region = request.param == "mcqr"
    with Odometer.load(
        artifacts_dir / f"synthetic-room-{request.param}", scope="joint", threads=1
    ) as odometer:
        frames = [frame for frame, _ in zip(open_source(str(clip_dir)), range(3), strict=False)]
        # A repeated image and a missing one.
        images = [*(frame.image for frame in frames), frames[-1].image, None]
        estimates = [odometer.step(image, stamp) for stamp, image in enumerate(images)]
        header = header_of(odometer.calibration, odometer.chart, 0.9, "joint", "fps")
    written(path, estimates, header=header, region=region)
    return path, header, [estimate.to_record(region=region) for estimate in estimates]


def test_what_is_read_is_what_was_written(recorded):
    path, header, expected = recorded
    assert {record.status for record in expected} == set(Status)
    records = read_records(path)
    assert records.header == header
    assert list(records) == expected
    assert records.header == header


numbers = st.floats(-1e9, 1e9)
six = st.lists(numbers, min_size=6, max_size=6)
ends = six.map(sorted)


@st.composite
def estimates(draw):
    status = draw(st.sampled_from(Status))
    lower, upper = np.sort([draw(six), draw(six)], axis=0)
    lower[draw(st.integers(0, 5))] = draw(st.sampled_from([-np.inf, lower[0]]))
    bands = draw(
        st.none()
        | st.just(
            tuple(((low, high), (high, high)) for low, high in np.array([lower, upper]).T.tolist())
        )
    )
    ellipsoids = draw(
        st.none()
        | st.builds(
            Ellipsoids,
            st.lists(six, min_size=1, max_size=3).map(np.array),
            six.map(np.diag),
            st.floats(0, 1e9),
        )
    )
    return PoseInterval(
        draw(st.integers(0, 2**62)),
        draw(st.none() | st.integers(-(2**62), 2**62)),
        draw(st.text(st.characters(exclude_categories=["Cs"]), max_size=20)),
        status,
        tuple(draw(st.lists(st.sampled_from(Reason), max_size=3))),
        None
        if status is Status.INVALID
        else Pose(np.array(draw(six))[:3], np.array(draw(six))[:4]),
        ConformalSet(lower, upper, bands, ellipsoids=ellipsoids),
        draw(st.floats(0.01, 0.99)),
        draw(st.sampled_from(["marginal", "joint"])),
        Chart(draw(st.sampled_from(["euler_zyx", "tangent_predicted", "tangent_reference"]))),
        draw(st.dictionaries(st.sampled_from(["read", "total"]), st.floats(0, 1e6))),
    )


@given(estimates(), st.booleans())
def test_any_estimate_is_the_same_after_json(estimate, region):
    record = estimate.to_record(region=region)
    line = msgspec.json.encode(record)
    assert msgspec.json.decode(line, type=Record) == record
    assert json.loads(line) == estimate.to_dict(region=region)
    # Converting back yields the numbers of the estimate, bit for bit.
    again = estimate_of(json.loads(line)).to_record(region=region)
    assert msgspec.json.encode(again) == line


@pytest.mark.parametrize("path", OLD_JSON_LINES, ids=lambda path: path.stem)
def test_lines_are_those_of_the_version_before_to_the_byte(path, tmp_path):
    content = path.read_bytes()
    estimates = [estimate_of(json.loads(line)) for line in content.splitlines()]
    region = b'"region":' in content
    assert written(tmp_path / "again.jsonl", estimates, region=region) == content


@pytest.mark.parametrize("path", OLD_JSON_LINES, ids=lambda path: path.stem)
def test_files_without_a_header_are_read_with_equal_numbers(path):
    records = read_records(path)
    assert records.header is None
    assert [msgspec.json.encode(record) for record in records] == path.read_bytes().splitlines()


def test_old_files_hold_every_kind_of_record():
    records = [record for path in OLD_JSON_LINES for record in read_records(path)]
    assert {record.status for record in records} == set(Status)
    intervals = [record.interval for record in records if record.interval is not None]
    assert {interval.scope for interval in intervals} == {"marginal", "joint"}
    assert {interval.region is None for interval in intervals} == {True, False}
    assert any(interval.region is msgspec.UNSET for interval in intervals)
    assert max(len(row) for each in intervals for row in each.bands or ()) == 2
    assert {record.stamp_ns is None for record in records} == {True, False}


@pytest.mark.parametrize("name", ["csp.csv", "cjp.tum"])
def test_rows_of_other_formats_are_those_of_the_version_before(name, tmp_path, recorded):
    format = name[-3:]
    lines = (OLD / name).with_suffix(".jsonl").read_bytes().splitlines()
    estimates = [estimate_of(json.loads(line)) for line in lines]
    estimates = [dataclasses.replace(each, latency_ms={}) for each in estimates]
    again = written(tmp_path / name, estimates, format, recorded[1]).decode()
    rows = [line for line in again.splitlines() if not line.startswith("#")]
    expected = (OLD / name).read_text().splitlines()
    if format == "csv":  # another run, with different latencies
        rows, expected = ([line.rsplit(",", 5)[0] for line in each] for each in (rows, expected))
    else:  # the frames of both runs
        rows, expected = rows[:2], expected[:2]
    assert rows == expected


def test_a_record_is_converted_with_its_header_alone(recorded):
    path, header, expected = recorded
    records = read_records(path)
    reference = records.header.reference_q_xyzw
    chart = Chart(records.header.rotation, reference and np.array(reference))
    assert chart.dof == records.header.dof
    record = next(records)
    pose = np.array([*record.pose.t_m, *record.pose.q_xyzw])
    lower, upper = np.array(record.interval.lower), np.array(record.interval.upper)
    point = chart.coordinates(pose, pose)
    assert ((lower <= point) & (point <= upper)).all()
    assert (header.confidence, header.scope) == (
        expected[0].interval.confidence,
        expected[0].interval.scope,
    )


def test_the_reference_of_a_chart_about_the_prediction_is_null(bundle):
    pose = msgspec.structs.replace(bundle.calibration.pose, rotation="tangent_predicted")
    calibration = msgspec.structs.replace(bundle.calibration, pose=pose)
    header = header_of(calibration, Chart("tangent_predicted"), 0.9, "joint")
    assert pose.reference_q_xyzw is not None
    assert header.reference_q_xyzw is None


def test_the_header_in_front_of_appended_records_holds_for_those(recorded, tmp_path):
    path, header, expected = recorded
    content = path.read_bytes()
    other = msgspec.structs.replace(header, bundle="another", confidence=0.5)
    old = b"".join(content.splitlines(keepends=True)[1:])
    both = tmp_path / "both.jsonl"
    both.write_bytes(old + content + msgspec.json.encode(other) + b"\n" + old)
    records = read_records(both)
    assert records.header is None
    n = len(expected)
    found = [(record, records.header) for record in records]
    assert [record for record, _ in found] == expected * 3
    assert [header for _, header in found] == [None] * n + [header] * n + [other] * n


def test_a_file_that_is_cut_anywhere_keeps_every_whole_record(recorded, tmp_path):
    path, header, expected = recorded
    content = path.read_bytes()
    cut = tmp_path / "cut.jsonl"
    ends = [place for place, byte in enumerate(content) if byte == ord("\n")]
    for length in {*range(0, len(content), 97), *ends, *(end + 1 for end in ends)}:
        cut.write_bytes(content[:length])
        whole = content[:length].count(b"\n")
        records = read_records(cut)
        assert records.header == (header if whole else None)
        assert list(records) == expected[: max(0, whole - 1)]


@pytest.mark.parametrize(
    "line",
    [
        b"\n",
        b"[]\n",
        b"{}\n",
        b'{"seq": NaN}\n',
        b'{"kind": "header"}\n',
        b'{"kind": "record"}\n',
        b"\xff\xfe\n",
        b"\0" * 512 + b"\n",
        b"seq,stamp_ns\n",
    ],
)
def test_a_whole_line_that_is_no_record_is_named(recorded, tmp_path, line):
    content = recorded[0].read_bytes()
    wrong = tmp_path / "wrong.jsonl"
    place = content.index(b"\n", content.index(b"\n") + 1) + 1
    wrong.write_bytes(content[:place] + line + content[place:])
    records = read_records(wrong)
    assert next(records).seq == 0
    with pytest.raises(SourceError, match="line 3 is not a record"):
        next(records)
    wrong.write_bytes(line)
    with pytest.raises(SourceError, match="line 1 is not a record"):
        read_records(wrong)


@pytest.mark.parametrize("kind", ["odometry", "motion"])
def test_records_of_another_command_say_whose_they_are(tmp_path, kind):
    path = tmp_path / "other.jsonl"
    path.write_text(f'{{"kind":"{kind}","schema_version":1}}\n')
    with pytest.raises(SourceError, match=rf"of cvo-edge run or serve, found one of '{kind}'"):
        read_records(path)


def test_a_header_of_a_later_version_says_so(recorded, tmp_path):
    path = tmp_path / "later.jsonl"
    path.write_bytes(recorded[0].read_bytes().replace(b'"schema_version":1', b'"schema_version":2'))
    with pytest.raises(SourceError, match=r"line 1.*schema_version"):
        read_records(path)


@pytest.mark.parametrize(("name", "why"), [("none.jsonl", "No such file"), ("a\0b", "null byte")])
def test_a_file_that_is_not_there_is_an_error_of_its_own(tmp_path, name, why):
    with pytest.raises(SourceError, match=why):
        read_records(tmp_path / name)


@given(estimates())
def test_texts_of_an_estimate_are_short_and_hold_no_markup_of_others(estimate):
    named = dataclasses.replace(estimate, source="<script>\n\x1b[2J")
    for text in (str(named), repr(named)):
        assert text.isprintable()
        assert len(text) < 300
        assert estimate.status in text
        assert all(reason in text for reason in estimate.reasons)
    shown = named._repr_html_()
    assert "<script>" not in shown
    assert shown.isprintable()
    assert shown.count("<tr>") == (0 if estimate.pose is None else 7)
