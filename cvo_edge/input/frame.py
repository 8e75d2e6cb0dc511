"""One image of a source, and what every source provides."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a source, or its absence.

    ``image`` is (height, width, 3) uint8 BGR, or None where it could not be read whole; who makes
    frames of their own may put in whatever ``Odometer.step`` takes;
    ``stamp_ns`` is None where the source has no clock; ``read_ms`` what reading and decoding took,
    without waiting for a camera; ``waited_ms`` how long it lay ready since, or may have lain in a
    camera's queue before; ``skipped`` how many
    frames of the source before it were left out.
    """

    image: NDArray[Any] | None
    stamp_ns: int | None
    source: str
    read_ms: float
    waited_ms: float = 0.0
    skipped: int = 0


@runtime_checkable
class Source(Protocol):
    """Something that yields frames once, in order; ``length`` is None where it has no end.

    ``live`` says whether frames come by themselves, as those of a camera do.
    """

    length: int | None
    live: bool

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield a call for each frame that reads and decodes it; calls may be in other threads."""

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames."""
