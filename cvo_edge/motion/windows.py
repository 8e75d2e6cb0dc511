"""Tubes: a radius around the estimate that grows from an anchor on, and holds the whole window.

Intervals of single horizons hold at one time each; all at once they hold far less often. A tube
belongs to a window of seconds or metres after an anchor, a pose that is known. With the residual x
of the motion from the anchor to each later pose, at the distance d along the window, the score of
an anchor is the largest ratio

    max over poses of  |t(x)| / r(d)      (position; |Log R| for rotation)

where the profile r(d) is the error that 90 % of motions over d do not exceed, raised near the
anchor: r(d) = q(d) (d / D)^-1/5 for a window D. There, where errors are small, width costs little,
and the tube is narrower where it is wide. Thresholds on the score follow as for horizons.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.relative import between
from cvo_edge.motion.thresholds import Scores
from cvo_edge.motion.trace import Rows
from cvo_edge.spread import Spread

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Places along a window at which the profile is stored.
KNOTS = 16
_ANCHORS = 20
_RAISED = 0.2
_LEVEL = 0.9
_LEAST = 1e-9
# So many motions are in the processor's cache at once.
_AT_ONCE = 4096


class Window(NamedTuple):
    """The errors after each anchor of a recording.

    Attributes
    ----------
    anchor
        Shape (m,): which anchor each error belongs to, ascending.
    along
        Shape (m,): how far after it, in the window's unit.
    errors
        Shape (m, 2): position (m) and rotation (rad).
    """

    anchor: Integers
    along: Array
    errors: Array


def window_errors(rows: Rows, truth: Array, window: Horizon) -> Window:
    """Return the errors after anchors a twentieth of a window apart, of windows that are whole.

    A window ends where the trajectory breaks, and is whole if it reaches its end before that.
    """
    along = window.along(rows.stamps_ns, rows.path_m)
    apart = window.value / _ANCHORS
    first = np.unique(np.searchsorted(along, np.arange(along[0], along[-1], apart)))
    last = np.searchsorted(along, along[first] + window.value, side="right")
    inside = last < len(along)
    first, last = first[inside], last[inside]
    known = np.asarray(np.isfinite(truth).all(axis=1))
    whole = (rows.part[first] == rows.part[last]) & known[first]
    first, last = first[whole], last[whole]
    counts = last - first
    anchor = np.repeat(np.arange(len(first)), counts)
    # 1, 2, ... counts after each anchor.
    steps = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    start = np.repeat(first, counts)
    end = start + steps
    errors = _sizes(rows.poses, truth, start, end)
    fine = np.isfinite(errors).all(axis=1) & (along[end] - along[start] <= window.value)
    _, anchor = np.unique(anchor[fine], return_inverse=True)
    return Window(anchor, (along[end] - along[start])[fine], errors[fine])


def _sizes(estimate: Array, truth: Array, start: Integers, end: Integers) -> Array:
    """Return position error and angle (m, 2) of motions between poses (n, 7), NaN if unknown."""
    found = np.empty((len(start), 2))
    own, true = np.ascontiguousarray(estimate.T), np.ascontiguousarray(truth.T)
    for first in range(0, len(start), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        a, b = start[some], end[some]
        x, y, z, p, q, r, s = between(
            between(own[:, a], own[:, b]), between(true[:, a], true[:, b])
        )
        found[some, 0] = np.sqrt(x * x + y * y + z * z)
        found[some, 1] = 2.0 * np.arctan2(np.sqrt(p * p + q * q + r * r), np.abs(s))
    return found


def anchors_of(window: Window) -> int:
    """Return the number of anchors."""
    return int(window.anchor[-1]) + 1 if len(window.anchor) else 0


def knots_of(window: Horizon) -> Array:
    """Return the places (KNOTS,) of a window's profile, close together near the anchor."""
    return window.value * np.linspace(0.0, 1.0, KNOTS + 1)[1:] ** 2


def profile_of(window: Horizon, recordings: Spread[Window], groups: Sequence[str]) -> Array:
    """Return the profile (KNOTS, 2) of position and rotation, ascending."""
    knots = knots_of(window)
    edges = np.concatenate([[0.0], 0.5 * (knots[1:] + knots[:-1]), [np.inf]])
    profile = np.zeros((KNOTS, 2))
    for index in range(KNOTS):
        between = partial(_between, low=float(edges[index]), high=float(edges[index + 1]))
        near = recordings.map(between).collect()
        used = [place for place, each in enumerate(near) if len(each)]
        if used:
            scores = Scores([near[place] for place in used], [groups[place] for place in used])
            profile[index] = scores.thresholds("mean", _LEVEL)
    raised = np.maximum.accumulate(profile, axis=0) * (knots / window.value)[:, None] ** -_RAISED
    return np.maximum(np.maximum.accumulate(raised, axis=0), _LEAST)


def _between(window: Window, low: float, high: float) -> Array:
    """Return the errors (m, 2) at distances from an anchor above ``low`` and up to ``high``."""
    return window.errors[(low < window.along) & (window.along <= high)]


def radii(knots: Array, profile: Array, along: Array) -> Array:
    """Return the profile at distances (m,), (m, 2): linear between knots, flat before the first."""
    return np.stack([np.interp(along, knots, column) for column in profile.T], axis=1)


def window_scores(window: Window, knots: Array, profile: Array) -> Array:
    """Return the score of each anchor, (anchors, 2)."""
    ratio = window.errors / radii(knots, profile, window.along)
    begin = np.flatnonzero(np.diff(window.anchor, prepend=-1))
    return np.asarray(np.maximum.reduceat(ratio, begin, axis=0))
