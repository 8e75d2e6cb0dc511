"""Text files with one record a line: columns, numbers, and which line a refusal is about."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.ground_truth import seconds_to_ns

Array = NDArray[np.float64]

_SHOWN = 80


class Row(NamedTuple):
    """One line of a file; ``form`` names the columns that it should have."""

    path: Path
    number: int
    fields: list[str]
    form: str

    def numbers(self, start: int = 0) -> Array:
        """Return the columns from ``start`` on, shape (n,); nan and inf are numbers, too."""
        try:
            return np.array(self.fields[start:], dtype=np.float64)
        except ValueError:
            raise self.refusal() from None

    def seconds(self) -> int:
        """Return the first column, a time in seconds, as integer nanoseconds."""
        try:
            return seconds_to_ns(self.fields[0])
        except ValueError:
            raise self.refusal() from None

    def nanoseconds(self) -> int:
        """Return the first column, a time in integer nanoseconds."""
        # 64 bits of them end in the year 2262.
        if not (self.fields[0].isdecimal() and len(self.fields[0]) <= 19):
            raise self.refusal()
        return int(self.fields[0])

    def refusal(self) -> SourceError:
        """Return the error that says what was expected in this line."""
        found = " ".join(self.fields)[:_SHOWN]
        return SourceError(
            f"{self.path}: expected {self.form}, found {found!r} in line {self.number}"
        )


def read_rows(
    path: Path,
    form: str,
    *,
    separator: str | None = None,
    comments: bool = True,
    more: bool = False,
) -> list[Row]:
    """Read a file whose lines have the columns that ``form`` names, separated by blanks.

    Parameters
    ----------
    path
        UTF-8 text; lines may end as on any system.
    form
        The columns' names, separated as the columns are.
    separator
        What separates columns instead of blanks.
    comments
        Whether blank lines and lines that begin with ``#`` are passed over. Where lines count as
        frames they are refused: only the end of the file may be blank.
    more
        Whether lines may have more columns; those are left out.

    Raises
    ------
    SourceError
        The file cannot be read, or a line has other columns.
    """
    width = len(form.split(separator))
    rows: list[Row] = []
    for number, line in enumerate(read_text(path, form).rstrip().splitlines(), start=1):
        if comments and (not line.strip() or line.lstrip().startswith("#")):
            continue
        fields = [field.strip() for field in line.split(separator)]
        row = Row(path, number, fields[:width] if more else fields, form)
        if len(row.fields) != width:
            raise row.refusal()
        rows.append(row)
    return rows


def read_text(path: Path, form: str) -> str:
    """Read a UTF-8 file; raises SourceError, saying that ``form`` was expected."""
    try:
        return path.read_text("utf-8-sig")
    except FileNotFoundError:
        found = "none"
    except OSError as error:
        found = f"that it cannot be read: {error.strerror}"
    except UnicodeDecodeError:
        found = "no UTF-8"
    raise SourceError(f"{path}: expected a file of {form}, found {found}")
