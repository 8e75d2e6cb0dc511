"""Read text files with one record per line; errors name the line."""

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
        """Return the first column, a time in seconds, as integer nanoseconds."""
        try:
            return seconds_to_ns(self.fields[0])
        except ValueError:
            raise self.refusal() from None

    def nanoseconds(self) -> int:
        """Return the first column, a time in integer nanoseconds."""
        # 19 digits are the most that fit into 64 bits.
        if not (self.fields[0].isdecimal() and len(self.fields[0]) <= 19):
            raise self.refusal()
        return int(self.fields[0])

    def refusal(self) -> SourceError:
        """Return an error that states what was expected in this line."""
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
    try:
        return path.read_text("utf-8-sig")
    except FileNotFoundError:
        problem = "found none"
    except OSError as error:
        problem = f"but it cannot be read: {error.strerror}"
    except UnicodeDecodeError:
        problem = "found text that is not UTF-8"
    raise SourceError(f"{path}: expected a file of {form}, {problem}")
