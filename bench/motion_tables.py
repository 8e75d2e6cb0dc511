"""The tables of ``results/motion`` for ``bench/tables.py``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from markdown_table import table
from provenance import read_result, result_files

FOLDER, FLEET = "motion", "fleet"


def results() -> list[dict[str, Any]]:
    """Return the results of all sets."""
    stems = [path.stem for path in result_files(FOLDER)]
    return [read_result(FOLDER, stem) for stem in stems if stem != FLEET]


def motion() -> str:
    """One row for each set and horizon: what holds on a drive that was left out."""
    return table(
        [
            "set", "horizon", "drives", "`mean`: each DoF, position, rotation", "worst drive",
            "width over plain: DoF, position, rotation", "hardest quarter: DoF, position, rotation",
            "`tolerance`: drives with 0.9 inside", "its width over `hierarchical`",
        ],
        [row(found, each) for found in results() for each in found["horizons"]],
    )  # fmt: skip


def row(found: dict[str, Any], horizon: dict[str, Any]) -> list[str]:
    """Return the cells of one horizon."""
    mean, tolerance = horizon["rules"]["mean"], horizon["rules"]["tolerance"]
    over = tolerance["over_hierarchical"]
    return [
        found["set"],
        horizon["horizon"],
        str(horizon["drives"]),
        three(mean["coverage_dof"], mean["coverage"]),
        f"{mean['least']:.2f}",
        three(horizon["over_plain_dof"], horizon["over_plain"]),
        three(horizon["hardest_dof"], horizon["hardest"]),
        f"{tolerance['share']:.2f}",
        "-" if over is None else f"{over:.2f}",
    ]


def three(dof: float, pair: list[float]) -> str:
    """Return the mean over degrees of freedom, then position and rotation."""
    return f"{dof:.3f}, {pair[0]:.3f}, {pair[1]:.3f}"


def tubes() -> str:
    """One row for each set and window."""
    return table(
        ["set", "window", "recordings", "whole windows inside: position, rotation, all six",
         "width over bands of single times: position, rotation, each DoF"],
        [
            [
                found["set"],
                each["window"],
                str(each["recordings"]),
                ", ".join(f"{share:.3f}" for share in each["inside"]),
                ", ".join(f"{ratio:.2f}" for ratio in each["over_bands"]),
            ]
            for found in results()
            for each in found["tubes"]
        ],
    )  # fmt: skip


def online() -> str:
    """One row for each horizon and delay, both sets side by side."""
    sets = results()
    by_set = [{(each["over"], each["delay_s"]): each for each in one["online"]} for one in sets]
    keys = dict.fromkeys(key for each in by_set for key in each)
    return table(
        ["horizon", "delay", *(f"{one['set']}: inside, worst drive, width" for one in sets)],
        [
            [
                over,
                f"{delay_s:g} s",
                *(
                    f"{each[over, delay_s]['inside']:.2f}, {each[over, delay_s]['worst']:.2f}, "
                    f"{each[over, delay_s]['width']:.2f} x (at most "
                    f"{each[over, delay_s]['widest']:.0f} x)"
                    if (over, delay_s) in each
                    else "-"
                    for each in by_set
                ),
            ]
            for over, delay_s in keys
        ],
    )


def alignment() -> str:
    """One row for each set: what the report finds, of itself and of faults that were put in."""
    rows = []
    for found in results():
        for kind, each in found["injected"].items():
            unit = kind.split()[1]
            rows.append(
                [
                    found["set"],
                    kind,
                    f"{each['largest_error']:.2g} {unit}",
                    f"{each['named']} of {each['of']}",
                ]
            )
    return table(["set", "put in", "largest error of what is found", "said to be worth it"], rows)


def costs() -> str:
    """One row for each set: processor time, memory and size."""
    return table(
        [
            "set",
            "poses",
            "`conformalize`, s",
            "MiB",
            "`annotate`, us a pose",
            "MiB",
            "`MotionTracker.step`, us",
            "file, bytes",
        ],
        [
            [
                found["set"],
                f"{found['costs']['poses']:,}",
                f"{found['costs']['conformalize_s']:.2f}",
                f"{found['costs']['conformalize_mib']:.0f}",
                f"{found['costs']['annotate_us']:.0f}",
                f"{found['costs']['annotate_mib']:.0f}",
                f"{found['costs']['step_us']:.0f}",
                f"{found['costs']['bytes']:,}",
            ]
            for found in results()
        ],
    )


def fleet() -> str:
    """One row for each engine: processor time and memory of many recordings."""
    found = read_result(FOLDER, FLEET)
    size = f"{found['recordings']:,} recordings, {found['poses']:,} poses"
    engines = {"local": "one process", "ray": "Ray, two workers, one of them killed"}
    return table(
        [size, "processor time, s", "of the process that merges, s", "its peak memory, MB"],
        [
            [
                engines[each["engine"]],
                f"{each['processor_s']:.0f}",
                f"{each['driver_processor_s']:.0f}",
                f"{each['peak_mb']:,.0f}",
            ]
            for each in found["runs"]
        ],
    )


TABLES: dict[str, Callable[[], str]] = {
    "motion": motion,
    "motion-alignment": alignment,
    "motion-tubes": tubes,
    "motion-online": online,
    "motion-costs": costs,
    "motion-fleet": fleet,
}
