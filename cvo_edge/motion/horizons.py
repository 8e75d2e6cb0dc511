"""Horizons: how far back the motion reaches that an interval is about.

A horizon is a number of frames (``1f``), of seconds (``5s``) or of metres along the estimate's own
path (``100m``). For each pose, the motion starts at the earlier pose that fits best. A motion never
crosses a break of the trajectory: a gap, a jump, or a pose that is no pose.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import UsageError

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Unit = Literal["f", "s", "m"]

_FORM = re.compile(r"([0-9]+(?:\.[0-9]+)?)([fsm])")
# Far beyond any recording.
_LARGEST = 1e7
# A motion over a time or a path that is further off than this share belongs to another horizon.
_TOLERANCE = 0.2
# Of frames and nanoseconds, sums are exact: where two poses are equally near, a stream and a file
# agree.
_INTEGERS = {"f": 1, "s": 1_000_000_000}


@dataclass(frozen=True, order=True)
class Horizon:
    """``value`` frames (``f``), seconds (``s``) or metres (``m``)."""

    unit: Unit
    value: float

    @classmethod
    def parse(cls, text: str) -> Horizon:
        """Read e.g. ``1f``, ``0.5s`` or ``100m``; raises UsageError."""
        found = _FORM.fullmatch(text.strip())
        if found is None or not 0.0 < float(found[1]) <= _LARGEST:
            raise UsageError(
                f"horizon: expected frames, seconds or metres such as 1f, 5s or 100m, found {text}"
            )
        unit: Unit = next(unit for unit in get_args(Unit) if unit == found[2])
        if unit == "f" and not float(found[1]).is_integer():
            raise UsageError(f"horizon: expected a whole number of frames, found {text}")
        return cls(unit, float(found[1]))

    def __str__(self) -> str:
        """Return e.g. ``5s``."""
        return f"{self.value:g}{self.unit}"

    @cached_property
    def reach(self) -> float:
        """The value as a trace measures it: in frames or nanoseconds, integers, or metres."""
        return self.value if self.unit == "m" else round(self.value * _INTEGERS[self.unit])

    @cached_property
    def tolerance(self) -> float:
        """By how much a motion may be longer or shorter, in the same unit."""
        return _TOLERANCE * self.value if self.unit == "m" else self.reach // round(1 / _TOLERANCE)

    def along(self, stamps_ns: Integers, path_m: Array) -> Array:
        """Return what the horizon is measured along, (n,): pose numbers, seconds or metres."""
        if self.unit == "f":
            return np.arange(len(path_m), dtype=np.float64)
        return path_m if self.unit == "m" else 1e-9 * (stamps_ns - stamps_ns[0])


def starts(horizon: Horizon, along: Array, part: Integers, ends: Integers) -> Integers:
    """Return where the motions that end at poses ``ends`` (m,) start; -1 without such a motion.

    Parameters
    ----------
    horizon
        The horizon.
    along
        Shape (n,), ascending: see ``Horizon.along``.
    part
        Shape (n,), ascending: the part of the trajectory between breaks that each pose is in.
    ends
        Shape (m,): numbers of poses.
    """
    return _starts(along, horizon.value, _TOLERANCE * horizon.value, part, ends)


def starts_of(
    horizon: Horizon, stamps_ns: Integers, path_m: Array, part: Integers, ends: Integers
) -> Integers:
    """Return the same for the poses of a trace, as exactly as ``start_of``."""
    if horizon.unit == "m":
        return starts(horizon, path_m, part, ends)
    along = stamps_ns if horizon.unit == "s" else np.arange(len(part))
    return _starts(along, horizon.reach, horizon.tolerance, part, ends)


def _starts(
    along: Array | Integers, reach: float, tolerance: float, part: Integers, ends: Integers
) -> Integers:
    wanted = along[ends] - reach
    after = np.searchsorted(along, wanted)
    before = np.maximum(after - 1, 0)
    # Of two poses that are equally near, the earlier one counts.
    nearer = np.abs(along[before] - wanted) <= np.abs(along[after] - wanted)
    start = np.minimum(np.where(nearer, before, after), ends - 1)
    span = along[ends] - along[start]
    fits = np.abs(span - reach) <= tolerance
    return np.where((start >= 0) & fits & (part[start] == part[ends]), start, -1)


def start_of(
    horizon: Horizon,
    stamps_ns: Sequence[int],
    path_m: Sequence[float],
    part: Sequence[int],
    end: int,
) -> int:
    """Return the same for one pose of a stream, without looking at all of them."""
    if horizon.unit == "f":
        start = end - int(horizon.reach)
        return start if start >= 0 and part[start] == part[end] else -1
    if end == 0:
        return -1
    along = stamps_ns if horizon.unit == "s" else path_m
    last = along[end]
    wanted = last - horizon.reach
    after = bisect_left(along, wanted, 0, end + 1)
    before = max(after - 1, 0)
    nearer = abs(along[before] - wanted) <= abs(along[after] - wanted)
    start = min(before if nearer else after, end - 1)
    fits = abs(last - along[start] - horizon.reach) <= horizon.tolerance
    return start if fits and part[start] == part[end] else -1


def path_length(poses: Array) -> Array:
    """Return the metres along the path up to each pose (n, 7) -> (n,)."""
    steps = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])
