"""The table of ``results/recordings`` for ``bench/tables.py``: recordings of every kind."""

from __future__ import annotations

from typing import Any

import numpy as np
from markdown_table import table
from provenance import read_result, result_files

from cvo_edge.vocabulary import Scope

FOLDER = "recordings"
CASES = (
    *("redkitchen-400", "redkitchen-400-utm", "redkitchen-400-random"),
    *("euroc-mh05", "euroc-mh05-random", "kitti-00", "kitti-00-random"),
    *("room", "room-full-turn", "room-planar", "room-never-turns"),
    "street",
)
DOF = ("tx", "ty", "tz", "rx", "ry", "rz")


def recordings() -> str:
    """One row for each recording and method; the figure of the same data unchanged beside it."""
    found = [read_result(FOLDER, path.stem) for path in result_files(FOLDER)]
    found.sort(key=lambda each: CASES.index(each["case"]))
    return table(
        [
            "recording", "frames: train, cal, test", "method", "median error", "mean pose",
            "coverage at 0.9 per DoF", "joint scope: all six", "median width", "`run`: `ok`",
        ],
        [row(each) for each in found],
    )  # fmt: skip


def row(found: dict[str, Any]) -> list[str]:
    """Return the cells of one result."""
    evaluation, counts = found["evaluation"], found["frames_by_role"]
    moving = [dof for dof in range(6) if DOF[dof] not in evaluation["still"]]
    marginal, joint = (level(evaluation, scope) for scope in ("marginal", "joint"))
    coverage = [marginal["coverage"][dof] for dof in moving]
    width = np.array(marginal["median_width"])
    return [
        found["case"],
        ", ".join(str(counts[role]) for role in ("train", "cal", "test")),
        evaluation["method"],
        error(evaluation["point_error"]),
        error(evaluation["mean_pose_error"]),
        f"{np.mean(coverage):.2f}; {min(coverage):.2f} to {max(coverage):.2f}",
        f"{joint['joint_coverage']:.2f}",
        f"{length(mean_of(width, moving, (0, 1, 2)))}, "
        f"{np.rad2deg(mean_of(width, moving, (3, 4, 5))):.3g} deg",
        f"{found['run']['ok']:.2f}",
    ]


def level(evaluation: dict[str, Any], scope: Scope) -> dict[str, Any]:
    """Return the figures of a scope at 0.9."""
    entries: list[dict[str, Any]] = evaluation["levels"]
    return next(one for one in entries if one["confidence"] == 0.9 and one["scope"] == scope)


def mean_of(width: np.ndarray, moving: list[int], kind: tuple[int, ...]) -> float:
    """Return the mean over the DoF of a kind that move; over all of it if none does."""
    return float(width[[dof for dof in kind if dof in moving] or list(kind)].mean())


def error(median: dict[str, float]) -> str:
    """Return a position's and a rotation's median error."""
    metres, degrees = (
        next(value for name, value in median.items() if name in names)
        for names in (("median_m", "position_m"), ("median_deg", "rotation_deg"))
    )
    return f"{length(metres)}, {degrees:.2f} deg"


def length(value_m: float) -> str:
    """Return centimetres below a metre, else metres."""
    return f"{100 * value_m:.1f} cm" if value_m < 1.0 else f"{value_m:.2f} m"


TABLES = {"recordings": recordings}
