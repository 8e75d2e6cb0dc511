"""Files: reading those from outside within bounds, writing whole or not at all, own folders."""

from __future__ import annotations

import io
import os
import stat
import sys
from pathlib import Path

from cvo_edge.errors import CvoError, SinkError, UsageError


def regular_file(
    path: Path, limit: int, error: type[CvoError], *, links: bool = False
) -> io.BufferedReader:
    """Open a regular file of at most ``limit`` bytes; else raise the error.

    Links are followed where ``links`` says so. Nothing else is opened, or waited for.
    """
    # O_NONBLOCK: opening a FIFO that nobody writes to must not hang before fstat refuses it.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)
    if not links:
        flags |= getattr(os, "O_NOFOLLOW", 0)
    try:
        descriptor = os.open(path, flags)
    except FileNotFoundError:
        raise error(f"{path}: expected a file, found none") from None
    except OSError as failure:
        raise error(f"{path}: expected a readable regular file: {failure.strerror}") from None
    stream = os.fdopen(descriptor, "rb")
    found = os.fstat(descriptor)
    if stat.S_ISREG(found.st_mode) and found.st_size <= limit:
        return stream
    stream.close()
    if stat.S_ISREG(found.st_mode):
        raise error(f"{path}: expected at most {limit} bytes, found {found.st_size}")
    raise error(f"{path}: expected a regular file, found another kind")


def read_regular_file(
    path: Path, limit: int, error: type[CvoError], *, links: bool = False
) -> bytes:
    """All bytes of a regular file, as ``regular_file`` opens it."""
    with regular_file(path, limit, error, links=links) as stream:
        try:
            # Room for as much as it had is made faster than for as much as it may have.
            size = min(os.fstat(stream.fileno()).st_size, limit)
            content = stream.read(size + 1)
            if len(content) > size:
                content += stream.read(limit + 1 - len(content))
        except OSError as failure:
            raise error(f"{path}: cannot be read: {failure.strerror}") from None
        except MemoryError:
            raise error(f"{path}: expected memory for all of it, found none") from None
    if len(content) > limit:
        raise error(f"{path}: expected at most {limit} bytes, found more")
    return content


def write_text(target: str, text: str) -> None:
    """Write text to a file, or to standard output for ``-``; raises SinkError."""
    if target == "-":
        sys.stdout.write(text)
        return
    try:
        Path(target).write_text(text, "utf-8")
    except OSError as error:
        raise SinkError(f"{target}: cannot be written: {error.strerror}") from None


def own_folder(variable: str, base_variable: str, base: str) -> Path:
    """Return the folder that a variable names, else ``cvo-edge`` in the user's own of that kind.

    Parameters
    ----------
    variable
        Ours, e.g. ``CVO_EDGE_CACHE``.
    base_variable, base
        That of the XDG specification, e.g. ``XDG_CACHE_HOME``, and what it stands for if not set.

    Raises UsageError for a relative path in ``variable``: it would mean another folder everywhere.
    """
    named = os.environ.get(variable)
    if named:
        if not Path(named).is_absolute():
            raise UsageError(f"{variable}: expected an absolute path, found {named!r}")
        return Path(named)
    given = os.environ.get(base_variable, "")
    if Path(given).is_absolute():
        return Path(given) / "cvo-edge"
    try:
        return Path(base).expanduser() / "cvo-edge"
    except RuntimeError:
        # A user without a home: a folder that cannot be made.
        return Path(os.devnull) / "cvo-edge"
