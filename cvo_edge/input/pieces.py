"""Follow the pieces of a container that comes through a pipe, to tell whether its end is whole.

A recording in a file states its number of frames; one that a program writes into a pipe does not.
If that program dies, the last piece has fewer bytes than it announces.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable

# A piece's header: how long the piece is (infinite if unknown), or None for too few bytes.
Header = Callable[[bytes], float | None]

_LONGEST_HEADER = 4096
_EBML = b"\x1a\x45\xdf\xa3"
_SEGMENT, _CLUSTER = b"\x18\x53\x80\x67", b"\x1f\x43\xb6\x75"
_Y4M = b"YUV4MPEG2"
_SYNC, _PACKET = 0x47, 188
_BOX = re.compile(rb"....(?:ftyp|moov|moof|mdat|wide|free|skip|styp)", re.DOTALL)
# Samples of each chroma plane to those of luma, across and down.
_CHROMA = {"420": (2, 2), "422": (2, 1), "444": (1, 1), "411": (4, 1)}


class Pieces:
    """Counts through the pieces of MP4, Matroska, Y4M and MPEG transport streams."""

    def __init__(self, start: bytes) -> None:
        """``start`` are the first bytes of the stream, which are fed, too."""
        self._header = _header_for(start)
        self._rest, self._left = b"", 0.0

    def feed(self, content: bytes) -> None:
        """Go on with the next bytes."""
        if self._header is None:
            return
        content, at = self._rest + content, 0
        while at < len(content):
            if not self._left:
                head = content[at : at + _LONGEST_HEADER]
                length = self._header(head)
                if length is None and len(head) == _LONGEST_HEADER:
                    length = math.inf
                if length is None:
                    break
                self._left = length
            step = int(min(self._left, len(content) - at))
            at += step
            self._left -= step
        self._rest = content[at:]

    @property
    def torn(self) -> bool:
        """Whether the bytes so far end within a piece, as far as that can be known."""
        return bool(self._rest) or 0.0 < self._left < math.inf


def index_at_end(start: bytes) -> bool:
    """Whether an MP4 file's pictures come before its index, so that a pipe cannot give them."""
    at = 0
    while _BOX.match(start, at):
        if start[at + 4 : at + 8] in (b"moov", b"moof"):
            return False
        if start[at + 4 : at + 8] == b"mdat":
            return True
        at += max(8, int.from_bytes(start[at : at + 4], "big"))
    return False


def _header_for(start: bytes) -> Header | None:
    if start.startswith(_EBML):
        return _matroska
    if start.startswith(_Y4M):
        return _Y4m()
    if _BOX.match(start):
        return _mp4
    if start[:1] == bytes([_SYNC]):
        return lambda _: _PACKET
    return None


def _mp4(head: bytes) -> float | None:
    if len(head) < 16:
        return None if len(head) < 8 or head[:4] == b"\0\0\0\1" else _box(head)
    return _box(head)


def _box(head: bytes) -> float:
    size = int.from_bytes(head[:4], "big")
    if size == 1:
        size = int.from_bytes(head[8:16], "big")
    # 0: to the end of the file.
    return size if size >= 8 else math.inf


def _matroska(head: bytes) -> float | None:
    id_length = 9 - head[0].bit_length()
    if len(head) < id_length + 1:
        return None
    size_length = 9 - head[id_length].bit_length()
    begin = id_length + size_length
    if id_length > 4 or size_length > 8:
        return math.inf
    if len(head) < begin:
        return None
    bits = 7 * size_length
    size = int.from_bytes(head[id_length:begin], "big") & ((1 << bits) - 1)
    unknown = size == (1 << bits) - 1
    if head[:id_length] == _SEGMENT or (unknown and head[:id_length] == _CLUSTER):
        return begin  # its content is followed
    return math.inf if unknown else begin + size


class _Y4m:
    """A line with the size of pictures, then each picture behind a line of its own."""

    def __init__(self) -> None:
        self._bytes: float | None = None

    def __call__(self, head: bytes) -> float | None:
        line, end, _ = head.partition(b"\n")
        if not end:
            return None
        if self._bytes is None:
            self._bytes = _picture_bytes(line.decode("ascii", "replace"))
            return len(line) + 1
        return len(line) + 1 + self._bytes


def _picture_bytes(line: str) -> float:
    fields = {word[0]: word[1:] for word in line.split()[1:]}
    try:
        width, height = int(fields["W"]), int(fields["H"])
    except (KeyError, ValueError):
        return math.inf
    found = re.match(r"(mono|\d{3})(alpha)?", colour := fields.get("C", "420"))
    if found is None or (found[1] != "mono" and found[1] not in _CHROMA):
        return math.inf
    samples = width * height * (2 if found[2] else 1)
    if found[1] != "mono":
        across, down = _CHROMA[found[1]]
        samples += 2 * math.ceil(width / across) * math.ceil(height / down)
    deep = re.search(r"p\d\d$|mono\d\d$", colour)
    return samples * (2 if deep else 1)
