"""Split a stream of bytes into the JPEG and PNG images that it holds one after the other.

FFmpeg would decode an image that was cut to a picture whose rest is grey; here it is found out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

# More than any camera writes; a damaged length could ask for gigabytes.
MOST_BYTES = 1 << 27

_START = re.compile(rb"\xff\xd8\xff|\x89PNG\r\n\x1a\n")
_LONGEST_START = 8
PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
# In a JPEG's data, 0xFF is followed by 0, by a restart marker, or by the next marker.
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_BEGIN, _END, _SCAN = 0xD8, 0xD9, 0xDA
_BARE = frozenset((0x01, *range(0xD0, 0xD8)))
# The head of a part, as network cameras send it before each picture (multipart/x-mixed-replace).
_PART = re.compile(rb"\s*--[^\r\n]+\r?\n(?:[^\r\n]+\r?\n)*?content-type: *image/", re.IGNORECASE)


def starts_row(start: bytes) -> bool:
    """Whether a stream's first bytes are those of an image of a row, or of such a part."""
    return _START.match(start) is not None or _PART.match(start) is not None


class ImageRow:
    """The images of a stream; bytes between two of them are skipped."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._begun = self._in_scan = False
        # Where the next part of the image begins.
        self._at = 0

    @property
    def torn(self) -> bool:
        """Whether an image has begun and not ended."""
        return self._begun

    @property
    def overlong(self) -> bool:
        """Whether an image has grown beyond ``MOST_BYTES``."""
        return len(self._bytes) > MOST_BYTES

    def feed(self, content: bytes) -> Iterator[bytes]:
        """Yield the images that end in ``content``; no bytes for one that is damaged."""
        self._bytes += content
        while self._begun or self._begin():
            end = self._png() if self._bytes.startswith(PNG_START) else self._jpeg()
            if end is None:
                return
            image = bytes(self._bytes[:end]) if end else b""
            # What damaged an image may be the beginning of the next one.
            del self._bytes[: end or max(1, self._at)]
            self._begun = False
            yield image

    def _begin(self) -> bool:
        found = _START.search(self._bytes)
        del self._bytes[: found.start() if found else max(0, len(self._bytes) - _LONGEST_START)]
        self._begun, self._in_scan, self._at = found is not None, False, 2
        return self._begun

    def _jpeg(self) -> int | None:
        """Return where the image ends: None if that is not known yet, 0 if it is damaged."""
        while True:
            if self._in_scan:
                found = _MARKER.search(self._bytes, self._at)
                self._at = found.start() if found else max(self._at, len(self._bytes) - 1)
                self._in_scan = found is None
            head = self._bytes[self._at : self._at + 4]
            if self._in_scan or len(head) < 2:
                return None
            marker = head[1]
            if head[0] != 0xFF or marker == _BEGIN:
                return 0
            if marker == _END:
                return self._at + 2
            if marker == 0xFF or marker in _BARE:
                self._at += 1 if marker == 0xFF else 2
                continue
            if len(head) < 4:
                return None
            self._at += 2 + int.from_bytes(head[2:], "big")
            self._in_scan = marker == _SCAN

    def _png(self) -> int | None:
        """Return where the image ends: None if that is not known yet, 0 if it is damaged."""
        self._at = max(self._at, len(PNG_START))
        while len(head := self._bytes[self._at : self._at + 8]) == 8:
            length, name = int.from_bytes(head[:4], "big"), head[4:]
            if length > MOST_BYTES or not name.isalpha():
                return 0
            end = self._at + 12 + length
            if name == _PNG_END and end <= len(self._bytes):
                return end
            if name == _PNG_END:
                return None
            self._at = end
        return None
