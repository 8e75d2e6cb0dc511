"""The errors of one recording at one horizon, with the numbers that they are predicted from."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.motion.horizons import Horizon, starts_of
from cvo_edge.motion.relative import motion, residual
from cvo_edge.motion.trace import RECENT, Rows, motion_numbers, scale_numbers

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


class Errors(NamedTuple):
    """Motions of a recording over one horizon; m motions, those whose truth is known.

    Attributes
    ----------
    end
        Shape (m,): the row of the pose at which each motion ends.
    numbers, sizes
        Shape (m, 24) and (m, k): see ``trace.motion_numbers`` and ``trace.scale_numbers``.
    residuals
        Shape (m, 6): see ``relative.residual``; the first three are of ``translation``, if
        ``errors_of`` was given it, and NaN where that knows no direction.
    """

    end: Integers
    numbers: Array
    sizes: Array
    residuals: Array


def motions(
    rows: Rows, horizon: Horizon, ends: Integers | None = None
) -> tuple[Integers, Integers, Integers]:
    """Return start, end and recent row (see ``scale_numbers``) of motions over a horizon.

    ``ends``: the rows at which they may end; default: all.
    """
    every = np.arange(len(rows.part)) if ends is None else ends
    start = starts_of(horizon, rows.stamps_ns, rows.path_m, rows.part, every)
    found = start >= 0
    end = every[found]
    return start[found], end, recent_rows(rows, end)


def recent_rows(rows: Rows, ends: Integers) -> Integers:
    """Return for each of some rows the first one of its part that is at most a second older."""
    since = np.searchsorted(rows.stamps_ns, rows.stamps_ns[ends] - round(1e9 * RECENT.value))
    return np.maximum(since, np.searchsorted(rows.part, rows.part[ends]))


def errors_of(
    rows: Rows,
    truth: Array,
    horizon: Horizon,
    translation: Callable[[Array, Array], Array] | None = None,
) -> Errors:
    """Return the errors over a horizon; ``truth`` (n, 7) is NaN where it is not known.

    ``translation`` gives the first residual, in place of three, by estimated and true motions.
    """
    start, end, recent = motions(rows, horizon)
    known = np.isfinite(truth[start]).all(axis=1) & np.isfinite(truth[end]).all(axis=1)
    start, end, recent = start[known], end[known], recent[known]
    moved, numbers = motion_numbers(rows, start, end)
    sizes = scale_numbers(rows, start, end, recent)
    true = motion(truth[start], truth[end])
    off = residual(moved, true)
    if translation is not None:
        off[:, :3] = 0.0
        off[:, 0] = translation(moved, true)
    return Errors(end, numbers, sizes, off)
