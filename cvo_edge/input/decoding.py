"""Bytes of an image file -> pixels, if the file is whole, of a bounded size and unambiguous.

Decoders trust the header: 100 kB of PNG may ask for gigabytes. The size is therefore read here
first; OpenCV takes a limit only from the environment, before it is imported.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import UsageError
from cvo_edge.given import given_count
from cvo_edge.vocabulary import Decode

# 192 MiB as BGR, and several times that while some formats are decoded; 8K cameras have half of it.
MAX_PIXELS = 1 << 26
# Uncompressed 16-bit colours, with room for the rest of a file.
MAX_IMAGE_BYTES = 1 << 29

_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
# libjpeg-turbo's inverse transform of 4x4 values for each block of 8x8.
_HALF_FLAGS = cv2.IMREAD_REDUCED_COLOR_2 | cv2.IMREAD_IGNORE_ORIENTATION

JPEG_START = b"\xff\xd8"
_JPEG_END, _JPEG_SCAN = b"\xff\xd9", b"\xff\xda"
# Segments and chunks before the picture; cameras write about ten, of at most 64 KiB in a JPEG.
_MOST_PARTS = 4096
# Each scan takes as long to decode as a picture; cameras write one, tools about ten.
_MOST_SCANS = 64
# Within the data, 0xFF is followed by a zero or a restart marker.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
# Frame types that are not progressive: one scan of all components is the whole picture (T.81, B.1).
_SEQUENTIAL = frozenset((0xC0, 0xC1, 0xC9))
# Markers without a length belong in the data; decoders disagree on what follows one elsewhere.
_BARE = frozenset((0x01, *range(0xD0, 0xDA)))
# Decoders differ in whether a carriage return ends a comment, so a comment with one is refused.
_GAP = rb"\s+(?:#[^\r\n]*\n\s*)*"
_PNM = re.compile(rb"P[1-6]" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})\s")
_TIFF_STARTS = (b"II*\0", b"MM\0*")
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_TILE, _TIFF_ORIENTATION = 256, 257, (322, 323), 274
# TIFF's 16 and 32 bit unsigned numbers.
_TIFF_NUMBERS = {3: "H", 4: "I"}


def upper_eight(values: NDArray[Any], bits: int = 16) -> NDArray[np.uint8]:
    """Return the upper eight of ``bits`` bits, uint16; larger values are white."""
    return np.asarray(np.minimum(values >> (bits - 8), 255), np.uint8)


def checked_bits(bits: object) -> int:
    """Return how many bits of 16 a camera fills; raises UsageError."""
    count = given_count(bits, "bit depth")
    if not 9 <= count <= 16:
        raise UsageError(f"bit depth: expected 9 to 16 bits, found {count}")
    return count


def decode_image(
    content: bytes, bits: int = 16, decode: Decode = "full"
) -> NDArray[np.uint8] | None:
    """Decode an image file to (height, width, 3) uint8 BGR; None if it is damaged or unsupported.

    JPEG, PNG, BMP, PNM, TIFF and WebP are recognised by their first bytes. Grey is repeated, alpha
    dropped, 16 bits keep the upper eight of ``bits``, and pixels keep their stored order, the
    sensor's (no rotation by EXIF or TIFF's tag 274). The result is None for other formats, for a
    header that contradicts itself or asks for more than ``MAX_PIXELS``, and for an incomplete file:
    some OpenCV versions decode a cut JPEG to a wrong picture of full size, so its end marker is
    checked first. Altered bytes within a JPEG's data mostly pass because, unlike PNG, it has no
    checksum.

    ``half`` decodes a JPEG to half its height and width, rounded upwards, in less time: the pixels
    are close to the means of four, but not equal. Other formats cannot do that and give None.
    """
    size = image_size(content)
    if size is None or not 0 < size[0] * size[1] <= MAX_PIXELS:
        return None
    if decode == "half":
        if not content.startswith(JPEG_START):
            return None
        size = (size[0] + 1) // 2, (size[1] + 1) // 2
    if content.startswith(_TIFF_STARTS):
        content = _unturned(content)
    try:
        flags = _FLAGS if decode == "full" else _HALF_FLAGS
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    except (cv2.error, MemoryError):
        return None
    if image is None or image.shape[:2] != size:
        return None
    if image.dtype == np.uint16:
        image = upper_eight(image, bits)
    return np.asarray(image, np.uint8) if image.dtype == np.uint8 else None


def is_image(start: bytes) -> bool:
    """Whether a file's first 16 bytes are those of an image that ``decode_image`` knows."""
    if start.startswith(b"P"):
        return re.match(rb"P[1-6]\s", start) is not None
    # RIFF also holds videos.
    if start.startswith(b"RIFF"):
        return start[8:12] == b"WEBP"
    return any(start.startswith(begin) for begin, _ in _FORMATS)


def image_size(content: bytes) -> tuple[int, int] | None:
    """Return height and width from the header of an image file, None if there is no whole one."""
    for start, read in _FORMATS:
        if content.startswith(start):
            try:
                return read(content)
            except (struct.error, IndexError, KeyError):
                return None
    return None


def _jpeg(content: bytes) -> tuple[int, int] | None:
    """Read the frame header; None if the end of the image does not follow the start of its data."""
    size, components, position = None, 0, 2
    for _ in range(_MOST_PARTS):
        if content[position] != 0xFF:
            return None
        marker = content[position + 1]
        if marker == 0xFF:  # fill
            position += 1
            continue
        if marker in _BARE:
            return None
        (length,) = struct.unpack_from(">H", content, position + 2)
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            if size is not None:
                return None
            height, width, components = struct.unpack_from(">HHB", content, position + 5)
            size = height, width
            if marker not in _SEQUENTIAL:
                components = 0
        if marker == 0xDA:
            alone = 0 < components == content[position + 4]
            # The marker cannot occur within the data.
            whole = content.rfind(_JPEG_END) >= position + 2 + length
            few = alone or _few_scans(content, position)
            return size if whole and few else None
        position += 2 + length
    return None


def _few_scans(content: bytes, position: int) -> bool:
    """Whether a JPEG ends after few scans, from the first one's marker; other bytes may follow."""
    scans = 0
    for _ in range(_MOST_PARTS):
        kind = content[position + 1]
        if kind == _JPEG_END[1]:
            return True
        scans += kind == _JPEG_SCAN[1]
        if scans > _MOST_SCANS:
            return False
        (length,) = struct.unpack_from(">H", content, position + 2)
        found = _JPEG_MARKER.search(content, position + 2 + length)
        if found is None:
            return False
        position = found.start()
    return False


def _png(content: bytes) -> tuple[int, int] | None:
    name, width, height = struct.unpack_from(">4sII", content, 12)
    return (height, width) if name == b"IHDR" else None


def _bmp(content: bytes) -> tuple[int, int]:
    (header,) = struct.unpack_from("<I", content, 14)
    # OS/2's first header has 16-bit sizes; in others a negative height means rows from the top.
    width, height = struct.unpack_from("<HH" if header == 12 else "<ii", content, 18)
    return abs(height), abs(width)


def _pnm(content: bytes) -> tuple[int, int] | None:
    found = _PNM.match(content[:4096])
    return (int(found[2]), int(found[1])) if found else None


def _tiff(content: bytes) -> tuple[int, int] | None:
    """Read the size of the first picture.

    None if a tag occurs twice, or if tiles are larger than ``MAX_PIXELS``.
    """
    order, tags = _tiff_tags(content)
    found = {}
    for tag, place in tags:
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT, *_TIFF_TILE):
            if tag in found:
                return None
            (kind,) = struct.unpack_from(order + "H", content, place + 2)
            (found[tag],) = struct.unpack_from(order + _TIFF_NUMBERS[kind], content, place + 8)
    tile = math.prod(found.get(tag, 1) for tag in _TIFF_TILE)
    return (found[_TIFF_HEIGHT], found[_TIFF_WIDTH]) if tile <= MAX_PIXELS else None


def _tiff_tags(content: bytes) -> tuple[str, list[tuple[int, int]]]:
    """Return the byte order, and number and place of each tag of the first picture.

    A tag has a number, a type, a count and a value, in twelve bytes.
    """
    order = "<" if content.startswith(b"II") else ">"
    (begin,) = struct.unpack_from(order + "I", content, 4)
    (count,) = struct.unpack_from(order + "H", content, begin)
    places = range(begin + 2, begin + 2 + 12 * count, 12)
    return order, [(struct.unpack_from(order + "H", content, at)[0], at) for at in places]


def _unturned(content: bytes) -> bytes:
    """Return a TIFF, whose header has been read, that asks for no rotation.

    OpenCV has no option for it: it mirrors orientations 2 to 4 and swaps the sides of the others.
    """
    order, tags = _tiff_tags(content)
    places = [place for tag, place in tags if tag == _TIFF_ORIENTATION]
    if not places:
        return content
    changed = bytearray(content)
    for place in places:
        struct.pack_into(order + "HHIHH", changed, place, _TIFF_ORIENTATION, 3, 1, 1, 0)
    return bytes(changed)


def _webp(content: bytes) -> tuple[int, int] | None:
    """Read the size of the picture behind the chunks of an extended file; None for an animation."""
    if content[8:12] != b"WEBP":
        return None
    canvas, position = None, 12
    for _ in range(_MOST_PARTS):
        kind, length = struct.unpack_from("<4sI", content, position)
        data = position + 8
        if kind == b"VP8X":
            width, height = (
                int.from_bytes(content[at : at + 3], "little") + 1 for at in (data + 4, data + 7)
            )
            canvas = height, width
        elif kind == b"VP8 ":
            width, height = struct.unpack_from("<HH", content, data + 6)
            size = height & 0x3FFF, width & 0x3FFF
            break
        elif kind == b"VP8L":
            (bits,) = struct.unpack_from("<I", content, data + 1)
            size = (bits >> 14 & 0x3FFF) + 1, (bits & 0x3FFF) + 1
            break
        position = data + length + length % 2
    else:
        return None
    return size if canvas in (None, size) else None


_FORMATS: tuple[tuple[bytes, Callable[[bytes], tuple[int, int] | None]], ...] = (
    (JPEG_START, _jpeg),
    (b"\x89PNG\r\n\x1a\n", _png),
    (b"BM", _bmp),
    (b"P", _pnm),
    *((start, _tiff) for start in _TIFF_STARTS),
    (b"RIFF", _webp),
)
