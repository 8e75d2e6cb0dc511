"""A video file as a source, and the stamps of its frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Protocol

from cvo_edge.errors import SourceError
from cvo_edge.input.capture import TIMEOUT_S, Capture, shown
from cvo_edge.input.containers import check_video
from cvo_edge.input.frame import Frame
from cvo_edge.input.image_files import stamp_at
from cvo_edge.input.stamps import ListedStamps

# Stamps are nanoseconds in 64 bits, which must last for years.
LOWEST_FPS, HIGHEST_FPS = 1e-3, 1e6


class Stamps(Protocol):
    """Where the stamps of frames come from."""

    def next(self, count: int, position_ms: float) -> Sequence[int | None]:
        """Return the stamps of the next ``count`` frames."""

    def end(self) -> None:
        """Raise SourceError unless there were as many frames as stamps."""


class Video:
    """A video file. Stamps are its container's, from the first frame on, unless others are given.

    A frame that does not decode has no image if a later one decodes; else the video ends there.
    """

    live: bool = False

    # So many in a row are the end, also if the container announces no number of frames.
    _UNREADABLE_IN_A_ROW = 100

    def __init__(
        self,
        path: Path,
        fps: float | None,
        timeout_s: float = TIMEOUT_S,
        stamps: ListedStamps | None = None,
        threads: int | None = None,
    ) -> None:
        check_video(path)
        capture = Capture(str(path), timeout_s, threads=threads)
        self._open(str(path), path.name, capture, fps, stamps)

    def _open(
        self,
        path: str,
        name: str,
        capture: Capture,
        fps: float | None,
        stamps: ListedStamps | None,
    ) -> None:
        self._path, self._name, self._capture = path, shown(name), capture
        own_fps, announced = capture.open()
        self.length: int | None = announced if announced > 0 else None
        if stamps is not None:
            stamps.check(self.length)
        self._stamps: Stamps = stamps or VideoStamps(fps, own_fps)

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield the frames; each is read before its call is yielded."""
        for frame in self:
            yield partial(itself, frame)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames.

        Raises SourceError if the file ends before its own count, or does not fit listed stamps.
        """
        seq = unreadable = 0
        with closing(self._capture):
            while unreadable < self._UNREADABLE_IN_A_ROW:
                if (grabbed := self._capture.read()) is None:
                    unreadable += 1
                    continue
                found = [*[(None, 0.0)] * unreadable, (grabbed.image, grabbed.read_ms)]
                fresh = grabbed.fresh_noise
                stamps = self._stamps.next(len(found), grabbed.position_ms)
                for (image, read_ms), stamp_ns in zip(found, stamps, strict=True):
                    yield Frame(image, stamp_ns, f"{self._name}#{seq}", read_ms, fresh_noise=fresh)
                    seq += 1
                unreadable = 0
        self._check_end(seq)
        self._stamps.end()

    def _check_end(self, frames: int) -> None:
        """Raise SourceError if the video has fewer frames than it announces."""
        if self.length is not None and frames < self.length:
            raise SourceError(
                f"{self._path}: ended early: {frames} of {self.length} frames (by its header or "
                "duration); copy or record it again"
            )


class VideoStamps:
    """Times of a container's frames in ns, from the first one, unless a rate is given.

    A frame that a decoder skips does not shift later ones, and a phone's frame rate varies. For a
    container without times, they follow from its rate.
    """

    # A record's nanoseconds have 64 bits.
    _END_NS = 2.0**62

    def __init__(self, fps: float | None, own_fps: float) -> None:
        self._fps = fps
        believable = LOWEST_FPS <= own_fps <= HIGHEST_FPS
        self._gap_ns = 1e9 / own_fps if believable else None
        self._seq, self._has_times = 0, False
        self._origin_ms, self._last_ns = math.nan, 0.0

    def next(self, count: int, position_ms: float) -> list[int | None]:
        """Return the stamps of the next ``count`` frames, the last of which is at ``position_ms``.

        The unreadable frames before it are spaced evenly.
        """
        begin, self._seq = self._seq, self._seq + count
        if self._fps is not None:
            return [stamp_at(seq, self._fps) for seq in range(begin, self._seq)]
        if self._gap_ns is None:
            return [None] * count
        last_ns = self._last_ns
        if begin == 0:
            last_ns = -self._gap_ns
            self._origin_ms = position_ms - 1e-6 * self._gap_ns * (count - 1)
        now_ns = 1e6 * (position_ms - self._origin_ms)
        if last_ns < now_ns < self._END_NS:
            self._has_times = begin > 0
        else:
            # Half a frame if others have times, so that the next one's is later again.
            now_ns = last_ns + self._gap_ns * (0.5 if self._has_times else count)
        self._last_ns = now_ns
        return [round(last_ns + (now_ns - last_ns) * (k + 1) / count) for k in range(count)]

    def end(self) -> None:
        """Accept any number of frames."""


def itself(frame: Frame) -> Frame:
    """Return the frame, for ``reads`` of a source whose frames are read one after the other."""
    return frame
