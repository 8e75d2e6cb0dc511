"""Convert records into files of other programs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from cvo_edge.errors import SourceError, UsageError, printable
from cvo_edge.estimate import PoseInterval
from cvo_edge.files import whole_path
from cvo_edge.motion.messages import (
    CHILD_FRAME_ID,
    FRAME_ID,
    motion_header_of,
    motion_messages,
    read_motion_records,
)
from cvo_edge.motion.records import MotionHeader
from cvo_edge.output.mcap import McapFile, McapSink, recover
from cvo_edge.output.messages import StoredImage
from cvo_edge.output.opening import PLACED, open_sink
from cvo_edge.output.records import Header, estimate_of, flat, read_records
from cvo_edge.output.rerun import RerunSink
from cvo_edge.programs.placing import Placing
from cvo_edge.vocabulary import Format

_ENCODINGS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}


def convert(
    source: Path,
    output: str,
    format: Format,
    images: Path | None,
    placing: Placing,
) -> int:
    """Write records to another format; returns their number. Raises CvoError."""
    of_motion = motion_header_of(source)
    if of_motion is not None:
        names = placing.frame_id, placing.child_frame_id
        if format != "mcap" or images is not None or placing != Placing(None, None, *names, None):
            raise UsageError(
                f"{source}: expected -o FILE.mcap with --frame-id and --child-frame-id alone for "
                "records of motion"
            )
        return _convert_motion(source, of_motion, output, *names)
    records = read_records(source)
    header = records.header
    if header is None:
        raise SourceError(
            f"{source}: expected records with a header, which says what their numbers mean, found "
            "none; records of older versions have to be made again"
        )
    placement = placing.placement(header)
    if images is not None and format not in PLACED:
        raise UsageError(f"--images: expected the format {' or '.join(PLACED)}, found {format}")
    with (
        whole_path(output) as name,
        open_sink(name, format, header, placement, existing="force") as sink,
    ):
        count = 0
        for estimate in _estimates(source, header):
            if images is not None and isinstance(sink, McapSink | RerunSink):
                sink.write(estimate, _image(estimate, images))
            else:
                sink.write(estimate)
            count += 1
        _check_some(count, source)
    return count


def _convert_motion(
    source: Path,
    header: MotionHeader,
    output: str,
    frame_id: str | None,
    child_frame_id: str | None,
) -> int:
    count = 0
    names = frame_id or FRAME_ID, child_frame_id or CHILD_FRAME_ID
    with whole_path(output) as name, McapFile(name) as file:
        file.metadata("cvo-edge", flat(header))
        for record, messages in motion_messages(read_motion_records(source), header, *names):
            for message in messages:
                file.write(message, record.stamp_ns, record.seq)
            count += 1
        _check_some(count, source)
    return count


def _check_some(count: int, source: Path) -> None:
    """Raise SourceError for no records; within ``whole_path``, so that no file is left."""
    if not count:
        raise SourceError(f"{source}: expected records, found a header alone")


def _estimates(source: Path, first: Header) -> Iterator[PoseInterval]:
    records = read_records(source)
    for record in records:
        if records.header != first:
            raise SourceError(
                f"{source}: expected records of one run, found a second header; write each run to "
                "its own file"
            )
        yield estimate_of(record, first)


def _image(estimate: PoseInterval, images: Path) -> StoredImage:
    path = images / estimate.source
    # Records may come from others, who must not choose what is read.
    if Path(estimate.source).is_absolute() or ".." in Path(estimate.source).parts:
        raise SourceError(
            f"{printable(estimate.source)}: expected the name of a file in {images}, found a path "
            "out of it"
        )
    encoding = _ENCODINGS.get(path.suffix.lower())
    if encoding is None:
        raise SourceError(
            f"{estimate.source or f'frame {estimate.seq}'}: expected the name of a JPEG or PNG "
            f"file in {images}, as records of a folder have it"
        )
    try:
        return StoredImage(encoding, path.read_bytes())
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from None


def recovered(source: Path, output: str) -> str:
    """Finish a file that was not; returns the line that says what was found."""
    with whole_path(output) as name:
        found = recover(source, name)
    state = "was finished" if found.finished else "was not finished"
    return f"{source} {state}; {found.messages} complete messages -> {output}"
