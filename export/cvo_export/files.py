"""Result files: written whole or not at all, read strictly."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TypeVar

import msgspec

from cvo_edge.errors import SinkError, UsageError

T = TypeVar("T")


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, making its folder; raises SinkError."""
    unfinished = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Not what lies there already: it may be a link to elsewhere.
        with unfinished.open("xb") as stream:
            stream.write(content.encode() if isinstance(content, str) else content)
        unfinished.replace(path)
    except OSError as error:
        if not isinstance(error, FileExistsError):
            unfinished.unlink(missing_ok=True)
        raise SinkError(f"{path}: cannot be written: {error.strerror}") from None


def write_json(path: Path, content: object) -> None:
    """Write structs, mappings and lists as indented JSON; raises SinkError."""
    write_whole(path, msgspec.json.format(msgspec.json.encode(content), indent=1).decode() + "\n")


def read_json(path: Path, kind: type[T], what: str) -> T:
    """Read what ``write_json`` wrote; raises UsageError where it is not ``what`` it should be."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise UsageError(f"{path}: expected {what}, found {error}") from None
    except OSError as error:
        raise UsageError(f"{path}: expected {what}, found none: {error.strerror}") from None
