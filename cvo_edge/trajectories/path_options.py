"""Divide a path from the options behind it."""

from __future__ import annotations

import os
from collections.abc import Sequence

from cvo_edge.errors import UsageError


def path_options(kind: str, text: str, known: Sequence[str]) -> tuple[str, dict[str, str]]:
    """Divide ``PATH,option=value...``; an existing path is one as a whole, with its commas.

    Raises UsageError, which begins with ``kind``, for unknown and repeated options.
    """
    if os.path.exists(text):  # noqa: PTH110 - also of a name too long
        return text, {}
    place, *items = text.split(",")
    return place, read_options(f"{kind}: expected PATH and", items, known)


def read_options(before: str, items: Sequence[str], known: Sequence[str]) -> dict[str, str]:
    """Return the values of ``option=value`` items, by option.

    Raises UsageError, which begins with ``before``, for unknown, empty and repeated options.
    """
    options: dict[str, str] = {}
    for item in items:
        name, _, value = item.partition("=")
        if name not in known or not value or name in options:
            raise UsageError(
                f"{before} any of {', '.join(f'{each}=' for each in known)} once, found {item!r}"
            )
        options[name] = value
    return options
