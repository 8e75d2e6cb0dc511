"""What callers of the Python API give: paths and numbers of any type that means them."""

from __future__ import annotations

import os
from operator import index
from pathlib import Path
from typing import SupportsIndex

from cvo_edge.errors import UsageError

_SHOWN = 80


def given_path(given: object, what: str) -> Path:
    """Return a path from text or a path; raises UsageError."""
    if not isinstance(given, str | os.PathLike):
        raise UsageError(f"{what}: expected a path, found {_shown(given)}")
    return Path(given)


def given_source(given: object) -> str:
    """Return the text of a source from a path, an address or a camera index; raises UsageError."""
    if isinstance(given, SupportsIndex) and not isinstance(given, bool):
        return str(index(given))
    if not isinstance(given, str | os.PathLike):
        raise UsageError(
            f"source: expected a path, an address or a camera index, found {_shown(given)}"
        )
    return os.fspath(given)


def given_number(given: object, what: str) -> float:
    """Return a number of Python, numpy or text as a float; raises UsageError."""
    try:
        return float(given)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{what}: expected a number, found {_shown(given)}") from None


def given_count(given: object, what: str) -> int:
    """Return an integer of Python or numpy; raises UsageError for anything else."""
    try:
        return index(given)  # type: ignore[arg-type]
    except TypeError:
        raise UsageError(f"{what}: expected an integer, found {_shown(given)}") from None


def _shown(given: object) -> str:
    text = repr(given)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."
