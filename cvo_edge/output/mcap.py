"""MCAP files of ROS 2 messages, which rosbags, mcap-ros2-support and evo read.

A file that is being written is not chunked and is flushed after each frame, so that a process that
is killed loses nothing that it reported; what is then missing at the end of the file, ``recover``
adds. The definitions of messages and their serialisation (CDR) are those of the library rosbags.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from io import BufferedReader, RawIOBase
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from cvo_edge.errors import SinkError, SourceError, UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.output.messages import Message, Placement, StoredImage, ros_image, ros_messages
from cvo_edge.output.named import Told, has_name, lost, opened_empty, reopenings
from cvo_edge.output.records import Header, flat

_PROFILE = "ros2"
# https://mcap.dev/spec: magic, then records of a kind and a length, the last one the footer.
_MAGIC, _HEAD, _FOOTER = b"\x89MCAP0\r\n", struct.Struct("<BQ"), 2


def _libraries() -> tuple[Any, Any]:
    """Return mcap's writer and the typestore; raises UsageError if they are not installed."""
    try:
        from mcap import writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise UsageError('mcap: not installed; pip install "cvo-edge[mcap]"') from None
    return writer, get_typestore(Stores.ROS2_HUMBLE)


def _check_file(path: str) -> None:
    if path == "-":
        raise UsageError("mcap: expected a file, found standard output")


class McapFile:
    """Writes messages to an MCAP file.

    Parameters
    ----------
    path
        The file; replaced.

    Attributes
    ----------
    messages
        Number of messages so far.

    Raises UsageError for standard output and if the libraries are missing, and SinkError if the
    file cannot be written.
    """

    def __init__(self, path: str) -> None:
        _check_file(path)
        library, self._types = _libraries()
        self._name = path
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self.messages = 0
        self._log_ns = 0
        self._stream: BinaryIO | None = None
        try:
            self._stream = opened_empty(path)
            self._writer = library.Writer(self._stream, use_chunking=False)
            self._writer.start(profile=_PROFILE, library="cvo-edge")
            self._stream.flush()
        except OSError as error:
            raise self._failed(error) from None

    def __enter__(self) -> McapFile:
        """Return itself."""
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        """Finish the file: its index makes it complete for every reader."""
        if self._stream is None:
            return
        stream, self._stream = self._stream, None
        try:
            with stream:
                # After a full disk, another write only adds a torn record.
                if not isinstance(error, SinkError):
                    self._writer.finish()
        except OSError as problem:
            raise self._failed(problem) from None

    @property
    def named(self) -> bool:
        """Whether the file is still the one under its name."""
        return self._stream is not None and has_name(self._stream.fileno(), self._name)

    def metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Write keys and values that concern the whole file."""
        try:
            self._writer.add_metadata(name, dict(content))
        except OSError as error:
            raise self._failed(error) from None

    def write(self, message: Message, stamp_ns: int, sequence: int) -> None:
        """Write one message; ``flush`` makes it safe. Raises SinkError.

        After a clock that was set back, or another run, the message keeps its stamp, and is logged
        at the latest time before it: readers of bags refuse a file that is not in order.
        """
        try:
            channel = self._channels.get(message.topic)
            if channel is None:
                channel = self._channel(message)
            content = self._types.serialize_cdr(
                self._built(message.type, message.content), message.type
            )
            self._log_ns = max(self._log_ns, stamp_ns)
            self._writer.add_message(
                channel, self._log_ns, bytes(content), max(0, stamp_ns), sequence & 0xFFFFFFFF
            )
            self.messages += 1
        except OSError as error:
            raise self._failed(error) from None

    def flush(self) -> None:
        """Hand everything to the operating system; raises SinkError."""
        if self._stream is None:
            return
        try:
            self._stream.flush()
        except OSError as error:
            raise self._failed(error) from None

    def copy(self, record: Any, kinds: Any) -> None:  # noqa: ANN401 - mcap's records
        """Write a record of another file, but for those that ``__exit__`` writes anew."""
        writer = self._writer
        try:
            if isinstance(record, kinds.Schema):
                found = writer.register_schema(record.name, record.encoding, record.data)
                self._schemas[str(record.id)] = found
            elif isinstance(record, kinds.Channel):
                self._channels[str(record.id)] = writer.register_channel(
                    record.topic,
                    record.message_encoding,
                    self._schemas[str(record.schema_id)],
                    record.metadata,
                )
            elif isinstance(record, kinds.Metadata):
                writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, kinds.Message):
                writer.add_message(
                    self._channels[str(record.channel_id)],
                    record.log_time,
                    record.data,
                    record.publish_time,
                    record.sequence,
                )
                self.messages += 1
        except OSError as error:
            raise self._failed(error) from None

    def _channel(self, message: Message) -> int:
        schema = self._schemas.get(message.type)
        if schema is None:
            definition, _ = self._types.generate_msgdef(message.type, ros_version=2)
            schema = self._writer.register_schema(message.type, "ros2msg", definition.encode())
            self._schemas[message.type] = schema
        channel = self._writer.register_channel(message.topic, "cdr", schema)
        self._channels[message.topic] = channel
        return int(channel)

    def _built(self, name: str, content: Mapping[str, Any]) -> Any:  # noqa: ANN401 - rosbags' types
        """Return a message of a type from its fields; others are zero or empty."""
        _, fields = self._types.fielddefs[name]
        found = {key: self._field(kind, content.get(key)) for key, kind in fields}
        return self._types.types[name](**found)

    def _field(self, kind: Any, value: Any) -> Any:  # noqa: ANN401 - rosbags' types
        node, detail = kind
        if node.name == "NAME":
            return self._built(detail, value or {})
        if node.name == "BASE":
            name = detail[0]
            return value if value is not None else "" if name == "string" else _ZERO.get(name, 0)
        (inner, inner_detail), _ = detail
        if inner.name == "BASE" and inner_detail[0] != "string":
            if isinstance(value, bytes):
                return np.frombuffer(value, np.uint8)
            return np.array([] if value is None else value, inner_detail[0])
        return [self._field((inner, inner_detail), each) for each in value or ()]

    def _failed(self, error: OSError) -> SinkError:
        return SinkError(f"{self._name}: cannot be written: {error.strerror}")


_ZERO: dict[str, Any] = {"bool": False, "float32": 0.0, "float64": 0.0}


class McapSink:
    """Writes estimates as ROS 2 messages; used like ``Sink``.

    Parameters
    ----------
    path
        The file; replaced when the first frame is written.
    header
        What all records share; it becomes the file's metadata ``cvo-edge``.
    placement
        Where the estimates are seen from.
    told
        Called once if the file loses its name. After SIGHUP, one that has lost it is finished, and
        another is begun under the name.
    """

    def __init__(
        self, path: str, header: Header, placement: Placement, told: Told | None = None
    ) -> None:
        _check_file(path)
        _libraries()
        self._path, self._header, self._placement, self._told = path, header, placement, told
        self._file: McapFile | None = None
        self._opened = reopenings()

    def __enter__(self) -> McapSink:
        """Return itself."""
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        """Finish the file."""
        if self._file is not None:
            self._file.__exit__(kind, error, traceback)

    def write(self, estimate: PoseInterval, image: StoredImage | None = None) -> None:
        """Write the messages of a frame, and its image as it is stored.

        Raises SinkError, and UsageError for a frame without a stamp.
        """
        messages = [*ros_messages(estimate, self._placement, self._header)]
        if image is not None:
            messages.append(ros_image(estimate, self._placement, image))
        stamp_ns = estimate.stamp_ns or 0
        self._follow_its_name()
        if self._file is None:
            # An old file is kept until there is a frame to put in its place.
            self._file = McapFile(self._path)
            self._file.metadata("cvo-edge", flat(self._header))
        for message in messages:
            self._file.write(message, stamp_ns, estimate.seq)
        self._file.flush()

    def _follow_its_name(self) -> None:
        asked, self._opened = self._opened != reopenings(), reopenings()
        if self._file is None or self._file.named:
            return
        if asked:
            file, self._file = self._file, None
            file.__exit__(None, None, None)
        elif self._told is not None:
            self._told(lost(self._path))
            self._told = None


class Recovered(NamedTuple):
    """What ``recover`` found: complete messages, and whether the file was finished."""

    messages: int
    finished: bool


def recover(source: str | os.PathLike[str], target: str) -> Recovered:
    """Copy the complete records of an MCAP file that was not finished, and finish the copy.

    Raises SourceError if it cannot be read or is no MCAP file, UsageError and SinkError.
    """
    _libraries()
    from mcap import records as kinds
    from mcap.exceptions import McapError
    from mcap.stream_reader import StreamReader

    try:
        with Path(source).open("rb") as stream:
            whole = _Whole(stream)
            if not whole.is_mcap:
                raise SourceError(f"{source!s}: expected an MCAP file, found another one")
            with McapFile(target) as file:
                try:
                    for record in StreamReader(BufferedReader(whole)).records:
                        file.copy(record, kinds)
                # The end of what is complete is one of them.
                except McapError:
                    pass
                return Recovered(file.messages, whole.finished)
    except OSError as error:
        raise SourceError(f"{source!s}: cannot be read: {error.strerror}") from None


class _Whole(RawIOBase):
    """The complete records of a file; mcap's own reader takes a torn message for a shorter one."""

    def __init__(self, stream: BinaryIO) -> None:
        size = os.fstat(stream.fileno()).st_size
        self.is_mcap = stream.read(len(_MAGIC)) == _MAGIC
        self.finished = False
        self._end = len(_MAGIC)
        while self.is_mcap and len(head := stream.read(_HEAD.size)) == _HEAD.size:
            kind, length = _HEAD.unpack(head)
            if self._end + _HEAD.size + length > size:
                break
            self._end += _HEAD.size + length
            stream.seek(self._end)
            if kind == _FOOTER:
                self.finished = stream.read(len(_MAGIC)) == _MAGIC
                self._end += len(_MAGIC) * self.finished
                break
        stream.seek(0)
        self._stream = stream

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:  # noqa: ANN401 - a buffer has no type before 3.12
        """Fill a buffer with the next bytes, at most those of complete records."""
        left = max(0, self._end - self._stream.tell())
        found = self._stream.read(min(left, len(buffer)))
        buffer[: len(found)] = found
        return len(found)
