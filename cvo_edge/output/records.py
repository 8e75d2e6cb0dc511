"""Reading back what ``cvo-edge run`` wrote: JSON lines, also of a run that was killed."""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from cvo_edge.errors import SourceError
from cvo_edge.estimate import Reason, Status
from cvo_edge.pose import Rotation
from cvo_edge.vocabulary import Scope

Six = tuple[float, float, float, float, float, float]
SixOrUnbounded = tuple[
    float | None, float | None, float | None, float | None, float | None, float | None
]


class _Strict(Struct, frozen=True, forbid_unknown_fields=True):
    """Immutable, no other keys."""


class RecordedPose(_Strict, frozen=True):
    """``t_m``: tx ty tz of the camera in the world, metres; ``q_xyzw``: its rotation, unit."""

    t_m: tuple[float, float, float]
    q_xyzw: tuple[float, float, float, float]


class RecordedInterval(_Strict, frozen=True):
    """The set as recorded, in the chart ``rotation``, m and rad; null (None) is unbounded.

    ``bands`` per DoF, for methods whose sets may be in pieces; ``region`` as ``run --region`` adds
    it, else None.
    """

    confidence: float
    scope: Scope
    rotation: Rotation
    lower: SixOrUnbounded
    upper: SixOrUnbounded
    bounded: bool
    bands: tuple[tuple[tuple[float | None, float | None], ...], ...] | None
    region: dict[str, Any] | None = None


class Record(_Strict, frozen=True):
    """One line: what was said of one frame; keys as the README specifies them."""

    seq: int
    stamp_ns: int | None
    source: str
    status: Status
    reasons: tuple[Reason, ...]
    pose: RecordedPose | None
    interval: RecordedInterval | None
    latency_ms: dict[str, float]


_DECODER = msgspec.json.Decoder(Record)


def read_records(path: str | PathLike[str]) -> Iterator[Record]:
    """Yield the records of a file of JSON lines, in its order.

    A last line without its end, of a run that was killed or lost its power or disk, is left out:
    every line before it is whole, as a record is written at once and its end last.

    Raises
    ------
    SourceError
        The file cannot be read, or a whole line is no record; names the line.
    """
    try:
        with Path(path).open("rb") as stream:
            for number, line in enumerate(stream, start=1):
                if not line.endswith(b"\n"):
                    return
                try:
                    record = _DECODER.decode(line)
                except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
                    raise SourceError(
                        f"{path}: expected a record in line {number}, found none: {error}"
                    ) from None
                yield record
    # A ValueError is a name that no file can have.
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: cannot be read: {getattr(error, 'strerror', error)}") from None
