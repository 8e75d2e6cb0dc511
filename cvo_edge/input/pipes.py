"""Recordings and cameras that come through a pipe: standard input, ``<(...)``, a named pipe."""

from __future__ import annotations

import os
import select
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Event, Thread
from time import perf_counter
from typing import Any

import cv2

from cvo_edge.errors import SourceError
from cvo_edge.input.capture import READER, Capture, shown
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock
from cvo_edge.input.containers import check_start
from cvo_edge.input.decoding import decode_image
from cvo_edge.input.frame import Frame
from cvo_edge.input.half import not_half
from cvo_edge.input.image_files import stamp_at
from cvo_edge.input.image_row import MOST_BYTES, PNG_START, ImageRow, starts_row
from cvo_edge.input.pieces import Pieces, index_at_end
from cvo_edge.input.queue_lag import LagAccount
from cvo_edge.input.stamps import ListedStamps
from cvo_edge.input.videos import Video, VideoStamps
from cvo_edge.vocabulary import Decode

_STDIN = ("-", "/dev/stdin", "/dev/fd/0", "/proc/self/fd/0")
_START_BYTES = 4096
_AT_ONCE = 1 << 16
_PART_S = 0.1
# As for a camera, the first bytes may take longer than the next frame.
_OPENING = 2.0


def names_pipe(text: str) -> bool:
    """Whether ``text`` names a pipe, or standard input that is no file."""
    if text in _STDIN:
        return not _is_regular(0)
    path = Path(text)
    return path.is_fifo() or path.is_socket()


def names_fifo(text: str) -> bool:
    """Whether ``text`` names a pipe that can be opened again, for its next writer."""
    return text not in _STDIN and Path(os.path.realpath(text)).is_fifo()


def without_stdin(text: str) -> str:
    """Return the path of the file that is standard input, if ``text`` means that."""
    if text not in _STDIN or not _is_regular(0):
        return text
    path = os.path.realpath("/dev/stdin")
    return path if os.path.exists(path) else "/dev/stdin"  # noqa: PTH110 - of a link in /proc


def _is_regular(descriptor: int) -> bool:
    try:
        return stat.S_ISREG(os.fstat(descriptor).st_mode)
    except OSError:
        return False


@dataclass
class Pipe:
    """An open pipe; ``start`` are the bytes that were read of it."""

    name: str
    descriptor: int
    timeout_s: float
    start: bytes = b""

    def read(self, stopped: Event | None = None, timeout_s: float | None = None) -> bytes:
        """Return the next bytes, none at the end or once ``stopped``.

        Raises SourceError after ``timeout_s`` without one.
        """
        timeout_s = self.timeout_s if timeout_s is None else timeout_s
        waiting = select.poll()
        waiting.register(self.descriptor, select.POLLIN)
        # In parts: if this process is stopped, one part expires, and not the whole time.
        for _ in range(max(1, round(timeout_s / _PART_S))):
            if stopped is not None and stopped.is_set():
                return b""
            if waiting.poll(1e3 * min(_PART_S, timeout_s)):
                try:
                    return os.read(self.descriptor, _AT_ONCE)
                except OSError as error:
                    raise SourceError(f"{self.name}: cannot be read: {error.strerror}") from None
        raise SourceError(f"{self.name}: gave no answer within {timeout_s:g} s")

    def close(self) -> None:
        """Close the pipe; its writer learns of it."""
        with suppress(OSError):
            os.close(self.descriptor)


def open_pipe(text: str, timeout_s: float) -> Pipe:
    """Open a pipe and read its first bytes.

    Raises SourceError for one that gives nothing, and for a terminal.
    """
    name = "standard input" if text in _STDIN else shown(text)
    try:
        if text in _STDIN:
            descriptor = os.dup(0)
        else:
            # Opening it must not wait for a writer.
            descriptor = os.open(text, os.O_RDONLY | os.O_NONBLOCK)
            os.set_blocking(descriptor, True)
    except OSError as error:
        raise SourceError(f"{name}: cannot be opened: {error.strerror}") from None
    pipe = Pipe(name, descriptor, timeout_s)
    try:
        if os.isatty(descriptor):
            raise SourceError(f"{name}: expected images or a video, found a terminal")
        while len(pipe.start) < _START_BYTES:
            # Longer for the first bytes: a program starts.
            more = pipe.read(timeout_s=timeout_s if pipe.start else _OPENING * timeout_s)
            if not more:
                break
            pipe.start += more
        if not pipe.start:
            raise SourceError(f"{name}: expected images or a video, found no bytes")
        if not starts_row(pipe.start):
            check_start(name, pipe.start[:_START_BYTES])
        if index_at_end(pipe.start):
            raise SourceError(
                f"{name}: expected pictures behind their index, found an MP4 file with its index "
                "at the end, which a pipe cannot reach; give the file's name, or write it with "
                "ffmpeg -movflags frag_keyframe+empty_moov"
            )
    except BaseException:
        pipe.close()
        raise
    return pipe


def piped_source(
    text: str,
    fps: float | None,
    timeout_s: float,
    stamps: ListedStamps | None,
    threads: int | None = None,
    *,
    live: bool,
) -> PipedImages | PipedVideo:
    """Return the frames that come through a pipe; raises SourceError as ``open_pipe`` does."""
    pipe = open_pipe(text, timeout_s)
    if starts_row(pipe.start):
        return PipedImages(pipe, fps, stamps, live=live)
    return PipedVideo(pipe, fps, stamps, threads, live=live)


class PipedImages:
    """JPEG and PNG images in a row; one that is damaged is a frame without an image.

    ``live`` frames are stamped by their arrival, unless a rate is given, and grow old.
    """

    def __init__(
        self,
        pipe: Pipe,
        fps: float | None,
        stamps: ListedStamps | None,
        *,
        live: bool,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self.live = live
        self.length: int | None = None
        self._pipe, self._clock = pipe, clock
        self._decode: Decode = "full"
        self._stamps = stamps or VideoStamps(fps, 0.0)
        self._stopped = Event()

    def stop(self) -> None:
        """End the frames, also while the next one is waited for."""
        self._stopped.set()

    def halve(self) -> None:
        """Decode at half size; raises UsageError if the first image is a PNG."""
        if self._pipe.start.startswith(PNG_START):
            raise not_half("PNG images")
        self._decode = "half"

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; raises SourceError if the last one is cut."""
        for read in self.reads():
            yield read()

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield one call an image, which decodes it."""
        seq, row, ages = 0, ImageRow(), _Ages(self._clock)
        with closing(self._pipe):
            content = self._pipe.start
            while content:
                for image in row.feed(content):
                    (stamp_ns,) = self._stamps.next(1, 0.0)
                    frame = Frame(None, stamp_ns, f"{self._pipe.name}#{seq}", 0.0)
                    if self.live:
                        frame = ages.arrived(frame)
                    yield partial(_decoded, image, frame, self._decode)
                    seq += 1
                if row.overlong:
                    raise SourceError(
                        f"{self._pipe.name}: expected images of at most {MOST_BYTES >> 20} MiB, "
                        "found a longer one"
                    )
                content = self._pipe.read(self._stopped)
        if row.torn and not self._stopped.is_set():
            raise _cut(self._pipe.name, seq)
        self._stamps.end()


class _Ages:
    """Times of frames that arrive, and bounds on their time in queues."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._account = LagAccount(clock.now_s(), 0.0)
        self._last, self._busy_s = clock.now_s(), clock.busy_s()

    def arrived(self, frame: Frame) -> Frame:
        """Return a frame that has arrived now."""
        now, busy_s = self._clock.now_s(), self._clock.busy_s()
        slept_s = now - self._last - (busy_s - self._busy_s)
        self._last, self._busy_s = now, busy_s
        stamp_ns = self._clock.time_ns() if frame.stamp_ns is None else frame.stamp_ns
        queued_ms = 1e3 * self._account.queued_s(now, slept_s)
        return replace(frame, stamp_ns=stamp_ns, queued_ms=queued_ms, arrived_s=now)


def _decoded(content: bytes, frame: Frame, decode: Decode) -> Frame:
    begin = perf_counter()
    image = decode_image(content, decode=decode)
    return replace(frame, image=image, read_ms=1e3 * (perf_counter() - begin))


def _cut(name: str, frames: int) -> SourceError:
    return SourceError(
        f"{name}: ended within a frame, after {frames} whole ones; its writer was interrupted"
    )


class PipedVideo(Video):
    """A video that comes through a pipe, whose end is checked where its container allows it.

    ``live`` frames are stamped by their arrival, unless a rate is given, and grow old.
    """

    def __init__(
        self,
        pipe: Pipe,
        fps: float | None,
        stamps: ListedStamps | None,
        threads: int | None = None,
        *,
        live: bool,
    ) -> None:
        self.live, self._fps = live, fps
        self._relay = _Relay(pipe)
        made = partial(_FromPipe, self._relay)
        capture = Capture(pipe.name, pipe.timeout_s, threads=threads, video=made)
        self._open(pipe.name, pipe.name, capture, fps, stamps)
        if not pipe.start.startswith(b"RIFF") and pipe.start[4:8] != b"ftyp":
            # Other containers state a duration at most, which is too long where sound is longer.
            self.length = None

    def stop(self) -> None:
        """End the frames, also while the next one is waited for."""
        self._capture.close()

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; raises SourceError if the last one is cut, or there are too few."""
        return self._arriving() if self.live else super().__iter__()

    def _arriving(self) -> Iterator[Frame]:
        seq = 0
        with closing(self._capture):
            while (grabbed := self._capture.read()) is not None:
                stamp_ns = grabbed.stamp_ns if self._fps is None else stamp_at(seq, self._fps)
                yield Frame(
                    grabbed.image,
                    stamp_ns,
                    f"{self._name}#{seq}",
                    grabbed.decode_ms,
                    grabbed.queued_ms,
                    grabbed.arrived_s,
                    fresh_noise=grabbed.fresh_noise,
                )
                seq += 1
        self._check_end(seq)

    def _check_end(self, frames: int) -> None:
        if self._relay.torn:
            raise _cut(self._path, frames)
        if not frames:
            raise SourceError(f"{self._path}: expected a video, found no frame in it")
        super()._check_end(frames)


class _Relay:
    """Passes a pipe's bytes on to FFmpeg, and follows its pieces."""

    def __init__(self, pipe: Pipe) -> None:
        self._pipe, self._pieces = pipe, Pieces(pipe.start)
        self._ended = False

    @property
    def torn(self) -> bool:
        """Whether the pipe has ended within a piece."""
        return self._ended and self._pieces.torn

    def begin(self) -> int:
        """Start; return the descriptor to read from."""
        descriptor, into = os.pipe()
        # A daemon, as a writer may never end; the command line knows it by its name.
        Thread(target=self._run, args=(into,), name=f"{READER} pipe", daemon=True).start()
        return descriptor

    def _run(self, into: int) -> None:
        content = self._pipe.start
        with closing(self._pipe), suppress(OSError), os.fdopen(into, "wb", buffering=0) as sink:
            while content:
                self._pieces.feed(content)
                left = memoryview(content)
                while left:
                    left = left[sink.write(left) :]
                content = os.read(self._pipe.descriptor, _AT_ONCE)
            self._ended = True


class _FromPipe:
    """OpenCV's capture of what a relay passes on."""

    def __init__(self, relay: _Relay) -> None:
        self._relay, self._capture = relay, cv2.VideoCapture()
        self._descriptor: int | None = None

    def open(self, _: int | str, api: int = 0, limits: Sequence[int] = ()) -> bool:  # noqa: ARG002
        """Open the video; FFmpeg duplicates the descriptor or not, by its version."""
        self._descriptor = self._relay.begin()
        return self._capture.open(f"pipe:{self._descriptor}", cv2.CAP_FFMPEG, list(limits))

    def release(self) -> None:
        """Release the video, and with it the pipe."""
        self._capture.release()
        if self._descriptor is not None:
            with suppress(OSError):
                os.close(self._descriptor)

    def grab(self) -> bool:
        """Go on to the next frame."""
        return self._capture.grab()

    def retrieve(self) -> tuple[bool, Any]:
        """Return the frame that was grabbed."""
        return self._capture.retrieve()

    def get(self, name: int) -> float:
        """Return a property."""
        return self._capture.get(name)

    def set(self, name: int, value: float) -> bool:
        """Set a property."""
        return self._capture.set(name, value)

    def getBackendName(self) -> str:  # noqa: N802 - OpenCV's name
        """Return what reads the pipe."""
        return self._capture.getBackendName()
