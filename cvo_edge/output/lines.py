"""A text file or standard output that is written line by line, without buffering."""

from __future__ import annotations

import fcntl
import os
import select
import stat
import sys
from types import TracebackType
from typing import Self

from cvo_edge.errors import SinkError


class LineFile:
    """Writes whole lines, so that written ones survive a crash.

    Parameters
    ----------
    path
        Output file, truncated when the first line is written, or ``-`` for standard output.

    Raises
    ------
    SinkError
        The file cannot be opened or, later, written. Complete lines are kept; an incomplete line is
        removed from a regular file.
    """

    def __init__(self, path: str) -> None:
        self._owned = path != "-"
        self._name = path if self._owned else "standard output"
        self._started = False
        try:
            self._descriptor = (
                os.open(path, os.O_WRONLY | os.O_CREAT, 0o666)
                if self._owned
                else sys.stdout.fileno()
            )
            self._alone()
        except OSError as error:
            raise SinkError(f"{self._name}: cannot be written: {error.strerror}") from None

    def _alone(self) -> None:
        """Lock a regular file against a second writer; the lock ends with the process."""
        if not self._owned or not stat.S_ISREG(os.fstat(self._descriptor).st_mode):
            return
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._descriptor)
            raise SinkError(
                f"{self._name}: another run is writing to this file; choose another output"
            ) from None
        except OSError:
            return  # the file system does not support locks

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the file, if it is one."""
        if self._owned:
            os.close(self._descriptor)

    @property
    def started(self) -> bool:
        """Whether anything was written."""
        return self._started

    def write(self, line: bytes) -> None:
        """Write lines, each with its end.

        Raises SinkError if writing fails and BrokenPipeError if the reader closed the pipe.
        """
        if not self._started:
            self._started = True
            # Keep the old contents until the first new line is ready.
            if self._owned and stat.S_ISREG(os.fstat(self._descriptor).st_mode):
                os.ftruncate(self._descriptor, 0)
        written = 0
        while written < len(line):
            try:
                written += os.write(self._descriptor, line[written:] if written else line)
            except BrokenPipeError:
                raise
            except BlockingIOError:
                # Another process made this pipe non-blocking; wait until it accepts data.
                reader = select.poll()
                reader.register(self._descriptor, select.POLLOUT)
                reader.poll()
            except OSError as error:
                self._take_back(written - (line[:written].rfind(b"\n") + 1))
                raise SinkError(f"{self._name}: cannot be written: {error.strerror}") from None

    def _take_back(self, written: int) -> None:
        """Remove an incomplete line from a regular file."""
        found = os.fstat(self._descriptor)
        if not written or not stat.S_ISREG(found.st_mode):
            return
        end = os.lseek(self._descriptor, 0, os.SEEK_CUR)
        # Truncate only if nothing follows the incomplete line.
        if end == found.st_size:
            os.ftruncate(self._descriptor, end - written)
            os.lseek(self._descriptor, end - written, os.SEEK_SET)
