"""The tables of ``results/kills`` and ``results/covariances`` for ``bench/tables.py``."""

from __future__ import annotations

from collections.abc import Callable

from markdown_table import table
from provenance import read_result

FOLDER = "covariances"
METHODS = ("scr", "cjp", "cqr", "csp", "mcqr")
SETS = ("euroc_vio", "kitti_lidar")


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


def covariances() -> str:
    """One row for each method and scope: NEES before and now, and differences from samples."""
    rows = []
    for method in METHODS:
        for found in read_result(FOLDER, method)["rows"]:
            errors = [max(pair[place] for pair in found["error"].values()) for place in (0, 1)]
            before, now = (
                f"{found[when]['nees']:.2f}, {found[when]['inside']:.2f}"
                for when in ("before", "now")
            )
            largest = [f"{100 * each:.2g} %" for each in errors]
            rows.append([f"`{method}`", found["scope"], before, now, *largest])
    return table(
        [
            "method", "scope", "diagonal of the set's numbers, pasted: NEES / 6, inside 0.9",
            "`covariance()`: NEES / 6, inside 0.9", "largest difference from samples",
            "of sets a tenth as wide",
        ],
        rows,
    )  # fmt: skip


def motions() -> str:
    """One row for each covariance and time, both public sets side by side."""
    by_set = {
        name: {
            (each["covariance"], each["over"]): each for each in read_result(FOLDER, name)["nees"]
        }
        for name in SETS
    }
    keys = dict.fromkeys(key for each in by_set.values() for key in each)
    return table(
        ["covariance", "over", *(f"{name}: NEES / 6 (median), inside" for name in SETS)],
        [
            [
                *key,
                *(
                    f"{each[key]['nees']:.2f} ({each[key]['nees_median']:.2f}), "
                    f"{each[key]['inside']:.2f}"
                    if key in each
                    else "-"
                    for each in by_set.values()
                ),
            ]
            for key in sorted(keys, key=lambda key: key[0] == "integrated")
        ],
    )


TABLES: dict[str, Callable[[], str]] = {
    "kills": kills,
    "covariances": covariances,
    "motion-covariances": motions,
}
