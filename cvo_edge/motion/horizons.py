"""Horizons: how far back the motion reaches that an interval is about.

A horizon is a number of frames (``1f``), of seconds (``5s``) or of metres along the estimate's own
path (``100m``). For each pose, the motion starts at the earlier pose that fits best. A motion never
crosses a break of the trajectory: a gap, a jump, or a pose that is no pose.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
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
    wanted = along[ends] - horizon.value
    after = np.searchsorted(along, wanted)
    before = np.maximum(after - 1, 0)
    # Of two poses that are equally near, the earlier one counts.
    nearer = np.abs(along[before] - wanted) <= np.abs(along[after] - wanted)
    start = np.minimum(np.where(nearer, before, after), ends - 1)
    span = along[ends] - along[start]
    fits = np.abs(span - horizon.value) <= _TOLERANCE * horizon.value
    return np.where((start >= 0) & fits & (part[start] == part[ends]), start, -1)


def path_length(poses: Array) -> Array:
    """Return the metres along the path up to each pose (n, 7) -> (n,)."""
    steps = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])
