"""Sources of frames: a folder or glob of images, a video file, a camera."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event
from typing import TypeVar

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.given import given_number, given_source
from cvo_edge.input.capture import OPENING, TIMEOUT_S, Capture, Reader, shown
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock
from cvo_edge.input.decoding import checked_bits
from cvo_edge.input.followed import FollowedFolder
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
from cvo_edge.input.pipes import names_fifo, names_pipe, piped_source, without_stdin
from cvo_edge.input.stamps import NAMES, ListedStamps
from cvo_edge.input.videos import HIGHEST_FPS, LOWEST_FPS, Video, itself
from cvo_edge.input.waiting import LONGEST_PAUSE_S, FewAttempts, Patience

LONGEST_S = 3600.0

# Pauses before each new attempt to open a camera: eight seconds in total.
PAUSES_S = (0.25, 0.5, 1.0, 2.0, 4.0)

T = TypeVar("T")


def open_source(
    source: str | os.PathLike[str] | int,
    fps: float | None = None,
    timeout_s: float | None = None,
    stamps: str | None = None,
    patience: Patience | None = None,
    threads: int | None = None,
    *,
    live: bool = False,
    follow: bool = False,
    bit_depth: int = 16,
) -> Source:
    """Open a folder of images, a glob, a video file, a pipe, a camera or a stream.

    Parameters
    ----------
    source
        Folder of images (natural order, without hidden files; which ones by the marks in their
        names, see ``colour_images``), a glob pattern, a video file, ``-`` for standard input, a
        named pipe, a camera index such as ``0``, a device path such as ``/dev/video0``, or the
        address of a stream such as ``rtsp://...``.
    fps
        Frames per second to stamp frames with, starting at zero, instead of the source's own.
    timeout_s
        Longest wait for the next frame of a video or camera, by default five seconds; opening may
        take twice as long. A folder that is followed ends after so long without a new image, by
        default never.
    stamps
        Where the stamps are: ``names`` of image files, or a file such as ``rgb.txt``, ``data.csv``
        or ``times.txt``, also for a video (see ``cvo_edge.input.stamps``).
    patience
        How long a camera is waited for, see ``Camera``.
    threads
        Most threads of a video's decoder; by default one per core.
    live
        Whether a pipe is a camera's: its frames are then stamped as they arrive and grow old, and
        a named pipe is opened again for its next writer. Else it is a recording. Images of a folder
        that is followed then grow old, too.
    follow
        Whether to wait for new images in a folder, see ``FollowedFolder``.
    bit_depth
        Bits that the camera fills in files of 16 bits, from 9; the upper eight of them are used.

    Raises
    ------
    SourceError
        There is no such source, or it holds no image.
    UsageError
        ``source`` is of another type, ``fps`` or ``timeout_s`` is out of range, ``stamps`` is given
        with ``fps``, for a camera, or as ``names`` for a video, or ``follow`` for anything but a
        folder.
    """
    text, bits = without_stdin(given_source(source)), checked_bits(bit_depth)
    # What is waited for is a camera.
    live = live or patience is not None
    fps = None if fps is None else given_number(fps, "fps")
    if fps is not None and not LOWEST_FPS <= fps <= HIGHEST_FPS:
        raise UsageError(f"fps: expected {LOWEST_FPS:g} to {HIGHEST_FPS:g}, found {fps:g}")
    quiet_s = None if timeout_s is None else given_number(timeout_s, "timeout")
    timeout_s = TIMEOUT_S if quiet_s is None else quiet_s
    if not 0.0 < timeout_s <= LONGEST_S:
        raise UsageError(f"timeout: expected up to {LONGEST_S:g} s, found {timeout_s:g}")
    if stamps is not None and fps is not None:
        raise UsageError("stamps: expected no fps beside them, found both")
    path = Path(text)
    try:
        path.exists()
    except OSError as error:
        raise SourceError(f"{shown(text)}: not a usable name: {error.strerror}") from None
    if follow:
        _check_followed(path, stamps)
        return FollowedFolder(path, fps, quiet_s, live=live, patience=patience, bits=bits)
    if path.is_dir():
        none = f"{shown(text)}: expected images, found none"
        return ImageFiles(images_in(path), fps, none, stamps, bits)
    if re.search(r"file\b", text.partition("://")[0], re.IGNORECASE) and "://" in text:
        raise SourceError(f"{shown(text)}: expected a file's path, found a file address")
    if names_pipe(text) and not (live and names_fifo(text)):
        return piped_source(text, fps, timeout_s, _listed(stamps), threads, live=live)
    if names_camera(text) or names_pipe(text):
        _check_arriving(text, stamps)
        device = int(text) if text.isdecimal() else text
        reader = partial(Capture, threads=threads)
        return Camera(device, fps, timeout_s, reader=reader, patience=patience)
    if path.is_file() and path.suffix.lower() not in IMAGE_SUFFIXES and not is_one_image(path):
        return Video(path, fps, timeout_s, _listed(stamps), threads)
    none = f"{shown(text)}: expected images, found no match"
    return ImageFiles(_named_images(text), fps, none, stamps, bits)


def _named_images(text: str) -> Listing:
    """Return the image of a name, or the images of a glob; raises SourceError for neither."""
    if Path(text).is_file():
        return Listing("", [text], {})
    if glob.has_magic(text):
        found = glob.iglob(text, recursive=True)
        return colour_images([name for name in found if not os.path.isdir(name)])  # noqa: PTH112
    raise SourceError(
        f"{shown(text)}: not found; expected a folder, glob, video file, camera index, device or "
        "address"
    )


def _check_arriving(text: str, stamps: str | None) -> None:
    if stamps is not None:
        raise UsageError(
            f"stamps: expected images or a video, whose stamps they are, found {shown(text)}, "
            "whose frames are stamped as they arrive"
        )


def _check_followed(path: Path, stamps: str | None) -> None:
    if stamps is not None:
        raise UsageError(
            "stamps: expected none for a folder that is followed, whose stamps are those in names "
            f"or of fps, found {stamps}"
        )
    if not path.exists():
        raise SourceError(
            f"{shown(str(path))}: expected a folder to follow, found none; create it first"
        )
    if not path.is_dir():
        raise UsageError(f"follow: expected a folder of images, found {shown(str(path))}")


def _listed(stamps: str | None) -> ListedStamps | None:
    if stamps == NAMES:
        raise UsageError(
            f"stamps: expected a list of times for a video, found {NAMES}, which are those of "
            "image files"
        )
    return None if stamps is None else ListedStamps(Path(stamps))


def names_camera(text: str) -> bool:
    """Whether ``text`` names a live source: an index, a device or an address."""
    path = Path(text)
    if path.is_dir() or names_pipe(text):
        return False
    if text.isdecimal() or path.is_char_device() or "://" in text:
        return True
    # A camera that is not plugged in has no device.
    return path.parts[:2] == ("/", "dev") and path.parts[2:3] != ("shm",) and not path.exists()


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
            yield partial(itself, frame)

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
