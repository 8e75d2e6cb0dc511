"""Tubes: bounds around the estimate from an anchor on that hold the whole window.

Intervals of single horizons hold at one time each; all at once they hold far less often. A tube
belongs to a window of seconds or metres after an anchor, a pose that is known. With the residual x
of the motion from the anchor to each later pose, at the distance d along the window, each of the
six degrees of freedom and the two norms has a score

    s = max over poses of  |x| / u,    u = exp(U (1, v)) max(d / D, 1 / 32)^-1/5

where the numbers v (``trace.tube_numbers``) are the means of speed, turn rate and their changes
since the anchor, and how long it is ago in seconds and metres. The last factor raises the tube
near its anchor: there, where errors are small, width costs little, and the tube is narrower where
it is wide. Thresholds on scores follow as for horizons; that of all six degrees of freedom at once
is on the largest of their scores, each over its own threshold.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.relative import between, rotation_vectors
from cvo_edge.motion.trace import Rows, tube_numbers

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Anchors a window.
ANCHORS = 20
# So many motions are in the processor's cache at once.
_AT_ONCE = 4096
_RAISED = 0.2
_NEAREST = 1.0 / 32.0


class Window(NamedTuple):
    """The errors after each anchor of a recording.

    Attributes
    ----------
    anchor
        Shape (m,): which anchor each error belongs to, ascending from 0.
    along
        Shape (m,): how far after it, in the window's unit.
    errors
        Shape (m, 8): sizes of the six degrees of freedom, position (m) and rotation (rad).
    numbers
        Shape (k, m): see ``trace.tube_numbers``.
    """

    anchor: Integers
    along: Array
    errors: Array
    numbers: Array

    @property
    def begin(self) -> Integers:
        """Where the errors of each anchor begin, (anchors,)."""
        return np.flatnonzero(np.diff(self.anchor, prepend=-1))

    @property
    def shares(self) -> Array:
        """What share of its window each error stands for, (m,)."""
        steps = np.diff(self.along, prepend=0.0)
        begin = self.begin
        steps[begin] = self.along[begin]
        return np.asarray(steps / np.maximum(np.add.reduceat(steps, begin), 1e-12)[self.anchor])


def window_errors(rows: Rows, truth: Array, window: Horizon, anchors: int = ANCHORS) -> Window:
    """Return the errors after anchors, so many a window, of windows that are whole.

    A window ends where the trajectory breaks, and is whole if it reaches its end before that.
    """
    along = window.along(rows.stamps_ns, rows.path_m)
    apart = window.value / anchors
    first = np.unique(np.searchsorted(along, np.arange(along[0], along[-1], apart)))
    last = np.searchsorted(along, along[first] + window.value, side="right")
    inside = last < len(along)
    first, last = first[inside], last[inside]
    known = np.asarray(np.isfinite(truth).all(axis=1))
    whole = (rows.part[first] == rows.part[last]) & known[first]
    first, last = first[whole], last[whole]
    counts = last - first
    # 1, 2, ... counts after each anchor.
    steps = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    start = np.repeat(first, counts)
    end = start + steps
    fine = known[end] & (along[end] - along[start] <= window.value)
    start, end = start[fine], end[fine]
    _, anchor = np.unique(start, return_inverse=True)
    errors = _sizes(rows.poses, truth, start, end)
    return Window(anchor, along[end] - along[start], errors, tube_numbers(rows, start, end))


def _sizes(estimate: Array, truth: Array, start: Integers, end: Integers) -> Array:
    """Return the sizes of errors (m, 8) of motions between poses (n, 7)."""
    found = np.empty((8, len(start)))
    own, true = np.ascontiguousarray(estimate.T), np.ascontiguousarray(truth.T)
    for first in range(0, len(start), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        a, b = start[some], end[some]
        x = between(between(own[:, a], own[:, b]), between(true[:, a], true[:, b]))
        halves = np.array(x[:3]), np.array(rotation_vectors(*x[3:]))
        for place, half in enumerate(halves):
            found[3 * place : 3 * place + 3, some] = np.abs(half)
            found[6 + place, some] = np.sqrt(np.add.reduce(half * half, axis=0))
    return found.T


def anchors_of(window: Window) -> int:
    """Return the number of anchors."""
    return int(window.anchor[-1]) + 1 if len(window.anchor) else 0


def raised(window: Horizon, along: Array) -> Array:
    """Return by how much a tube is raised so far (m,) along its window."""
    return np.asarray(np.maximum(along / window.value, _NEAREST) ** -_RAISED)


def window_scores(window: Window, scales: Array) -> Array:
    """Return the scores of each anchor, (anchors, 8); ``scales`` (m, 8)."""
    return np.asarray(np.maximum.reduceat(window.errors / scales, window.begin, axis=0))


def with_six(scores: Array, unit: Array) -> Array:
    """Return the scores (anchors, 3) of position, rotation, and all six degrees of freedom."""
    six = (scores[:, :6] / unit).max(axis=1, keepdims=True)
    return np.concatenate([scores[:, 6:], six], axis=1)
