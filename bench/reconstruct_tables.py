"""Table of ``results/reconstruct`` for ``bench/tables.py``."""

from __future__ import annotations

from collections.abc import Callable

from markdown_table import table
from provenance import read_result

# Result file -> what it reconstructs. Keys of a file that hold figures of a map are dictionaries.
RECORDINGS = {"redkitchen": "redkitchen", "tag": "room with a tag"}
HEAD = (
    *("recording", "placed", "median error", "differs from the first map", "scale off"),
    *("reprojection error", "seconds", "processor seconds", "load"),
)


def maps() -> str:
    """Return a row for each map."""
    rows = []
    for file, recording in RECORDINGS.items():
        for run, found in read_result("reconstruct", file).items():
            if not isinstance(found, dict) or "registered" not in found:
                continue
            apart, scale = found.get("apart_cm"), found["scale_error"]
            rows.append(
                [
                    f"{recording}: {run}",
                    f"{round(found['registered'] * found['images'])} of {found['images']}",
                    f"{found['median_error_cm']:.2f} cm",
                    f"{apart:.2f} cm" if apart and apart > 1e-6 else "",
                    "" if scale is None else f"{scale:+.2%}",
                    f"{found['reprojection_px']:.2f} px",
                    f"{found['seconds']:.0f}",
                    f"{found['processor_seconds']:.0f}",
                    f"{found['load_average'][1]:.0f}",
                ]
            )
    return table(HEAD, rows)


TABLES: dict[str, Callable[[], str]] = {"reconstruct": maps}
