"""Folders of this user's that outlive a process."""

from __future__ import annotations

import os
from pathlib import Path

from cvo_edge.errors import UsageError


def own_folder(variable: str, base_variable: str, base: str) -> Path:
    """Return the folder that a variable names, else ``cvo-edge`` in the user's own of that kind.

    Parameters
    ----------
    variable
        Ours, e.g. ``CVO_EDGE_CACHE``.
    base_variable, base
        That of the XDG specification, e.g. ``XDG_CACHE_HOME``, and what it stands for if not set.

    Raises UsageError for a relative path in ``variable``: it would mean another folder everywhere.
    """
    named = os.environ.get(variable)
    if named:
        if not Path(named).is_absolute():
            raise UsageError(f"{variable}: expected an absolute path, found {named!r}")
        return Path(named)
    given = os.environ.get(base_variable, "")
    if Path(given).is_absolute():
        return Path(given) / "cvo-edge"
    try:
        return Path(base).expanduser() / "cvo-edge"
    except RuntimeError:
        # A user without a home: a folder that cannot be made.
        return Path(os.devnull) / "cvo-edge"
