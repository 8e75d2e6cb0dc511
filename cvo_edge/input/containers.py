"""Recognise video files by their first bytes: containers and raw streams that cameras write.

FFmpeg opens far more than videos: it draws the characters of a text file as pictures, and follows
playlists, whatever the file's name is. Such pictures would get poses.
"""

from __future__ import annotations

from pathlib import Path

from cvo_edge.errors import SourceError
from cvo_edge.input.capture import shown

_START_BYTES = 4096

_Y4M = b"YUV4MPEG2 "  # the only one that begins with a line of text
_STARTS = (
    b"\x1a\x45\xdf\xa3",  # Matroska, WebM
    b"FLV\x01",
    b"OggS",
    b"\x30\x26\xb2\x75\x8e\x66\xcf\x11",  # ASF, WMV
    b"\x06\x0e\x2b\x34\x02\x05\x01\x01",  # MXF
    b"\x1f\x07\x00",  # DV
    b"DKIF",  # IVF
    b"\xff\xd8\xff",  # JPEGs in a row
)
# First boxes of MP4 and QuickTime files, and the brands of files that hold still images.
_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"styp", b"pnot")
_STILL = (b"mif1", b"msf1", b"heic", b"heix", b"hevc", b"hevx", b"avif", b"avis")
# Start codes of MPEG program streams, of MPEG-1, MPEG-2 and MPEG-4 video.
_START_CODES = (0xBA, 0xB3, 0xB0)
# NAL units that begin a stream: parameter sets, delimiters, messages, in H.264 and in H.265.
_H264_UNITS, _H265_UNITS = frozenset((6, 7, 8, 9)), frozenset((32, 33, 34, 35, 39))
# MPEG transport streams: sync byte, length of a packet, and where packets begin (4 with times).
_SYNC, _PACKET, _PACKET_STARTS = 0x47, 188, ((0, 188), (4, 192))
_LEAST_PACKETS = 3


def check_video(path: Path) -> None:
    """Raise SourceError unless a file starts as a video of a camera does."""
    try:
        with path.open("rb") as stream:
            start = stream.read(_START_BYTES)
    except OSError as error:
        raise SourceError(f"{shown(str(path))}: cannot be read: {error.strerror}") from None
    check_start(shown(str(path)), start)


def check_start(name: str, start: bytes) -> None:
    """Raise SourceError unless these first bytes are those of a video of a camera."""
    if not is_video(start):
        raise SourceError(
            f"{name}: expected images or a video (MP4, MOV, MKV, WebM, AVI, MPEG, FLV, "
            f"WMV, Ogg, MXF, DV, IVF, Y4M, H.264, H.265, MJPEG), found {_kind(start)}"
        )


def is_video(start: bytes) -> bool:
    """Whether a file's first bytes (up to 4096 are used) are those of a video."""
    if start.startswith(_Y4M) or _is_text(start):
        return start.startswith(_Y4M)
    return (
        start.startswith(_STARTS)
        or (start.startswith(b"RIFF") and start[8:11] == b"AVI")
        or (start[4:8] in _BOXES and start[8:12] not in _STILL)
        or _is_elementary(start)
        or any(_is_transport(start[at:], length) for at, length in _PACKET_STARTS)
    )


def _is_elementary(start: bytes) -> bool:
    """Whether the start is a start code and a unit that a raw stream begins with."""
    unit = start[3:5] if start.startswith(b"\0\0\1") else start[4:6]
    if not start.startswith((b"\0\0\1", b"\0\0\0\1")) or len(unit) < 2:
        return False
    h264, h265 = unit[0] & 0x1F, unit[0] >> 1
    return (
        unit[0] in _START_CODES
        or (unit[0] < 0x80 and h264 in _H264_UNITS)
        or (h265 in _H265_UNITS and unit[1] == 1)
    )


def _is_transport(start: bytes, length: int) -> bool:
    packets = start[::length] if len(start) > (_LEAST_PACKETS - 1) * length else b""
    return set(packets) == {_SYNC}


def _kind(start: bytes) -> str:
    if not start:
        return "an empty file"
    return "text" if _is_text(start) else "another kind of file"


def _is_text(start: bytes) -> bool:
    return start.startswith((b"\xff\xfe", b"\xfe\xff")) or not any(
        byte < 0x20 and byte not in b"\t\n\v\f\r\x1b" for byte in start
    )
