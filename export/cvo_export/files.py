"""JSON result files: written atomically, read strictly."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec

from cvo_edge.errors import UsageError
from cvo_edge.files import write_whole

T = TypeVar("T")


def write_json(path: Path, content: object) -> None:
    """Write structs, mappings and lists as indented JSON, creating the folder if necessary.

    Raises SinkError.
    """
    text = msgspec.json.format(msgspec.json.encode(content), indent=1).decode()
    write_whole(path, text + "\n", make_folder=True)


def read_json(path: Path, kind: type[T], what: str) -> T:
    """Read a file that ``write_json`` wrote; raises UsageError if it does not hold ``what``."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise UsageError(f"{path}: expected {what}, found {error}") from None
    except OSError as error:
        raise UsageError(f"{path}: expected {what}; cannot be read: {error.strerror}") from None
