"""The human-readable table: one line per frame, at most 80 columns wide."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable

from cvo_edge.estimate import PoseInterval
from cvo_edge.record import RecordedInterval

_COLUMNS, _NAME_COLUMNS = 80, 12
# Cell widths, including a leading blank: three for the position, six for half-widths.
_POSITION_CELLS, _HALF_CELLS = (8, 8, 7), (6,) * 6
_TO_CM_OR_DEG = (100.0,) * 3 + (math.degrees(1.0),) * 3
# All suffixes are removed: frame-000007.color.jpg becomes frame-000007.
_IMAGE_SUFFIXES = re.compile(r"(?<=.)(\.[A-Za-z][A-Za-z0-9]{0,5})+$")


def table_heading(estimate: PoseInterval) -> bytes:
    """Return the four heading lines: meaning of the numbers, names and units."""
    dof = estimate.chart.dof
    widths = (*_POSITION_CELLS, *_HALF_CELLS)
    names = _row((*dof[:3], *dof), widths)
    units = _row((*("m",) * 3, *("±cm",) * 3, *("±deg",) * 3), widths)
    level = f"{estimate.confidence:g} ({estimate.scope})"
    return (
        "Position and half the width of the interval of each degree of freedom,\n"
        f"confidence {level}. An interval may be off-centre; * has several pieces.\n"
        f"{'frame':<{_NAME_COLUMNS}} {'status':<8}{names}\n"
        f"{'':<{_NAME_COLUMNS}} {'':<8}{units}\n"
    ).encode()


def table_line(estimate: PoseInterval) -> bytes:
    """Return the line of a frame; without half-widths it shows the reasons instead."""
    record = estimate.to_record()
    line = f"{_short_name(record.source or str(record.seq))} {record.status:<8}"
    used = _NAME_COLUMNS + 1 + 8
    if record.pose is not None:
        numbers = zip(record.pose.t_m, _POSITION_CELLS, strict=True)
        line += _row((_fitted(value, 3, width - 1) for value, width in numbers), _POSITION_CELLS)
        used += sum(_POSITION_CELLS)
    if record.status == "ok" and record.interval is not None:
        line += _row(_half_widths(record.interval), _HALF_CELLS)
    else:
        line += f" {_listed(record.reasons, _COLUMNS - used - 1)}"
    return f"{line}\n".encode()


def _row(cells: Iterable[str], widths: Iterable[int]) -> str:
    return "".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))


def _half_widths(interval: RecordedInterval) -> list[str]:
    cells = []
    bounds = zip(interval.lower, interval.upper, _TO_CM_OR_DEG, _HALF_CELLS, strict=True)
    for dof, (low, high, scale, width) in enumerate(bounds):
        if low is None or high is None:
            cells.append("inf")
            continue
        mark = "*" if interval.bands and len(interval.bands[dof]) > 1 else ""
        half = 0.5 * scale * (high - low)
        decimals = 1 if half >= 1.0 else 2
        cells.append(f"±{_fitted(half, decimals, width - 2 - len(mark))}{mark}")
    return cells


def _fitted(value: float, decimals: int, room: int) -> str:
    """Format a number in at most ``room`` characters, with fewer decimals or an exponent."""
    for places in range(decimals, -1, -1):
        text = f"{value:.{places}f}"
        if len(text) <= room:
            return text
    for places in range(2, -1, -1):
        mantissa, _, exponent = f"{value:.{places}e}".partition("e")
        text = f"{mantissa}e{int(exponent)}"
        if len(text) <= room:
            break
    return text


def _listed(reasons: tuple[str, ...], room: int) -> str:
    """List as many reasons as fit into ``room`` characters, and the number of the others."""
    for shown in range(len(reasons), 0, -1):
        others = f" +{len(reasons) - shown}" if shown < len(reasons) else ""
        text = ", ".join(reasons[:shown]) + others
        if len(text) <= room:
            break
    else:
        text = ""
    return text


def _short_name(source: str) -> str:
    """Return the end of a frame's name without image suffixes, padded to its columns."""
    # A file name may contain terminal control sequences.
    name = "".join(c if c.isprintable() else "?" for c in source)
    kept, used = "", 0
    for character in reversed(_IMAGE_SUFFIXES.sub("", name)):
        used += _columns(character)
        if used > _NAME_COLUMNS:
            break
        kept = character + kept
    return kept + " " * (_NAME_COLUMNS - sum(map(_columns, kept)))


def _columns(character: str) -> int:
    """Return the number of terminal columns of a character."""
    if unicodedata.combining(character):
        return 0
    return 2 if unicodedata.east_asian_width(character) in "WF" else 1
