"""Sinks for estimates: JSON Lines, CSV, TUM trajectory or table, one line per frame, unbuffered."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.output.lines import LineFile
from cvo_edge.output.records import Header
from cvo_edge.output.table import table_heading, table_line
from cvo_edge.record import BandsOrUnbounded
from cvo_edge.vocabulary import Existing, Format

Array = NDArray[np.float64]

_F = TypeVar("_F", bound=str)

_SUFFIXES = (".jsonl", ".csv", ".tum", ".mcap", ".rrd")
_CSV_LATENCIES = ("read", "preprocess", "model", "conformal", "total")


def format_of(path: str, format: _F | None = None, formats: Sequence[_F] = get_args(Format)) -> _F:
    """Return an output's format: as requested, or from the suffix of the path, or the first one.

    ``formats`` are those that the caller writes. Raises UsageError if the suffix (``.jsonl``,
    ``.csv``, ``.tum``, ``.mcap``, ``.rrd``) is that of another format than the requested one, or of
    one that the caller does not write.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _SUFFIXES:
        return format or formats[0]
    of_suffix = next((each for each in formats if suffix == f".{each}"), None)
    if of_suffix is None:
        raise UsageError(
            f"format: expected {' or '.join(formats)}, found the file name {Path(path).name}; "
            "change the name"
        )
    if format and format != of_suffix:
        raise UsageError(
            f"format: expected {of_suffix} for the file name {Path(path).name}, found {format}; "
            "change the name or the format, or omit --format"
        )
    return of_suffix


class Sink:
    """Writes one line per frame without buffering, so that written records survive a crash.

    Parameters
    ----------
    path
        Output file, truncated when the first line is written, or ``-`` for standard output.
    format
        ``jsonl``, ``csv``, ``tum`` or the human-readable ``table``.
    header
        Written before the first record: as a JSON line, or as lines ``# key: value`` in ``csv`` and
        ``tum``. None if the file holds records of several bundles.
    region
        Include the points of the region, if there is one, in the records; ``jsonl`` only.
    existing, told
        As for ``LineFile``.

    Raises
    ------
    SinkError
        As ``LineFile``.
    UsageError
        The format cannot hold a region.
    """

    def __init__(
        self,
        path: str,
        format: Format,
        header: Header | None = None,
        *,
        region: bool = False,
        existing: Existing = "replace",
        told: Callable[[str], None] | None = None,
    ) -> None:
        if region and format != "jsonl":
            raise UsageError(f"region: expected the format jsonl, found {format}")
        self._header = header
        self._heading, self._line = _FORMATS[format]
        if region:
            self._line = _json_line_with_region
        self._lines = LineFile(path, existing, told)

    def __enter__(self) -> Sink:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file, if it is one."""
        self._lines.__exit__()

    def write(self, estimate: PoseInterval) -> None:
        """Write one estimate.

        Raises SinkError if writing fails, BrokenPipeError if the reader closed the pipe, and
        UsageError for a TUM line without a stamp.
        """
        line = self._line(estimate)
        if not self._lines.started:
            line = self._heading(self._header, estimate) + line
        self._lines.write(line)


def _json_heading(header: Header | None, _: PoseInterval) -> bytes:
    return b"" if header is None else msgspec.json.encode(header) + b"\n"


def _json_line(estimate: PoseInterval) -> bytes:
    return msgspec.json.encode(estimate.to_record()) + b"\n"


def _json_line_with_region(estimate: PoseInterval) -> bytes:
    return msgspec.json.encode(estimate.to_record(region=True)) + b"\n"


def _comments(header: Header | None, _: PoseInterval) -> bytes:
    """Return the header as lines ``# key: value``: text verbatim, other values as JSON."""
    fields = {} if header is None else msgspec.to_builtins(header)
    lines = (
        f"# {key}: {value if isinstance(value, str) else msgspec.json.encode(value).decode()}\n"
        for key, value in fields.items()
    )
    return "".join(lines).encode()


def _csv_heading(header: Header | None, estimate: PoseInterval) -> bytes:
    dof = estimate.chart.dof
    columns = [
        *("seq", "stamp_ns", "source", "status", "reasons"),
        *("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"),
        *("confidence", "scope", "rotation"),
        *(f"{name}_lower" for name in dof),
        *(f"{name}_upper" for name in dof),
        "bounded",
        *(f"{name}_bands" for name in dof),
        *(f"{name}_ms" for name in _CSV_LATENCIES),
        *(("factor",) if estimate.factor is not None else ()),
    ]
    return _comments(header, estimate) + _csv_row(columns)


def _csv_line(estimate: PoseInterval) -> bytes:
    record = estimate.to_record()
    pose, interval = record.pose, record.interval
    row: list[object] = [record.seq, record.stamp_ns, record.source, str(record.status)]
    row.append(" ".join(record.reasons))
    row += [*pose.t_m, *pose.q_xyzw] if pose else [None] * 7
    if interval:
        row += [interval.confidence, interval.scope, interval.rotation]
        row += [*interval.lower, *interval.upper, interval.bounded]
        row += _csv_bands(interval.bands) if interval.bands else [None] * 6
    else:
        row += [None] * 22
    row += [record.latency_ms.get(stage) for stage in _CSV_LATENCIES]
    if record.factor:
        row.append(" ".join(map(repr, record.factor)))
    return _csv_row(row)


def _csv_bands(bands: BandsOrUnbounded) -> list[str]:
    return [" ".join(f"{low!r}:{high!r}" for low, high in dof) for dof in bands]


def _csv_row(values: Iterable[object]) -> bytes:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(
        "" if value is None else value for value in values
    )
    return buffer.getvalue().encode()


def _tum_line(estimate: PoseInterval) -> bytes:
    if estimate.pose is None:
        return b""  # the format has no way to say "no pose"
    if estimate.stamp_ns is None:
        raise UsageError(
            f"tum: expected a stamp for every frame, {estimate.source or f'frame {estimate.seq}'} "
            "has none; give --fps"
        )
    return tum_line(estimate.stamp_ns, estimate.pose.to_array())


def tum_line(stamp_ns: int, pose: Array) -> bytes:
    """Return the line of a pose (7,): seconds, tx ty tz, qx qy qz qw."""
    seconds, rest = divmod(abs(stamp_ns), 1_000_000_000)
    sign = "-" if stamp_ns < 0 else ""
    numbers = " ".join(f"{value:.9f}" for value in pose.tolist())
    return f"{sign}{seconds}.{rest:09d} {numbers}\n".encode()


_FORMATS: dict[
    Format,
    tuple[Callable[[Header | None, PoseInterval], bytes], Callable[[PoseInterval], bytes]],
] = {
    "jsonl": (_json_heading, _json_line),
    "csv": (_csv_heading, _csv_line),
    "tum": (_comments, _tum_line),
    "table": (lambda _, estimate: table_heading(estimate), table_line),
}
