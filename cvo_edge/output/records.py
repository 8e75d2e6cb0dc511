"""The header, which makes records readable without the bundle, and reading both from a file."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from msgspec import UNSET, Struct, UnsetType
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration, Quaternion
from cvo_edge.documents import shown
from cvo_edge.errors import SourceError
from cvo_edge.estimate import Drift, PoseInterval
from cvo_edge.given import given_path
from cvo_edge.pose import Chart, Pose, Rotation
from cvo_edge.record import BandsOrUnbounded, Record, RecordedRegion, SixOrUnbounded
from cvo_edge.sets import Bands, ConformalSet, Ellipsoids, unbounded_set
from cvo_edge.vocabulary import VERSION, Precision, Provider, Scope

Array = NDArray[np.float64]
Stamps = Literal["fps", "arrival"]


class Header(
    Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="header", tag_field="kind"
):
    """Data shared by all records that follow: bundle, frames, chart, confidence and scope.

    Attributes
    ----------
    schema_version, software
        Version of this format, and the program that wrote it.
    bundle, method, digest, precision, provider
        Name, method, digest, model precision and inference engine of the bundle.
    frame_id, child_frame_id
        A pose maps points of ``child_frame_id`` (the camera) into ``frame_id`` (the world).
    rotation, reference_q_xyzw
        Chart of the rotation numbers: ``tangent_reference`` is Log(R_reference^T R) with this
        reference quaternion; ``tangent_predicted`` is Log(R_predicted^T R) with the record's own
        pose; ``euler_zyx`` is roll, pitch, yaw. The reference is null except for
        ``tangent_reference``.
    dof, units
        Names of the six degrees of freedom; units of the first and of the last three.
    confidence, scope
        Stated probability, for each degree of freedom (``marginal``) or all six (``joint``).
    stamps
        Origin of ``stamp_ns``: ``fps``, frames counted at a given rate; ``arrival``, the system
        clock when a camera's frame arrived; null, the stamps of the source, if it has any.
    """

    schema_version: Literal[1] = 1
    software: str
    bundle: str
    method: str
    digest: str
    precision: Precision
    provider: Provider
    frame_id: str
    child_frame_id: str
    rotation: Rotation
    reference_q_xyzw: Quaternion | None
    dof: tuple[str, str, str, str, str, str]
    units: tuple[Literal["m"], Literal["rad"]]
    confidence: float
    scope: Scope
    stamps: Stamps | None


def header_of(
    calibration: Calibration,
    chart: Chart,
    confidence: float,
    scope: Scope,
    stamps: Stamps | None = None,
) -> Header:
    """Return the header for records of one bundle at one confidence and scope."""
    model, pose, reference = calibration.model, calibration.pose, chart.reference_q_xyzw
    return Header(
        software=f"cvo-edge {VERSION}",
        bundle=calibration.name,
        method=calibration.method,
        digest=calibration.digest,
        precision=model.precision,
        provider=model.provider,
        frame_id=pose.frame_id,
        child_frame_id=pose.child_frame_id,
        rotation=chart.rotation,
        reference_q_xyzw=None if reference is None else tuple(reference.tolist()),
        dof=chart.dof,
        units=pose.units,
        confidence=confidence,
        scope=scope,
        stamps=stamps,
    )


def flat(header: Struct) -> dict[str, str]:
    """Return the fields of a header as text; those that are none become JSON."""
    return {
        key: value if isinstance(value, str) else msgspec.json.encode(value).decode()
        for key, value in msgspec.to_builtins(header).items()
    }


def estimate_of(record: Record, header: Header) -> PoseInterval:
    """Return the estimate that a record was written from; its drift has no reason.

    The region is there only if it was recorded.
    """
    reference = header.reference_q_xyzw
    chart = Chart(header.rotation, None if reference is None else np.array(reference))
    pose, interval = record.pose, record.interval
    found = unbounded_set()
    if interval is not None:
        found = ConformalSet(
            _bounds(interval.lower, -np.inf),
            _bounds(interval.upper, np.inf),
            None if interval.bands is None else _bands(interval.bands),
            ellipsoids=_ellipsoids(interval.region),
        )
    return PoseInterval(
        record.seq,
        record.stamp_ns,
        record.source,
        record.status,
        record.reasons,
        None if pose is None else Pose(np.array(pose.t_m), np.array(pose.q_xyzw)),
        found,
        header.confidence,
        header.scope,
        chart,
        record.latency_ms,
        record.factor or None,
        Drift("unknown") if record.drift is UNSET else Drift(record.drift),
        None if record.novelty is UNSET else record.novelty,
    )


def _bounds(values: SixOrUnbounded, unbounded: float) -> Array:
    return np.array([unbounded if value is None else value for value in values])


def _bands(rows: BandsOrUnbounded) -> Bands:
    return tuple(
        tuple(
            (-math.inf if low is None else low, math.inf if high is None else high)
            for low, high in row
        )
        for row in rows
    )


def _ellipsoids(region: RecordedRegion | UnsetType | None) -> Ellipsoids | None:
    if not region:
        return None
    return Ellipsoids(np.array(region.centres), np.array(region.scale), region.radius)


class Records:
    """Single-pass iterator over the records of a JSON Lines file, in the order of the file.

    Attributes
    ----------
    header
        The header of the last record returned; before the first record, the header on the first
        line. None for records without a header, as written by older versions. A file with several
        runs has a header before the records of each run.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.header: Header | None = None
        self._lines: Iterator[Header | Record] = _decoded(given_path(path, "records"))
        first = next(self._lines, None)
        if isinstance(first, Header):
            self.header = first
        elif first is not None:
            self._lines = chain((first,), self._lines)

    def __iter__(self) -> Iterator[Record]:
        """Return itself."""
        return self

    def __next__(self) -> Record:
        """Return the next record; raises SourceError as ``read_records``."""
        for line in self._lines:
            if isinstance(line, Record):
                return line
            self.header = line
        raise StopIteration


def read_records(path: str | os.PathLike[str]) -> Records:
    """Open a JSON Lines file written by ``cvo-edge run``, with or without a header.

    After a crash, a power loss or a full disk, an incomplete last line is skipped. All earlier
    lines are complete, because each line is written in one piece.

    Raises
    ------
    SourceError
        The file cannot be read, or a complete line is not a record; the message names the line.
        Raised immediately for the first line, and by the iterator for later lines.
    """
    return Records(path)


_RECORD = msgspec.json.Decoder(Record)
_HEADER = msgspec.json.Decoder(Header)


class _Kind(Struct):
    kind: str | None = None


_KIND = msgspec.json.Decoder(_Kind)


def _decoded(path: Path) -> Iterator[Header | Record]:
    try:
        with path.open("rb") as stream:
            for number, line in enumerate(stream, start=1):
                if not line.endswith(b"\n"):
                    return
                try:
                    decoded = _header_or_record(line)
                except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
                    raise SourceError(f"{path!s}: line {number} is not a record: {error}") from None
                yield decoded
    # A ValueError means that the name is not a valid file name.
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", error)
        raise SourceError(f"{path!s}: cannot be read: {reason}") from None


def _header_or_record(line: bytes) -> Header | Record:
    try:
        return _RECORD.decode(line)
    except msgspec.ValidationError:
        # Records have no key "kind"; for an invalid header, its own error is more precise.
        kind = _KIND.decode(line).kind
        if kind == "header":
            return _HEADER.decode(line)
        if kind is not None:
            raise msgspec.ValidationError(
                f"expected one of cvo-edge run or serve, found one of {shown(kind)}"
            ) from None
        raise
