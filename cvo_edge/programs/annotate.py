"""The command ``annotate``: records of a file, or of lines as they come."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError, UsageError, printable
from cvo_edge.motion.annotation import annotate
from cvo_edge.motion.direction import check_same
from cvo_edge.motion.files import Poses, says_unscaled, tum_names
from cvo_edge.motion.format import COLUMNS
from cvo_edge.motion.intervals import Level, MotionCalibration
from cvo_edge.motion.records import MotionRecord, motion_header
from cvo_edge.motion.tracker import MotionTracker
from cvo_edge.output.lines import LineFile
from cvo_edge.output.sinks import tum_line
from cvo_edge.process import say
from cvo_edge.record import Status
from cvo_edge.trajectories.poses import quaternion_poses
from cvo_edge.trajectories.tables import read_rows, seconds_to_ns
from cvo_edge.trajectories.trajectory import NONE_SKIPPED
from cvo_edge.trajectories.tum import FORM
from cvo_edge.vocabulary import Existing, MotionCovariance, MotionFormat

# Records of a file are written in pieces; those of a stream, each at once.
_AT_ONCE = 256
_SHOWN = 80
# Of fewer poses, most may have come before any horizon is reached.
_MANY = 20


def annotate_file(
    calibration: MotionCalibration,
    level: Level,
    poses: Poses,
    output: str,
    existing: Existing,
    written_as: MotionFormat,
    anchors: Path | None,
    covariance: MotionCovariance | None,
) -> None:
    """Write the records of a file; raises UsageError, SourceError and SinkError.

    ``anchors``: a file with a time a line, in seconds.
    """
    check_same(str(poses.path), poses.unscaled, calibration.pointed)
    known = [] if anchors is None else _anchors(anchors, poses)
    records = annotate(
        calibration, level, poses.stamps_ns, poses.poses, poses.columns, known, covariance
    )
    unbounded: Counter[str] = Counter()
    counted = _counted(records, unbounded)
    _write(calibration, level, counted, output, existing, written_as, _AT_ONCE)
    if 2 * (lost := unbounded.total()) > len(poses.poses) >= _MANY:
        ((reason, count),) = unbounded.most_common(1)
        say(
            f"{poses.path}: no interval at {lost} of {len(poses.poses)} poses ({reason} at "
            f"{count}); the calibration is of {printable(calibration.file.name)}: check estimator, "
            "vehicle, rate and unit"
        )
    if poses.skipped != NONE_SKIPPED:
        say(f"{poses.path}: {poses.skipped}")


def _anchors(path: Path, poses: Poses) -> list[int]:
    """Return the stamps of a list of times; raises SourceError for one that is not of a pose."""
    stamps_ns = set(poses.stamps_ns.tolist())
    rows = read_rows(path, "time")
    for row in rows:
        if row.seconds() not in stamps_ns:
            raise SourceError(
                f"{path}: expected stamps of poses of {poses.path}, found {row.fields[0][:_SHOWN]} "
                f"in line {row.number}"
            )
    return [row.seconds() for row in rows]


def _counted(records: Iterable[MotionRecord], unbounded: Counter[str]) -> Iterator[MotionRecord]:
    """Yield records; count the first reason of those without any interval."""
    for record in records:
        if record.status is not Status.OK:
            unbounded[record.reasons[0] if record.reasons else "no motion fits a horizon"] += 1
        yield record


def annotate_stream(
    calibration: MotionCalibration,
    level: Level,
    output: str,
    existing: Existing,
    written_as: MotionFormat,
    covariance: MotionCovariance | None,
) -> None:
    """Write a record for each line of standard input, at once.

    Raises SourceError for a malformed line, UsageError if the calibration needs columns that no
    comment before the first row names, and SinkError.
    """
    tracker = MotionTracker(calibration, *level, covariance)
    lines = _lines(calibration.file.columns, calibration.pointed)
    records = (tracker.step(*each) for each in lines)
    _write(calibration, level, records, output, existing, written_as, 1)


def _lines(
    needed: Sequence[str], pointed: bool
) -> Iterator[tuple[int, NDArray[np.float64] | None, dict[str, float]]]:
    """Yield stamp, pose and columns of each line of standard input, as a file of it has them."""
    if sys.stdin is None:
        raise SourceError("standard input: expected lines of poses, found it closed")
    names, started, unscaled = FORM.split(), False, False
    for number, line in enumerate(sys.stdin.buffer, start=1):
        # A byte order mark, as some editors put it before the first line.
        text = line.decode("utf-8-sig" if number == 1 else "utf-8", "replace").strip()
        if not text or text.startswith("#"):
            names = names if started else tum_names(text) or names
            unscaled |= not started and says_unscaled(text)
            continue
        if not started:
            check_same("standard input", unscaled, pointed)
        columns = names[len(FORM.split()) :]
        if not started and (missing := [name for name in needed if name not in columns]):
            raise UsageError(
                f"standard input: expected a line # {FORM} {' '.join(needed)} before the poses, "
                f"found no column {missing[0]}"
            )
        started, words = True, text.split()
        try:
            stamp_ns, numbers = seconds_to_ns(words[0]), [float(word) for word in words[1:]]
        except ValueError:
            stamp_ns, numbers = 0, []
        if len(numbers) != len(names) - 1 or abs(stamp_ns) >= 2**63 - 1:
            raise SourceError(
                f"standard input: expected {' '.join(names)} in seconds, found "
                f"{text[:_SHOWN]!r} in line {number}"
            )
        row = np.array([numbers[:7]])
        (pose,), _ = quaternion_poses(row[:, :3], row[:, 3:])
        yield stamp_ns, pose, dict(zip(columns, numbers[7:], strict=True))


def _write(
    calibration: MotionCalibration,
    level: Level,
    records: Iterable[MotionRecord],
    output: str,
    existing: Existing,
    written_as: MotionFormat,
    at_once: int,
) -> None:
    heading, text = _FORMATS[written_as]
    first = heading(calibration, level)
    every = iter(records)
    with LineFile(output, existing, say) as lines:
        while found := list(islice(every, at_once)):
            lines.write(first + text(found))
            first = b""


def _json_heading(calibration: MotionCalibration, level: Level) -> bytes:
    return msgspec.json.encode(motion_header(calibration, level)) + b"\n"


def _json_lines(records: Sequence[MotionRecord]) -> bytes:
    return _ENCODER.encode_lines(records)


_ENCODER = msgspec.json.Encoder()


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
    return _comments(calibration, level) + _csv([names])


def _csv_lines(records: Sequence[MotionRecord]) -> bytes:
    """Return one row for each record and horizon; None gives an empty cell."""
    return _csv(
        (
            *(record.seq, record.stamp_ns, record.status.value, reasons),
            *(each.horizon, each.since_seq, each.seconds, each.metres),
            *(each.t_m or _NO[:3]),
            *(each.q_xyzw or _NO[:4]),
            *(each.lower or _NO),
            *(each.upper or _NO),
            *(each.position, each.rotation, str(each.bounded)),
        )
        for record in records
        for reasons in (" ".join(record.reasons),)
        for each in record.motion
    )


_NO = (None,) * 6


def _csv(rows: Iterable[Sequence[object]]) -> bytes:
    """Return lines of numbers and of words that need no quotes."""
    # As JSON: Python takes five times as long to write numbers.
    lines = _ENCODER.encode_lines(rows).replace(b"null", b"").replace(b'"', b"")
    return lines.replace(b"]\n[", b"\n")[1:].replace(b"]\n", b"\n")


def _tum_lines(records: Sequence[MotionRecord]) -> bytes:
    """Return the poses; the format has no way to say that there is none."""
    return b"".join(
        tum_line(each.stamp_ns, np.array([*each.pose.t_m, *each.pose.q_xyzw]))
        for each in records
        if each.pose is not None
    )


_FORMATS: dict[
    MotionFormat,
    tuple[Callable[[MotionCalibration, Level], bytes], Callable[[Sequence[MotionRecord]], bytes]],
] = {
    "jsonl": (_json_heading, _json_lines),
    "csv": (_csv_heading, _csv_lines),
    "tum": (_comments, _tum_lines),
}
