"""The tables of ``results/odometry`` for ``bench/tables.py``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from markdown_table import table
from provenance import read_result, result_files

FOLDER = "odometry"


def results() -> list[dict[str, Any]]:
    """Return the results of all sets."""
    return [read_result(FOLDER, path.stem) for path in result_files(FOLDER)]


def errors() -> str:
    """One row for each set: errors of single steps, and time."""
    return table(
        [
            "set", "images", "steps (lost)", "rotation, deg: median, p90",
            "direction, deg: median, p90", "without direction", "processor time, ms",
        ],
        [
            [
                found["set"],
                "{}x{}".format(*found["size"]),
                f"{found['steps']:,} ({found['lost']})",
                pair(found["rotation_deg"]),
                pair(found["direction_deg"]),
                f"{found['null_directions']:.1%}",
                f"{found['ms']:.1f}",
            ]
            for found in results()
        ],
    )  # fmt: skip


def pair(values: list[float] | None) -> str:
    """Return a median and a 90 % quantile."""
    return "-" if values is None else ", ".join(f"{value:.3g}" for value in values)


def parallax() -> str:
    """One row for each range of parallax, sets side by side."""
    sets = results()
    starts = sorted({each["from_px"] for found in sets for each in found["by_parallax"]})
    by_set = [{each["from_px"]: each for each in found["by_parallax"]} for found in sets]
    return table(
        ["parallax from, px", *(f"{found['set']}: deg (steps)" for found in sets)],
        [
            [
                f"{start:g}",
                *(
                    f"{each[start]['direction_deg']:.3g} ({each[start]['steps']})"
                    if start in each
                    else "-"
                    for each in by_set
                ),
            ]
            for start in starts
        ],
    )


def variants() -> str:
    """One row for each variant, sets side by side."""
    sets = results()
    return table(
        ["variant", *(f"{found['set']}: rotation; direction" for found in sets)],
        [
            [
                variant,
                *(
                    f"{pair(found['variants'][variant]['rotation_deg'])}; "
                    f"{pair(found['variants'][variant]['direction_deg'])}"
                    + (f" ({lost} lost)" if (lost := found["variants"][variant]["lost"]) else "")
                    for found in sets
                ),
            ]
            for variant in sets[0]["variants"]
        ],
    )


def intervals() -> str:
    """One row for each set and scale: coverage of one step on what was not calibrated on."""
    return table(
        [
            "set", "tested on", "`--scale`", "each DoF of rotation, radius", "direction",
            "radius, deg: rotation, direction", "withheld",
        ],
        [
            [
                found["set"],
                f"{each['recordings']} recordings" if found["recordings"] > 1 else "second half",
                each["scale"],
                f"{each['dof']:.3f}, {each['rotation']:.3f}",
                f"{each['direction']:.3f}",
                pair([each["rotation_deg"], each["direction_deg"]]),
                f"{each['withheld']:.0%}",
            ]
            for found in results()
            for each in found["intervals"]
        ],
    )  # fmt: skip


TABLES: dict[str, Callable[[], str]] = {
    "odometry": errors,
    "odometry-parallax": parallax,
    "odometry-variants": variants,
    "odometry-intervals": intervals,
}
