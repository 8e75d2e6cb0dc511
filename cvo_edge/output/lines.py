"""A text file or standard output that is written line by line, without buffering."""

from __future__ import annotations

import os
import select
import sys
from pathlib import Path
from typing import Self

from cvo_edge.errors import SinkError
from cvo_edge.files import check_output
from cvo_edge.output.named import Told, has_name, is_regular, lock, lost, reopenings
from cvo_edge.vocabulary import Existing

_BLOCK = 4096


class LineFile:
    """Writes whole lines, so that written ones survive a crash.

    Lines are appended: a file that another program truncates (copytruncate) goes on at its new end.

    Parameters
    ----------
    path
        Output file, or ``-`` for standard output.
    existing
        What happens to a file that exists. ``replace``: it is truncated when the first line is
        written, if it is one of this program; ``force``: any is; ``append``: it is kept but for an
        incomplete last line.
    told
        Called once if the file loses its name.

    Raises
    ------
    SinkError
        The file cannot be opened or, later, written. Complete lines are kept; an incomplete line is
        removed from a regular file.
    UsageError
        The file exists, and is none of this program.
    """

    def __init__(
        self,
        path: str,
        existing: Existing = "replace",
        told: Told | None = None,
    ) -> None:
        self._owned = path != "-"
        self._name = path if self._owned else "standard output"
        self._existing, self._told = existing, told
        self._started = False
        self._opened = reopenings()
        check_output(path, force=existing == "force")
        try:
            self._descriptor = _opened(path) if self._owned else sys.stdout.fileno()
        except OSError as error:
            raise SinkError(f"{self._name}: cannot be written: {error.strerror}") from None
        if not self._owned:
            return
        try:
            lock(self._descriptor, self._name)
        except SinkError:
            os.close(self._descriptor)
            raise

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file, if it is one."""
        if self._owned:
            os.close(self._descriptor)

    @property
    def started(self) -> bool:
        """Whether the file has a beginning; one that was emptied or opened again may have none."""
        self._open_again()
        if self._owned and self._started:
            size = os.fstat(self._descriptor).st_size
            self._started = size > 0 or not is_regular(self._descriptor)
        return self._started

    def write(self, line: bytes) -> None:
        """Write lines, each with its end.

        Raises SinkError if writing fails and BrokenPipeError if the reader closed the pipe.
        """
        if not (started := self.started):
            # Keep the old contents until the first new line is ready.
            self._make_room()
        elif self._owned:
            self._tell_of_a_lost_name()
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
                whole = line[:written].rfind(b"\n") + 1
                self._take_back(written - whole)
                self._started = started or whole > 0
                raise SinkError(f"{self._name}: cannot be written: {error.strerror}") from None
        self._started = True

    def _make_room(self) -> None:
        """Truncate a file that is replaced, or remove the incomplete last line of one that is not.

        A second writer is locked out.
        """
        if not self._owned or not is_regular(self._descriptor):
            return
        end = 0
        if self._existing == "append":
            end = _end_of_lines(self._name)
        os.ftruncate(self._descriptor, end)

    def _open_again(self) -> None:
        """Open the file by its name again if ``reopen_files`` was called."""
        if not self._owned or self._opened == reopenings():
            return
        asked = reopenings()
        try:
            descriptor = _opened(self._name)
        except OSError as error:
            raise SinkError(f"{self._name}: cannot be opened again: {error.strerror}") from None
        os.close(self._descriptor)
        self._descriptor = descriptor
        lock(self._descriptor, self._name)
        # Only now, so that a file that cannot be opened or locked yet is tried again.
        self._opened = asked

    def _tell_of_a_lost_name(self) -> None:
        if self._told is not None and not has_name(self._descriptor, self._name):
            self._told(lost(self._name))
            self._told = None

    def _take_back(self, written: int) -> None:
        """Remove an incomplete line from a regular file."""
        if not written or not is_regular(self._descriptor):
            return
        end = os.lseek(self._descriptor, 0, os.SEEK_CUR)
        # Truncate only if nothing follows the incomplete line.
        if end == os.fstat(self._descriptor).st_size:
            os.ftruncate(self._descriptor, end - written)
            os.lseek(self._descriptor, end - written, os.SEEK_SET)


def _opened(path: str) -> int:
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)


def _end_of_lines(path: str) -> int:
    """Return where the last complete line of a file ends."""
    with Path(path).open("rb") as stream:
        end = stream.seek(0, os.SEEK_END)
        while end > 0:
            begin = max(0, end - _BLOCK)
            stream.seek(begin)
            found = stream.read(end - begin).rfind(b"\n")
            if found >= 0:
                return begin + found + 1
            end = begin
    return 0
