"""Read text files with one record per line; errors name the line."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError
from cvo_edge.files import read_regular_file

Array = NDArray[np.float64]

_SHOWN = 80
_MAX_BYTES = 256 << 20

# 64 bits hold nanoseconds up to the year 2262. Larger numbers are stamps in a smaller unit.
_LAST_NS = 2**63 - 1


class Row(NamedTuple):
    """One line of a file; ``form`` names the expected columns."""

    path: Path
    number: int
    fields: list[str]
    form: str

    def numbers(self, start: int = 0) -> Array:
        """Return the columns from ``start`` on, shape (n,); nan and inf are accepted."""
        try:
            return np.array(self.fields[start:], dtype=np.float64)
        except ValueError:
            raise self.refusal() from None

    def seconds(self) -> int:
        """Return the first column, a time in seconds, as integer nanoseconds.

        Raises SourceError for other text, and for times that cannot be in seconds.
        """
        try:
            stamp_ns = seconds_to_ns(self.fields[0])
        except ValueError:
            raise self.refusal() from None
        if abs(stamp_ns) > _LAST_NS:
            found = f"found {self.fields[0][:_SHOWN]} in line {self.number}"
            raise SourceError(
                f"{self.path}: expected stamps in seconds, {found}; convert nanoseconds (or "
                "milliseconds) to seconds"
            )
        return stamp_ns

    def nanoseconds(self) -> int:
        """Return the first column, a time in integer nanoseconds."""
        digits = self.fields[0]
        if not (digits.isdecimal() and len(digits) <= 19 and int(digits) <= _LAST_NS):
            raise self.refusal()
        return int(self.fields[0])

    @property
    def where(self) -> str:
        """The file's name and the number of the line."""
        return f"{self.path.name}, line {self.number}"

    def refusal(self) -> SourceError:
        """Return an error that states what was expected in this line."""
        found = f"found {' '.join(self.fields)[:_SHOWN]!r} in line {self.number}"
        named = len(self.fields) > 1 and all(field.isidentifier() for field in self.fields)
        hint = "; put # before a line of names" if named else ""
        return SourceError(f"{self.path}: expected {self.form}, {found}{hint}")


def read_rows(
    path: Path,
    form: str,
    *,
    separator: str | None = None,
    comments: bool = True,
    more: bool = False,
) -> list[Row]:
    """Read a file whose lines have the columns that ``form`` names.

    Parameters
    ----------
    path
        UTF-8 text with any line endings.
    form
        Names of the columns, separated in the same way as the columns.
    separator
        Column separator; None separates by white space.
    comments
        Whether to skip blank lines and lines that begin with ``#``. If not, they are errors,
        except for blank lines at the end of the file; use this where line numbers are frames.
    more
        Whether lines may have more columns, which are ignored.

    Raises
    ------
    SourceError
        The file cannot be read, or a line has the wrong number of columns.
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
    """Read a UTF-8 file; raises SourceError, stating that ``form`` was expected."""
    if not os.path.exists(path):  # noqa: PTH110 - also of a name too long
        raise SourceError(f"{path}: expected a file of {form}, found none")
    try:
        return read_regular_file(path, _MAX_BYTES, SourceError, links=True).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SourceError(
            f"{path}: expected a file of {form}, found text that is not UTF-8"
        ) from None


def first_line(text: str) -> tuple[int, str]:
    """Return the first line that is no comment, after its number; 0 and no text without one."""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            return number, line.strip()
    return 0, ""


def seconds_to_ns(text: str) -> int:
    """Decimal seconds as text -> integer nanoseconds; raises ValueError if it is not a number."""
    seconds, _, fraction = text.partition(".")
    if seconds.isdecimal() and (fraction.isdecimal() or not fraction):
        # A double resolves present-day stamps only to 200 ns, so the digits are parsed.
        return int(seconds) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))
    try:
        return round(float(text) * 1e9)
    except OverflowError:
        raise ValueError(text) from None
