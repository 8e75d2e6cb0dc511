"""The command ``annotate``: records of a file, or of lines as they come."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path

import msgspec
import numpy as np

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.motion.annotation import annotate
from cvo_edge.motion.files import Poses
from cvo_edge.motion.format import COLUMNS
from cvo_edge.motion.intervals import Level, MotionCalibration
from cvo_edge.motion.records import MotionRecord, motion_header
from cvo_edge.motion.tracker import MotionTracker
from cvo_edge.output.lines import LineFile
from cvo_edge.output.sinks import tum_line
from cvo_edge.process import say
from cvo_edge.trajectories.tables import read_rows, seconds_to_ns
from cvo_edge.trajectories.trajectory import NONE_SKIPPED
from cvo_edge.trajectories.tum import FORM
from cvo_edge.vocabulary import MotionCovariance, MotionFormat

# Records of a file are written in pieces; those of a stream, each at once.
_AT_ONCE = 256
_SHOWN = 80


def annotate_file(
    calibration: MotionCalibration,
    level: Level,
    poses: Poses,
    output: str,
    written_as: MotionFormat,
    anchors: Path | None,
    covariance: MotionCovariance | None,
) -> None:
    """Write the records of a file; raises UsageError, SourceError and SinkError.

    ``anchors``: a file with a time a line, in seconds.
    """
    known: list[int] = []
    if anchors is not None:
        known = [row.seconds() for row in read_rows(anchors, "time")]
    records = annotate(
        calibration, level, poses.stamps_ns, poses.poses, poses.columns, known, covariance
    )
    _write(calibration, level, records, output, written_as, _AT_ONCE)
    if poses.skipped != NONE_SKIPPED:
        say(f"{poses.path}: {poses.skipped}")


def annotate_stream(
    calibration: MotionCalibration,
    level: Level,
    output: str,
    written_as: MotionFormat,
    covariance: MotionCovariance | None,
) -> None:
    """Write a record for each line of standard input, at once.

    Raises SourceError for a malformed line, UsageError if the scale needs columns, and SinkError.
    """
    if calibration.file.columns:
        raise UsageError(
            f"annotate -: expected a calibration without columns, found "
            f"{', '.join(calibration.file.columns)}; use MotionTracker, or --scale auto"
        )
    tracker = MotionTracker(calibration, *level, covariance)
    records = (tracker.step(stamp_ns, pose) for stamp_ns, pose in _lines())
    _write(calibration, level, records, output, written_as, 1)


def format_of(path: str, format: MotionFormat | None) -> MotionFormat:
    """Return an output's format: as requested, or from the suffix of the path, or ``jsonl``."""
    suffix = Path(path).suffix.lower().removeprefix(".")
    of_suffix = next((each for each in _FORMATS if each == suffix), None)
    return format or of_suffix or "jsonl"


def _lines() -> Iterator[tuple[int, list[float]]]:
    """Yield stamp and pose of each line of standard input."""
    if sys.stdin is None:
        raise SourceError("standard input: expected lines of poses, found it closed")
    for number, line in enumerate(sys.stdin.buffer, start=1):
        words = line.decode("utf-8", "replace").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            stamp_ns, pose = seconds_to_ns(words[0]), [float(word) for word in words[1:]]
        except ValueError:
            stamp_ns, pose = 0, []
        if len(pose) != len(FORM.split()) - 1 or abs(stamp_ns) >= 2**63 - 1:
            found = " ".join(words)[:_SHOWN]
            raise SourceError(
                f"standard input: expected {FORM} in seconds, found {found!r} in line {number}"
            )
        yield stamp_ns, pose


def _write(
    calibration: MotionCalibration,
    level: Level,
    records: Iterable[MotionRecord],
    output: str,
    written_as: MotionFormat,
    at_once: int,
) -> None:
    heading, line = _FORMATS[written_as]
    first = heading(calibration, level)
    every = iter(records)
    with LineFile(output) as lines:
        while found := list(islice(every, at_once)):
            lines.write(first + b"".join(map(line, found)))
            first = b""


def _json_heading(calibration: MotionCalibration, level: Level) -> bytes:
    return msgspec.json.encode(motion_header(calibration, level)) + b"\n"


def _json_line(record: MotionRecord) -> bytes:
    return msgspec.json.encode(record) + b"\n"


def _comments(calibration: MotionCalibration, level: Level) -> bytes:
    fields = msgspec.to_builtins(motion_header(calibration, level))
    return "".join(f"# {key}: {value}\n" for key, value in fields.items()).encode()


_DOF = COLUMNS[:6]


def _csv_heading(calibration: MotionCalibration, level: Level) -> bytes:
    names = [
        *("seq", "stamp_ns", "status", "reasons", "horizon", "since_seq", "seconds", "metres"),
        *("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"),
        *(f"{name}_{side}" for side in ("lower", "upper") for name in _DOF),
        *("position_radius", "rotation_radius", "bounded"),
    ]
    return _comments(calibration, level) + _csv_row(names)


def _csv_lines(record: MotionRecord) -> bytes:
    """Return one row for each horizon."""
    rows = b""
    reasons = " ".join(record.reasons)
    for each in record.motion:
        numbers = [*(each.t_m or (None,) * 3), *(each.q_xyzw or (None,) * 4)]
        numbers += [*(each.lower or (None,) * 6), *(each.upper or (None,) * 6)]
        rows += _csv_row(
            [
                *(record.seq, record.stamp_ns, str(record.status), reasons, each.horizon),
                *(each.since_seq, each.seconds, each.metres),
                *numbers,
                *(each.position, each.rotation, each.bounded),
            ]
        )
    return rows


def _csv_row(values: Iterable[object]) -> bytes:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow("" if value is None else value for value in values)
    return buffer.getvalue().encode()


def _tum_line(record: MotionRecord) -> bytes:
    if record.pose is None:
        return b""  # the format has no way to say "no pose"
    return tum_line(record.stamp_ns, np.array([*record.pose.t_m, *record.pose.q_xyzw]))


_FORMATS: dict[
    MotionFormat,
    tuple[Callable[[MotionCalibration, Level], bytes], Callable[[MotionRecord], bytes]],
] = {
    "jsonl": (_json_heading, _json_line),
    "csv": (_csv_heading, _csv_lines),
    "tum": (_comments, _tum_line),
}
