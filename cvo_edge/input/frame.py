"""One image of a source, and what every source provides."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import UsageError
from cvo_edge.given import given_count, given_number


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a source, or its absence.

    ``image`` is (height, width, 3) uint8 BGR, or None if it could not be read whole; callers that
    build frames may use any image that ``Odometer.step`` accepts. ``stamp_ns`` is None if the
    source has no clock. ``read_ms`` is the time spent reading and decoding, without the wait for a
    camera. ``queued_ms`` bounds the age of the frame when it arrived: the time it may have spent in
    a camera's queue. ``arrived_s`` is the time of arrival on ``Clock.now_s``, None if the frame
    does not age (files, frames of a caller). ``skipped`` is the number of frames of the source that
    were dropped before this one.

    ``fresh_noise`` is False if equal parts of two images do not prove a copy: behind a codec that
    predicts from other frames (H.264), and in a simulation without sensor noise. ``moving`` is what
    the caller knows about the camera from other sensors or its commands; None is nothing.
    """

    image: NDArray[Any] | None
    stamp_ns: int | None
    source: str
    read_ms: float
    queued_ms: float = 0.0
    arrived_s: float | None = None
    skipped: int = 0
    fresh_noise: bool = True
    moving: bool | None = None

    def __post_init__(self) -> None:
        """Take numbers of numpy and paths; raise UsageError for a stamp or time that is none."""
        if self.stamp_ns is not None and type(self.stamp_ns) is not int:
            object.__setattr__(self, "stamp_ns", given_count(self.stamp_ns, "stamp_ns"))
        if type(self.source) is not str:
            object.__setattr__(self, "source", str(self.source))
        if type(self.read_ms) is not float:
            object.__setattr__(self, "read_ms", given_number(self.read_ms, "read_ms"))

    def told(self, moving: bool | None) -> Frame:
        """Return it with what is known of the camera's motion, unless it says that itself."""
        if moving is None or self.moving is not None:
            return self
        return replace(self, moving=moving)

    def age_ms(self, now_s: float) -> float:
        """Return an upper bound on the frame's age at ``now_s`` of ``Clock.now_s``."""
        return self.queued_ms + self.since_arrival_ms(now_s)

    def since_arrival_ms(self, now_s: float) -> float:
        """Return the time from the frame's arrival until ``now_s``, 0 if it does not age."""
        return 0.0 if self.arrived_s is None else 1e3 * (now_s - self.arrived_s)


def checked_hint(moving: object) -> bool | None:
    """Return what a caller knows of the camera's motion; raises UsageError unless it is a bool."""
    if moving is None:
        return None
    if isinstance(moving, bool | np.bool_):
        return bool(moving)
    raise UsageError(f"moving: expected a bool or None, found {type(moving).__name__}")


@runtime_checkable
class Source(Protocol):
    """Something that yields frames once, in order; ``length`` is None if it has no end.

    ``live`` says whether frames come at their own pace, as those of a camera do.
    """

    length: int | None
    live: bool

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield a call for each frame that reads and decodes it; calls may run in other threads."""

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames."""
