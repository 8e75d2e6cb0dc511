"""Where estimates go: JSON lines, CSV, a TUM trajectory or a table, one flushed line a frame."""

from __future__ import annotations

import csv
import fcntl
import io
import math
import os
import select
import stat
import sys
from collections.abc import Callable, Iterable
from types import TracebackType

import msgspec

from cvo_edge.errors import SinkError, UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.vocabulary import Format

_CSV_LATENCIES = ("read", "preprocess", "model", "conformal", "total")


class Sink:
    """Writes one line a frame, past every buffer of ours: an acknowledged record survives us.

    Parameters
    ----------
    path
        Output file, emptied when the first line is written, or ``-`` for standard output.
    format
        ``jsonl``, ``csv``, ``tum`` or, for reading by eye, ``table``.
    region
        Put the region's points into the records, where there is one; ``jsonl`` only.

    Raises
    ------
    SinkError
        The file cannot be opened or, later, written; every complete line is kept.
    UsageError
        A format whose lines have no place for a region.
    """

    def __init__(self, path: str, format: Format, *, region: bool = False) -> None:
        self._header, self._line = _FORMATS[format]
        if region:
            if format != "jsonl":
                raise UsageError(f"region: expected the format jsonl, found {format}")
            self._line = _json_line_with_region
        self._owned = path != "-"
        self._name = path if self._owned else "standard output"
        self._started = False
        try:
            self._descriptor = (
                os.open(path, os.O_WRONLY | os.O_CREAT, 0o666)
                if self._owned
                else sys.stdout.fileno()
            )
            self._alone()
        except OSError as error:
            raise SinkError(f"{self._name}: cannot be written: {error.strerror}") from None

    def _alone(self) -> None:
        """Two writers of one file would leave neither's records whole; the lock ends with us."""
        if not self._owned or not stat.S_ISREG(os.fstat(self._descriptor).st_mode):
            return
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._descriptor)
            raise SinkError(
                f"{self._name}: expected a file that no other run writes to, found one that does"
            ) from None
        except OSError:
            return  # a file system that has no locks

    def __enter__(self) -> Sink:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the file, if it is one."""
        if self._owned:
            os.close(self._descriptor)

    def write(self, estimate: PoseInterval) -> None:
        """Write one estimate.

        Raises SinkError where the disk refuses, BrokenPipeError where the reader has left, and
        UsageError for a TUM line without a stamp.
        """
        line = self._line(estimate)
        if not self._started:
            self._started = True
            # Not before there is something to put in its place.
            if self._owned and stat.S_ISREG(os.fstat(self._descriptor).st_mode):
                os.ftruncate(self._descriptor, 0)
            if self._header:
                self._put(self._header(estimate))
        self._put(line)

    def _put(self, line: bytes) -> None:
        while line:
            try:
                line = line[os.write(self._descriptor, line) :]
            except BrokenPipeError:
                raise
            except BlockingIOError:
                # Another process has asked not to wait for this pipe's reader; records have to.
                reader = select.poll()
                reader.register(self._descriptor, select.POLLOUT)
                reader.poll()
            except OSError as error:
                raise SinkError(f"{self._name}: cannot be written: {error.strerror}") from None


def _json_line(estimate: PoseInterval) -> bytes:
    return msgspec.json.encode(estimate.to_dict()) + b"\n"


def _json_line_with_region(estimate: PoseInterval) -> bytes:
    return msgspec.json.encode(estimate.to_dict(region=True)) + b"\n"


def _csv_header(estimate: PoseInterval) -> bytes:
    dof = estimate.chart.dof
    return _csv_row(
        [
            *("seq", "stamp_ns", "source", "status", "reasons"),
            *("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"),
            *("confidence", "scope", "rotation"),
            *(f"{name}_lower" for name in dof),
            *(f"{name}_upper" for name in dof),
            "bounded",
            *(f"{name}_bands" for name in dof),
            *(f"{name}_ms" for name in _CSV_LATENCIES),
        ]
    )


def _csv_line(estimate: PoseInterval) -> bytes:
    record = estimate.to_dict()
    pose, interval = record["pose"], record["interval"]
    return _csv_row(
        [
            *(record["seq"], record["stamp_ns"], record["source"], str(record["status"])),
            " ".join(record["reasons"]),
            *([*pose["t_m"], *pose["q_xyzw"]] if pose else [None] * 7),
            *(record["interval"][key] if interval else None for key in _INTERVAL_KEYS),
            *(interval["lower"] if interval else [None] * 6),
            *(interval["upper"] if interval else [None] * 6),
            interval["bounded"] if interval else None,
            *(_csv_bands(interval["bands"]) if interval and interval["bands"] else [None] * 6),
            *(record["latency_ms"].get(stage) for stage in _CSV_LATENCIES),
        ]
    )


_INTERVAL_KEYS = ("confidence", "scope", "rotation")


def _csv_bands(bands: Iterable[Iterable[tuple[float, float]]]) -> list[str]:
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
            f"tum: expected a stamp for every frame, found none for {estimate.source or 'frame'}; "
            "give --fps"
        )
    seconds, rest = divmod(abs(estimate.stamp_ns), 1_000_000_000)
    sign = "-" if estimate.stamp_ns < 0 else ""
    numbers = " ".join(f"{value:.9f}" for value in estimate.pose.to_array().tolist())
    return f"{sign}{seconds}.{rest:09d} {numbers}\n".encode()


def _table_header(estimate: PoseInterval) -> bytes:
    names = "".join(
        f"{name + unit:>21}" for name, unit in zip(estimate.chart.dof, _UNITS, strict=True)
    )
    return f"{'frame':<26}{'status':<9}{names}\n".encode()


def _table_line(estimate: PoseInterval) -> bytes:
    # A file's name may move a terminal's cursor.
    name = "".join(c if c.isprintable() else "?" for c in estimate.source or str(estimate.seq))
    name = name[-25:]
    line = f"{name:<26}{estimate.status:<9}"
    if estimate.pose is None:
        return f"{line}  {', '.join(estimate.reasons)}\n".encode()
    pieces = [len(row) for row in estimate.bands] if estimate.bands else [1] * 6
    for low, high, scale, bands in zip(
        estimate.lower.tolist(), estimate.upper.tolist(), _SCALES, pieces, strict=True
    ):
        finite = high - low < float("inf")
        cell = f"{scale * low:.1f} .. {scale * high:.1f}" if finite else "unbounded"
        # A set in pieces shows its hull and, in brackets, how many there are.
        line += f"{cell if bands == 1 else f'{cell} ({bands})':>21}"
    return f"{line}\n".encode()


_UNITS = (" cm",) * 3 + (" deg",) * 3
_SCALES = (100.0,) * 3 + (math.degrees(1.0),) * 3

_LineWriter = Callable[[PoseInterval], bytes]
_FORMATS: dict[Format, tuple[_LineWriter | None, _LineWriter]] = {
    "jsonl": (None, _json_line),
    "csv": (_csv_header, _csv_line),
    "tum": (None, _tum_line),
    "table": (_table_header, _table_line),
}
