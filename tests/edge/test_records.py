"""What was recorded can be read back, also where the file ends anywhere."""

import json

import msgspec
import pytest

from cvo_edge import Odometer, SourceError, open_source, read_records
from cvo_edge.output.sinks import Sink


@pytest.fixture(scope="module", params=["cjp", "csp", "mcqr"])
def recorded(request, artifacts_dir, clip_dir, tmp_path_factory):
    """A file of a few records, and the estimates it was written from."""
    path = tmp_path_factory.mktemp("records") / "records.jsonl"
    bundle = artifacts_dir / f"synthetic-room-{request.param}"
    region = request.param == "mcqr"
    with (
        Odometer.load(bundle, scope="joint", threads=1) as odometer,
        Sink(str(path), "jsonl", region=region) as sink,
    ):
        estimates = [
            odometer.step(frame.image, source=frame.source)
            for frame, _ in zip(open_source(str(clip_dir)), range(3), strict=False)
        ]
        estimates.append(odometer.step(None, stamp_ns=7))
        for estimate in estimates:
            sink.write(estimate)
    return path, [estimate.to_dict(region=region) for estimate in estimates]


def test_what_is_read_is_what_was_written(recorded):
    path, estimates = recorded
    for record, expected in zip(read_records(path), estimates, strict=True):
        found = msgspec.to_builtins(record)
        if found["interval"] is not None and "region" not in expected["interval"]:
            assert found["interval"].pop("region") is None
        assert json.loads(json.dumps(found)) == json.loads(json.dumps(expected))


def test_a_file_that_is_cut_anywhere_keeps_every_whole_record(recorded, tmp_path):
    path, _ = recorded
    content = path.read_bytes()
    records = list(read_records(path))
    cut = tmp_path / "cut.jsonl"
    for length in range(len(content) + 1):
        cut.write_bytes(content[:length])
        assert list(read_records(cut)) == records[: content[:length].count(b"\n")]


@pytest.mark.parametrize(
    "line",
    [
        b"\n",
        b"[]\n",
        b"{}\n",
        b'{"seq": NaN}\n',
        b"\xff\xfe\n",
        b"\0" * 512 + b"\n",
        b"seq,stamp_ns\n",
    ],
)
def test_a_whole_line_that_is_no_record_is_named(recorded, tmp_path, line):
    path, _ = recorded
    content = path.read_bytes()
    end = content.index(b"\n") + 1
    wrong = tmp_path / "wrong.jsonl"
    wrong.write_bytes(content[:end] + line + content[end:])
    records = read_records(wrong)
    assert next(records).seq == 0
    with pytest.raises(SourceError, match="expected a record in line 2"):
        next(records)


@pytest.mark.parametrize(("name", "why"), [("none.jsonl", "No such file"), ("a\0b", "null byte")])
def test_a_file_that_is_not_there_is_an_error_of_its_own(tmp_path, name, why):
    with pytest.raises(SourceError, match=why):
        list(read_records(tmp_path / name))
