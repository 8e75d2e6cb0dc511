"""Sources of frames: a folder or glob of images, a video file, a camera."""

from __future__ import annotations

import glob
import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from operator import index
from pathlib import Path
from threading import Event
from typing import SupportsIndex, TypeVar

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.input.capture import OPENING, TIMEOUT_S, Capture, Reader, shown
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock
from cvo_edge.input.containers import check_video
from cvo_edge.input.frame import Frame, Source
from cvo_edge.input.image_files import (
    IMAGE_SUFFIXES,
    ImageFiles,
    Listing,
    colour_images,
    images_in,
    is_one_image,
    stamp_at,
)
from cvo_edge.input.stamps import NAMES, ListedStamps
from cvo_edge.input.waiting import LONGEST_PAUSE_S, FewAttempts, Patience

# Stamps are nanoseconds in 64 bits, which must last for years.
LOWEST_FPS, HIGHEST_FPS = 1e-3, 1e6
LONGEST_S = 3600.0

# Pauses before each new attempt to open a camera: eight seconds in total.
PAUSES_S = (0.25, 0.5, 1.0, 2.0, 4.0)

T = TypeVar("T")


def open_source(
    source: str | os.PathLike[str] | int,
    fps: float | None = None,
    timeout_s: float = TIMEOUT_S,
    stamps: str | None = None,
    patience: Patience | None = None,
    threads: int | None = None,
) -> Source:
    """Open a folder of images, a glob, a video file, a camera or a stream.

    Parameters
    ----------
    source
        Folder of images (natural order, without hidden files; which ones by the marks in their
        names, see ``colour_images``), a glob pattern, a video file, a camera index such as ``0``,
        a device path such as ``/dev/video0``, a named pipe, or the address of a stream such as
        ``rtsp://...``.
    fps
        Frames per second to stamp frames with, starting at zero, instead of the source's own.
    timeout_s
        Longest wait for the next frame of a video or camera; opening may take twice as long.
    stamps
        Where the stamps are: ``names`` of image files, or a file such as ``rgb.txt``, ``data.csv``
        or ``times.txt``, also for a video (see ``cvo_edge.input.stamps``).
    patience
        How long a camera is waited for, see ``Camera``.
    threads
        Most threads of a video's decoder; by default one per core.

    Raises
    ------
    SourceError
        There is no such source, or it holds no image.
    UsageError
        ``source`` is of another type, ``fps`` or ``timeout_s`` is out of range, or ``stamps`` is
        given with ``fps``, for a camera, or as ``names`` for a video.
    """
    text = _text(source)
    if fps is not None and not LOWEST_FPS <= fps <= HIGHEST_FPS:
        raise UsageError(f"fps: expected {LOWEST_FPS:g} to {HIGHEST_FPS:g}, found {fps:g}")
    if not 0.0 < timeout_s <= LONGEST_S:
        raise UsageError(f"timeout: expected up to {LONGEST_S:g} s, found {timeout_s:g}")
    if stamps is not None and fps is not None:
        raise UsageError("stamps: expected no fps beside them, found both")
    path = Path(text)
    try:
        path.exists()
    except OSError as error:
        raise SourceError(f"{shown(text)}: not a usable name: {error.strerror}") from None
    if path.is_dir():
        return ImageFiles(
            images_in(path), fps, f"{shown(text)}: expected images, found none", stamps
        )
    if re.search(r"file\b", text.partition("://")[0], re.IGNORECASE) and "://" in text:
        raise SourceError(f"{shown(text)}: expected a file's path, found a file address")
    if names_camera(text):
        if stamps is not None:
            raise UsageError(
                f"stamps: expected images or a video, whose stamps they are, found {shown(text)}, "
                "whose frames are stamped as they arrive"
            )
        device = int(text) if text.isdecimal() else text
        reader = partial(Capture, threads=threads)
        return Camera(device, fps, timeout_s, reader=reader, patience=patience)
    if path.is_file():
        if path.suffix.lower() in IMAGE_SUFFIXES or is_one_image(path):
            return ImageFiles(Listing("", [text], {}), fps, "", stamps)
        if stamps == NAMES:
            raise UsageError(
                f"stamps: expected a list of times for a video, found {NAMES}, which are those of "
                "image files"
            )
        listed = None if stamps is None else ListedStamps(Path(stamps))
        return Video(path, fps, timeout_s, listed, threads)
    if glob.has_magic(text):
        found = [name for name in glob.iglob(text, recursive=True) if not os.path.isdir(name)]  # noqa: PTH112
        return ImageFiles(
            colour_images(found), fps, f"{shown(text)}: expected images, found no match", stamps
        )
    raise SourceError(
        f"{shown(text)}: not found; expected a folder, glob, video file, camera index, device or "
        "address"
    )


def _text(source: str | os.PathLike[str] | int) -> str:
    try:
        text = str(index(source)) if isinstance(source, SupportsIndex) else os.fspath(source)
    except TypeError:
        text = None
    if not isinstance(text, str):
        raise UsageError(f"source: expected a path, an address or a camera index, found {source!r}")
    return text


def names_camera(text: str) -> bool:
    """Whether ``text`` names a live source: an index, a device, a named pipe or an address."""
    path = Path(text)
    if path.is_dir():
        return False
    if text.isdecimal() or path.is_char_device() or path.is_fifo() or "://" in text:
        return True
    # A camera that is not plugged in has no device.
    return path.parts[:2] == ("/", "dev") and path.parts[2:3] != ("shm",) and not path.exists()


class Video:
    """A video file. Stamps are its container's, from the first frame on, unless others are given.

    A frame that does not decode has no image if a later one decodes; else the video ends there.
    """

    live = False

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
        self._path = path
        self._capture = Capture(str(path), timeout_s, threads=threads)
        own_fps, announced = self._capture.open()
        self.length: int | None = announced if announced > 0 else None
        self._listed = stamps
        if stamps is not None:
            stamps.check(self.length)
        self._stamps = stamps or _VideoStamps(fps, own_fps)

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield the frames; each is read before its call is yielded."""
        for frame in self:
            yield partial(_itself, frame)

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
                    name = f"{shown(self._path.name)}#{seq}"
                    yield Frame(image, stamp_ns, name, read_ms, fresh_noise=fresh)
                    seq += 1
                unreadable = 0
        if self.length is not None and seq < self.length:
            raise SourceError(
                f"{self._path}: ended early: {seq} of {self.length} frames (by its header or "
                "duration); copy or record it again"
            )
        if self._listed is not None:
            self._listed.end()


class _VideoStamps:
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


class Camera:
    """A camera by index, device path or address; stamps are the times at which frames arrived.

    A camera that does not open, or gives no frame for ``timeout_s``, is closed and opened again,
    a few times, after increasing pauses. A frame that does not decode has no image.

    Frames must be taken as they come, as ``Odometer.stream`` does in every mode: frames that nobody
    takes age in the queues of drivers.

    ``reader`` makes what frames are read from, and ``clock`` measures the time; tests replace both.
    With a ``patience``, it decides how often a camera is opened again, and the first attempt is
    made when frames are asked for.

    Attributes
    ----------
    delivered
        Number of frames so far.
    heard_s
        When the last attempt to open or read began, on ``Clock.awake_s``; it, and the pause before
        the next, come to an end in ``longest_silence_s``.
    """

    live = True

    # So many in a row are the end of the stream.
    _UNREADABLE_IN_A_ROW = 5

    def __init__(
        self,
        device: int | str,
        fps: float | None,
        timeout_s: float = TIMEOUT_S,
        *,
        clock: Clock = SYSTEM_CLOCK,
        reader: Callable[[int | str, float], Reader] = Capture,
        patience: Patience | None = None,
    ) -> None:
        self._device, self._fps, self._timeout_s = device, fps, timeout_s
        self._clock, self._reader = clock, reader
        self._capture: Reader | None = None
        self._since_opened = 0
        self._patience = patience or FewAttempts(lambda: PAUSES_S)
        self._stopped = Event()
        self.length: int | None = None
        self.delivered, self.heard_s = 0, clock.awake_s()
        # One that is waited for may come at any later time.
        if patience is None:
            self._insisting(self._opened)

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield the frames; each is read before its call is yielded."""
        for frame in self:
            yield partial(_itself, frame)

    @property
    def longest_silence_s(self) -> float:
        """The longest time between two attempts, s."""
        return (OPENING + 1.0) * self._timeout_s + LONGEST_PAUSE_S

    def stop(self) -> None:
        """End the frames, also while the next one is waited for."""
        self._stopped.set()
        self._close()

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until ``stop``; raises SourceError if the camera does not come back."""
        try:
            while not self._stopped.is_set():
                frames = self._insisting(self._next)
                if frames is None:
                    return
                self._since_opened += 1
                if self._since_opened > 1:
                    # An address of single pictures gives one frame per connection.
                    self._patience.gave_frame()
                for frame in frames:
                    seq = self.delivered
                    stamp_ns = stamp_at(seq, self._fps) if self._fps else frame.stamp_ns
                    self.delivered += 1
                    yield replace(frame, stamp_ns=stamp_ns, source=f"{shown(self._device)}#{seq}")
        finally:
            self._close()

    def _opened(self) -> Reader:
        capture = self._capture
        if capture is None:
            # Stored before it is opened, so that ``stop`` can close it meanwhile.
            capture = self._capture = self._reader(self._device, self._timeout_s)
            self._since_opened = 0
            if self._stopped.is_set():
                self._close()
            capture.open()
        return capture

    def _next(self) -> list[Frame] | None:
        """Return the next frame that decodes, behind those that do not; None at the end."""
        frames: list[Frame] = []
        clock, capture = self._clock, self._opened()
        late = clock.awake_s() + self._timeout_s
        while len(frames) < self._UNREADABLE_IN_A_ROW and clock.awake_s() < late:
            if (grabbed := capture.read()) is not None:
                frames.append(
                    Frame(
                        grabbed.image,
                        grabbed.stamp_ns,
                        "",
                        grabbed.decode_ms,
                        grabbed.queued_ms,
                        grabbed.arrived_s,
                        fresh_noise=grabbed.fresh_noise,
                    )
                )
                return frames
            frames.append(Frame(None, clock.time_ns(), "", 0.0))
        return None

    def _close(self) -> None:
        capture, self._capture = self._capture, None
        if capture is not None:
            capture.close()

    def _insisting(self, call: Callable[[], T | None]) -> T | None:
        """Return what a call gives at last, None once stopped.

        None and a SourceError are failures of the call.
        """
        while not self._stopped.is_set():
            self.heard_s = self._clock.awake_s()
            try:
                found = call()
            except SourceError as error:
                problem = str(error)
            else:
                if found is not None:
                    return found
                problem = f"{shown(self._device)}: the stream ended"
            self._close()
            if self._stopped.is_set():
                break
            self._clock.wait(self._stopped, self._patience.failed(problem))
        return None


def _itself(frame: Frame) -> Frame:
    return frame
