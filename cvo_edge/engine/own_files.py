"""Files that nobody but this user and root may write to: content, digests and identity."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from msgspec import Struct

from cvo_edge.files import untrusted

# Fits into the private cache of a core.
_CHUNK_BYTES = 1 << 20


class FileIdentity(Struct, frozen=True, array_like=True):
    """File metadata that reveals a change; ``ctime_ns`` advances with every change."""

    device: int
    inode: int
    size: int
    mtime_ns: int
    ctime_ns: int


def identity(path: Path) -> FileIdentity | None:
    """Return the metadata of a regular file, or None if it is missing or not regular."""
    try:
        found = path.lstat()
    except OSError:
        return None
    if not stat.S_ISREG(found.st_mode):
        return None
    return FileIdentity(
        found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
    )


def _opened(path: Path) -> io.FileIO:
    """Open a regular file that others cannot write to, without following links or waiting."""
    stream = io.FileIO(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK))
    found = os.fstat(stream.fileno())
    if stat.S_ISREG(found.st_mode) and not untrusted(found):
        return stream
    stream.close()
    if stat.S_ISREG(found.st_mode):
        raise not_ours(path)
    raise FileNotFoundError(errno.ENOENT, "expected a regular file", str(path))


def not_ours(path: Path) -> PermissionError:
    """Return the error for a file that is not this user's or root's alone."""
    return PermissionError(errno.EPERM, "other users may write to it", str(path))


def content(path: Path) -> bytes:
    """Return the bytes of a regular file that others cannot write to; raises OSError."""
    with _opened(path) as stream:
        return stream.read()


def file_digests(path: Path) -> list[str]:
    """Return the sha256 of each MiB of a file, using all cores in parallel; raises OSError."""
    with _opened(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        workers = os.cpu_count() or 1

        def digests(first: int) -> dict[int, str]:
            buffer = memoryview(bytearray(_CHUNK_BYTES))
            return {
                offset: hashlib.sha256(
                    buffer[: os.preadv(stream.fileno(), [buffer], offset)]
                ).hexdigest()
                for offset in range(first * _CHUNK_BYTES, size, workers * _CHUNK_BYTES)
            }

        found: dict[int, str] = {}
        with ThreadPoolExecutor(workers) as pool:
            for part in pool.map(digests, range(workers)):
                found |= part
    return [found[offset] for offset in sorted(found)]
