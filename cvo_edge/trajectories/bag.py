"""Read messages of ROS bags, of every version and storage, through the library ``rosbags``.

A bag is a ``.bag`` file (ROS 1), a folder with ``metadata.yaml`` (ROS 2), or a single ``.mcap`` or
``.db3`` file (ROS 2). Messages are read one at a time; the bag is never in memory as a whole.
"""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from cvo_edge.errors import CvoError, SourceError, UsageError
from cvo_edge.files import natural_key

_SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
_LONGEST = 120


class Message(NamedTuple):
    """A message, when the recorder received it (ns), and its number among those of this time."""

    content: Any
    received_ns: int
    number: int

    @property
    def stamp_ns(self) -> int:
        """The stamp of the header in ns; where it is zero, the time of receipt."""
        return stamp_ns(self.content.header) or self.received_ns


def stamp_ns(header: Any) -> int:
    """Return the stamp of a header in ns; 0 if it was not set."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def find_bags(root: Path) -> dict[str, Path]:
    """Return the bag at ``root``, or all bags in this folder, by name and in natural order.

    Raises SourceError if there is none.
    """
    if is_bag(root):
        return {root.resolve().stem: root}
    found = sorted(filter(is_bag, root.iterdir()), key=natural_key) if root.is_dir() else []
    if not found:
        what = "no bag in this folder" if root.is_dir() else "another file" * root.exists()
        raise SourceError(
            f"{root}: expected a bag ({', '.join(_SUFFIXES)}, or a folder with {_METADATA}) or a "
            f"folder of bags, found {what or 'none'}"
        )
    stems = [path.stem for path in found]
    return {path.name if stems.count(path.stem) > 1 else path.stem: path for path in found}


def is_bag(path: Path) -> bool:
    """Whether a path is that of a bag, by its name."""
    if os.path.isdir(path):  # noqa: PTH112 - also of a name too long
        return (path / _METADATA).is_file()
    return path.suffix in _SUFFIXES and path.is_file()


class Bag:
    """An open bag; it is closed when it is no longer referenced."""

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises UsageError if ``rosbags`` is not installed and SourceError if the bag is damaged.
        """
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise UsageError(
                f"{path}: expected the library rosbags to read a bag, found it not installed; "
                'pip install "cvo-edge[rosbag]", or write frames and poses where it is: cvo-export '
                f"render rosbag:{path} FOLDER"
            ) from None
        self.path = path
        with _damaged(path):
            # ROS 2 stored no message definitions before Iron; those used here have not changed.
            default = get_typestore(Stores.ROS2_HUMBLE)
            self._reader = AnyReader([path], default_typestore=default)
            self._reader.open()
        weakref.finalize(self, self._reader.close)
        # Readers keep their place in the file.
        self._lock = threading.Lock()
        self.topics: dict[str, str] = {
            connection.topic: connection.msgtype
            for connection in self._reader.connections
            if connection.msgcount
        }

    def of_types(self, types: tuple[str, ...]) -> list[str]:
        """Return the topics with messages of these types, in alphabetical order."""
        return sorted(topic for topic, kind in self.topics.items() if kind in types)

    def messages(
        self, topic: str, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Message]:
        """Yield the messages of a topic in the order of receipt; raises SourceError."""
        connections = [each for each in self._reader.connections if each.topic == topic]
        last, number = -1, 0
        with _damaged(self.path):
            for connection, received, raw in self._reader.messages(
                connections, start=start_ns, stop=stop_ns
            ):
                number = number + 1 if received == last else 0
                last = received
                yield Message(self._reader.deserialize(raw, connection.msgtype), received, number)

    def first(self, topic: str) -> Any:
        """Return the first message of a topic; raises SourceError."""
        for found in self.messages(topic):
            return found.content
        raise SourceError(f"{self.path}: expected messages of {topic}, as the bag says, found none")

    def message(self, topic: str, received_ns: int, number: int) -> Any:
        """Return one message again; may be called from several threads. Raises SourceError."""
        with self._lock:
            for found in self.messages(topic, received_ns, received_ns + 1):
                if found.number == number:
                    return found.content
        raise SourceError(f"{self.path}: expected the bag as it was opened, found another one")


@contextmanager
def _damaged(path: Path) -> Iterator[None]:
    """Turn errors of the library, which raises many unrelated types, into one line."""
    try:
        yield
    except CvoError:
        raise
    except PermissionError as error:
        raise SourceError(f"{path}: expected a bag that can be read: {error.strerror}") from None
    except Exception as error:
        reason = " ".join(str(error).split())[:_LONGEST] or type(error).__name__
        raise SourceError(
            f"{path}: expected a whole ROS bag, found a damaged, incomplete or other one "
            f"({reason}); copy it again, or repair it with rosbag reindex, ros2 bag reindex or "
            "mcap recover"
        ) from None
