"""JPEG images decoded at half size: what can give them, and this machine's decoder.

libjpeg-turbo computes 4x4 pixels for each block of 8x8 instead of 8x8, and reads chroma of half the
size as it is. Its results are the same on every processor; other decoders have other rules.
"""

from __future__ import annotations

import hashlib
from base64 import b85decode
from typing import Protocol, runtime_checkable

from cvo_edge.errors import GateError, UsageError
from cvo_edge.input.decoding import decode_image
from cvo_edge.input.frame import Source

# The rings of the self-test image, 41x27, with chroma of half the size, and the digest of the half.
_KNOWN = b85decode(
    "|JeWF01!$>Nk#wx0RR9200961|JwjV01XKW3knDg3knMk4h;_zAQcl55)&sJ9v2`kDKRiEDJ?8BI!Zn>HbyrrEkI"
    "X6ModmpQ&KWMT47pHU`kO^PygEhLjevB4iga*CKVMXPc<zyPft%zPft%zPft%zPft%zPft%zPft%zPft%zPft%zP"
    "ft%zPft%zPft%zPft%zPf!2A01*fP8vrQ-0U`hb5di}c0sq7R7ytnQ0RaI30000000000000C71_1*9!~hx)00RL"
    "50RaF20000000000009F65)mQ)!~hln0RaI30000000000000000|W*C!~ho&0RaI400000000000000000IFK|J"
    "ncy0|5X65d#qbKLE$zOwk-6Gs&Axsa|MYkqKm6vQI{mB!qZ*j!W_en;8k@RPah@T#_%Oa;&g2SR*8c#V>^PX<j%H"
    "!N{as9XELY*#"
)
_KNOWN_SHA256 = "58a930632f3eac5fb8221fb0855ca633229b5bdcd8a4582cc05861c88ee84108"


@runtime_checkable
class Halving(Protocol):
    """A source whose images may be JPEG images."""

    def halve(self) -> None:
        """Decode at half size from now on; raises UsageError if they are no JPEG images."""


def halve(frames: object) -> None:
    """Let a source decode its images at half size; frames of a caller are as they are.

    Raises UsageError for a source whose images are no JPEG images, or are decoded elsewhere.
    """
    if isinstance(frames, Halving):
        frames.halve()
    elif isinstance(frames, Source):
        raise not_half("a video or a camera")


def not_half(found: str) -> UsageError:
    """Return the error for a source that holds something else than JPEG images."""
    return UsageError(
        "source: expected JPEG files, or a pipe of JPEG images, because the bundle decodes them at "
        f"half size, found {found}; use a bundle that was published with --decode full"
    )


def check_decoder() -> None:
    """Raise GateError if the decoder of this machine gives other half pictures."""
    half = decode_image(_KNOWN, decode="half")
    if half is None or hashlib.sha256(half.tobytes()).hexdigest() != _KNOWN_SHA256:
        raise GateError(
            "self-test: expected a JPEG decoder whose pictures of half size are libjpeg-turbo's, "
            "found other pixels; install OpenCV with libjpeg-turbo, as opencv-python-headless has"
        )
