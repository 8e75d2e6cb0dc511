"""The tables of ``results/kills`` and ``results/covariances`` for ``bench/tables.py``."""

from __future__ import annotations

from collections.abc import Callable

from markdown_table import table
from provenance import read_result


def kills() -> str:
    """One row: what killed runs had confirmed, and what came back."""
    found = read_result("kills", "kills")
    cuts = "; ".join(f"{name}: {all_}, {bad} wrong" for name, (all_, bad) in found["cuts"].items())
    return table(
        [
            "kills", "before the first frame", "files torn within a record", "frames confirmed",
            "recovered", "lost", "recovered beyond those confirmed",
            "cuts at every byte of the last KiB",
        ],
        [
            [
                *(f"{found[key]:,}" for key in ("kills", "before_a_frame", "torn", "confirmed")),
                *(f"{found[key]:,}" for key in ("recovered", "lost", "others")),
                cuts,
            ]
        ],
    )  # fmt: skip


TABLES: dict[str, Callable[[], str]] = {"kills": kills}
