"""A folder that grows: images are frames as soon as they are whole."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event

from cvo_edge.errors import SourceError
from cvo_edge.files import natural_text
from cvo_edge.input.capture import shown
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock
from cvo_edge.input.frame import Frame
from cvo_edge.input.image_files import (
    BESIDE,
    NOT_COLOUR,
    frame_name,
    mark_of,
    not_a_file,
    read_image_file,
    stamp_at,
)
from cvo_edge.input.stamps import stamp_in_name
from cvo_edge.input.videos import itself
from cvo_edge.input.waiting import Patience
from cvo_edge.vocabulary import Decode

_POLL_S = 0.05
# After so long without a change, a file that cannot be read is given as such.
_GIVEN_UP_S = 2.0
# Images that do not say where they end are whole when they have not grown for so long.
_STEADY_S = 0.5
_SELF_ENDING = (".jpg", ".jpeg", ".png", ".webp")
# A folder that has not changed for so long is not listed again; clocks of file systems are coarse.
_COARSE_NS = 1_000_000_000


class FollowedFolder:
    """The images of a folder, and those that come: in the order in which they appear.

    Images that appear at once come in natural order. Which ones are frames is decided as in
    ``colour_images``, by what has appeared so far. An image that is being written is waited for.
    A name that vanishes and comes back is a new image; one that is written over is not.

    Parameters
    ----------
    folder
        The folder, which may be empty.
    fps
        As for ``open_source``; without it, frames have the stamps since 1970 in their names.
    quiet_s
        The frames end when none has come for so long; None waits for ever.
    live
        Whether images grow old, and are stamped as they arrive if their names have no stamps.
    patience
        Told of each frame.

    Attributes
    ----------
    left_out
        Number of files that are no frames, by reason.
    delivered, heard_s
        As those of ``Camera``.
    """

    length: int | None = None
    longest_silence_s = 5.0

    def __init__(
        self,
        folder: Path,
        fps: float | None,
        quiet_s: float | None,
        *,
        live: bool = False,
        clock: Clock = SYSTEM_CLOCK,
        patience: Patience | None = None,
        bits: int = 16,
    ) -> None:
        self._bits = bits
        self._decode: Decode = "full"
        self.live, self.left_out = live, Counter[str]()
        self._folder, self._fps, self._quiet_s, self._clock = folder, fps, quiet_s, clock
        self._stopped = Event()
        self._seen: set[str] = set()
        self._changed_ns, self._colour = -1, False
        self._patience = patience
        self.delivered, self.heard_s = 0, clock.awake_s()
        self._look()

    def stop(self) -> None:
        """End the frames, also while the next one is waited for."""
        self._stopped.set()

    def halve(self) -> None:
        """Decode at half size; images of other formats than JPEG are then unreadable."""
        self._decode = "half"

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield the frames; each is read before its call is yielded."""
        for frame in self:
            yield partial(itself, frame)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; raises SourceError if the folder can no longer be read."""
        last_s = self._clock.now_s()
        while not self._stopped.is_set():
            for name in self._new():
                if (frame := self._whole(name)) is None:
                    return
                stamp_ns = frame.stamp_ns
                if self._fps is not None:
                    stamp_ns = stamp_at(self.delivered, self._fps)
                elif (named_ns := stamp_in_name(frame_name(name))) is not None:
                    stamp_ns = named_ns
                self.delivered += 1
                if self._patience is not None:
                    self._patience.gave_frame()
                yield replace(frame, stamp_ns=stamp_ns)
                last_s = self._clock.now_s()
            if self._quiet_s is not None and self._clock.now_s() - last_s >= self._quiet_s:
                return
            self._wait()

    def _wait(self) -> None:
        self.heard_s = self._clock.awake_s()
        self._clock.wait(self._stopped, _POLL_S)

    def _new(self) -> list[str]:
        """Return the images that have appeared since the last call."""
        changed_ns = self._look()
        unchanged = changed_ns == self._changed_ns
        if unchanged and self._clock.time_ns() - changed_ns > _COARSE_NS:
            return []
        self._changed_ns = changed_ns
        # A listing may miss a file that was there before one that it holds.
        first, second = self._listed(), self._listed()
        new = set(first) - self._seen
        last = max(map(natural_text, new), default="")
        new |= {name for name in set(second) - set(first) if natural_text(name) < last}
        self._seen = (self._seen & set(first)) | new
        found = [(name, *mark_of(name)) for name in sorted(sorted(new), key=natural_text)]
        self._colour |= any(colour for _, colour, _ in found)
        images = []
        for name, colour, reason in found:
            if not reason and self._colour and not colour:
                reason = NOT_COLOUR
            if reason := reason or first.get(name, ""):
                self.left_out.update({reason} - BESIDE)
            else:
                images.append(name)
        return images

    def _look(self) -> int:
        """Return when the folder changed last, ns."""
        try:
            return self._folder.stat().st_mtime_ns
        except OSError as error:
            raise self._gone(error) from None

    def _listed(self) -> dict[str, str]:
        """Return the names in the folder, each with the reason why it is no file."""
        try:
            with os.scandir(self._folder) as entries:
                return {e.name: not_a_file(e) for e in entries if not e.name.startswith(".")}
        except OSError as error:
            raise self._gone(error) from None

    def _gone(self, error: OSError) -> SourceError:
        return SourceError(
            f"{shown(str(self._folder))}: expected a folder to follow: {error.strerror}"
        )

    def _whole(self, name: str) -> Frame | None:
        """Return an image when it is whole, without pixels if it does not become so.

        None if the frames were stopped.
        """
        path = os.path.join(self._folder, name)  # noqa: PTH118 - as ImageFiles has it
        ends = name.lower().endswith(_SELF_ENDING)
        frame: Frame | None = None
        state: tuple[int, int] | None = None
        since_s = self._clock.now_s()
        while not self._stopped.is_set():
            now_s, before = self._clock.now_s(), state
            state = _state(path)
            if state is None:
                return self._read(path)  # it has vanished, or leads nowhere
            age_s = max(1e-9 * (self._clock.time_ns() - state[1]), 0.0)
            if frame is None or state != before:
                since_s, frame = now_s, self._read(path)
            unchanged_s = max(now_s - since_s, age_s if before in (None, state) else 0.0)
            whole = frame.image is not None and (ends or unchanged_s >= _STEADY_S)
            if whole or unchanged_s >= _GIVEN_UP_S:
                return self._arrived(frame, age_s) if self.live else frame
            self._wait()
        return None

    def _read(self, path: str) -> Frame:
        return read_image_file(path, None, self._bits, self._decode)

    def _arrived(self, frame: Frame, age_s: float) -> Frame:
        now_s = self._clock.now_s() - 1e-3 * frame.read_ms
        stamp_ns = self._clock.time_ns()
        return replace(frame, stamp_ns=stamp_ns, arrived_s=now_s, queued_ms=1e3 * age_s)


def _state(path: str) -> tuple[int, int] | None:
    try:
        found = os.stat(path)  # noqa: PTH116
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns
