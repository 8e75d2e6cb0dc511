"""Figures of a method's cells as text: medians over the seeds, for all tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from cvo_export.study.cell import Cell, Figures

# Shown for a figure that a cell does not have.
BLANK = "-"


def sets_shown(figures: Sequence[Figures]) -> tuple[str, str, str, str]:
    """Coverage, coverage of all six, mean width, and score, with the score of each seed."""
    scores = [entry.normalised_interval_score for entry in figures]
    each = f" ({', '.join(f'{score:.3f}' for score in scores)})" if len(scores) > 1 else ""
    return (
        f"{median(entry.mean_coverage for entry in figures):.3f}",
        f"{median(entry.joint_coverage for entry in figures):.3f}",
        f"{100 * median(entry.mean_width.m for entry in figures):.2f} cm "
        f"{median(entry.mean_width.deg for entry in figures):.2f} deg",
        f"{median(scores):.3f}{each}",
    )


def own_shown(cells: Sequence[Cell]) -> tuple[str, str, str, str] | None:
    """See ``sets_shown``; uses the networks' own bounds, None if they have none."""
    own = [cell.own for cell in cells if cell.own is not None]
    return sets_shown(own) if own else None


def joint_shown(cells: Sequence[Cell]) -> tuple[str, str]:
    """Coverage of the joint sets, and the edge of a cube of their volume, in deviations."""
    volume = median(cell.joint_volume["geometric_mean"] for cell in cells)
    coverage = median(cell.joint.joint_coverage for cell in cells)
    return f"{coverage:.3f}", f"{volume ** (1 / 6):.3f}"


def error_shown(errors: Iterable[Mapping[str, float]]) -> str:
    """Median error of the point: position and angle."""
    found = list(errors)
    return (
        f"{100 * median(error['median_m'] for error in found):.2f} cm "
        f"{median(error['median_deg'] for error in found):.2f} deg"
    )


def adaptiveness_shown(cells: Sequence[Cell], key: str) -> str:
    """``width_ratio`` or ``rank_correlation``."""
    found = [value for cell in cells if (value := cell.adaptiveness[key]) is not None]
    return f"{median(found):.2f}" if found else BLANK


def pieces_shown(cells: Sequence[Cell]) -> str:
    """Share of the sets that are in pieces."""
    found = [cell.pieces for cell in cells if cell.pieces is not None]
    return f"{100 * median(found):.1f} %" if found else "none"


def seconds_shown(cells: Sequence[Cell]) -> str:
    """Processor seconds of training, over the cells whose time is known."""
    found = [cell.training.processor for cell in cells if cell.training is not None]
    return f"{median(found):.0f}" if found else BLANK


def median(values: Iterable[float]) -> float:
    """Median; NaN if there are no values."""
    found = list(values)
    return float(np.median(found)) if found else float("nan")
