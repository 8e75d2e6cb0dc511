"""Files under a name that one process writes, others rotate, and SIGHUP opens again."""

from __future__ import annotations

import fcntl
import os
import stat
from collections.abc import Callable
from typing import BinaryIO

from cvo_edge.errors import SinkError

# Set by SIGHUP: every file is opened again before what is written next.
_reopening = 0

Told = Callable[[str], None]


def reopen_files() -> None:
    """Have every file open its name again before it is written to.

    A log that was renamed (logrotate) is then followed by a new file.
    """
    global _reopening
    _reopening += 1


def reopenings() -> int:
    """Return how often ``reopen_files`` was called."""
    return _reopening


def is_regular(descriptor: int) -> bool:
    """Return whether a descriptor is that of a regular file."""
    return stat.S_ISREG(os.fstat(descriptor).st_mode)


def lock(descriptor: int, name: str) -> None:
    """Lock a regular file against a second writer; the lock ends with the process.

    Raises SinkError if another one has it.
    """
    if not is_regular(descriptor):
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise SinkError(
            f"{name}: another run is writing to this file; choose another output"
        ) from None
    except OSError:
        return  # the file system does not support locks


def opened_empty(path: str, *, buffering: int = -1) -> BinaryIO:
    """Open a file for writing, and empty it once it is locked; raises OSError and SinkError."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT, 0o666)
    try:
        lock(descriptor, path)
        if is_regular(descriptor):
            os.ftruncate(descriptor, 0)
        return os.fdopen(descriptor, "wb", buffering)
    except BaseException:
        os.close(descriptor)
        raise


def has_name(descriptor: int, name: str) -> bool:
    """Return whether a file is still the one under its name."""
    try:
        named = os.stat(name)  # noqa: PTH116 - before every line
    except OSError:
        return False
    found = os.fstat(descriptor)
    return (named.st_dev, named.st_ino) == (found.st_dev, found.st_ino)


def lost(name: str) -> str:
    """Return the line that tells of a lost name."""
    return f"{name}: was renamed or removed; records still go to that file. SIGHUP opens a new one"
