"""Files from outside: regular ones, of a bounded size, or an error."""

from __future__ import annotations

import io
import os
import stat
from pathlib import Path

from cvo_edge.errors import CvoError


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
