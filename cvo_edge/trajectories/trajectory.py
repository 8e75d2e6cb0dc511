"""Poses of a file with the frames that they belong to, and what was skipped."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SourceError

Array = NDArray[np.float64]
Key = TypeVar("Key", int, str)

LISTED_TWICE = "listed twice"
NONE_SKIPPED = "none skipped"


class Skipped(dict[str, int]):
    """How much was skipped, by reason, and where each reason was first found."""

    def __init__(self, counts: Mapping[str, int] | None = None) -> None:
        super().__init__(counts or {})
        self.first: dict[str, str] = {}

    def add(self, reason: str, where: str = "", count: int = 1) -> None:
        """Count one or more; ``where`` names file and line, if that is known."""
        self[reason] = self.get(reason, 0) + count
        if where:
            self.first.setdefault(reason, where)

    def __str__(self) -> str:
        """Return e.g. ``skipped 3: invalid pose 3 (first in truth.txt, line 7: ...)``."""
        if not self:
            return NONE_SKIPPED
        first = {reason: f" (first in {where})" for reason, where in self.first.items()}
        reasons = ", ".join(
            f"{reason} {count}{first.get(reason, '')}" for reason, count in self.items()
        )
        return f"skipped {sum(self.values())}: {reasons}"


class Entry(NamedTuple, Generic[Key]):
    """A pose of a file: its key, ``T_world_camera`` (7,) or None, its place and what is wrong."""

    key: Key
    pose: Array | None
    where: str
    fault: str | None = None


@dataclass(frozen=True)
class Trajectory(Generic[Key]):
    """Poses of a file by stamp, by frame number or by name.

    Attributes
    ----------
    keys
        Stamps (nanoseconds, ascending, each once), frame numbers or names.
    poses
        ``T_world_camera`` (7,) for each key, or None where the file's pose is invalid. No other
        pose takes its place.
    faults
        For the index of each None, file, line and what is wrong.
    skipped
        Entries of the file that give no pose.
    """

    keys: list[Key]
    poses: list[Array | None]
    faults: dict[int, str]
    skipped: Skipped


def trajectory_of(path: Path, entries: Sequence[Entry[Key]]) -> Trajectory[Key]:
    """Return the entries as a trajectory; raises SourceError if none has a valid pose.

    Of entries with one key, the first counts and the others are listed twice.
    """
    keys: dict[Key, None] = {}
    poses: list[Array | None] = []
    faults: dict[int, str] = {}
    skipped = Skipped()
    for entry in entries:
        if entry.key in keys:
            skipped.add(LISTED_TWICE, entry.where)
            continue
        if entry.pose is None:
            faults[len(poses)] = entry.where + (f": {entry.fault}" if entry.fault else "")
            skipped.add("invalid pose", faults[len(poses)])
        keys[entry.key] = None
        poses.append(entry.pose)
    if len(faults) == len(poses):
        found = f"found no valid one: {next(iter(faults.values()))}" if faults else "found none"
        raise SourceError(f"{path}: expected poses, {found}")
    return Trajectory(list(keys), poses, faults, skipped)


def nearest_stamp(stamps_ns: Sequence[int], stamp_ns: int, bound_ns: int) -> int | None:
    """Return the index of the nearest ascending stamp (the earlier of two), None if too far."""
    right = bisect_left(stamps_ns, stamp_ns)
    nearest = min(
        range(max(0, right - 1), min(right + 1, len(stamps_ns))),
        key=lambda index: abs(stamps_ns[index] - stamp_ns),
        default=None,
    )
    if nearest is None or abs(stamps_ns[nearest] - stamp_ns) > bound_ns:
        return None
    return nearest
