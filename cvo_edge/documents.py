"""Strict JSON files that carry their own digest: ``calibration.json`` and ``motion.json``.

A file is one JSON object in UTF-8 without a byte order mark, with each key once, finite numbers
only, and bounded nesting. ``digest`` is the SHA-256 of the file with 64 zeros in its place.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import msgspec
from msgspec import Struct

from cvo_edge.errors import CalibrationFileError

# Placeholder for the digest of a file that has not been written.
UNWRITTEN = "0" * 64
MAX_DEPTH = 16

Document = TypeVar("Document", bound=Struct)

_LONGEST = 160


def decode_document(
    content: bytes,
    kind: type[Document],
    versions: Sequence[int],
    where: str,
    check: Callable[[Document], None],
) -> Document:
    """Parse and check the bytes of a file; ``where`` names them in errors.

    The checks run in this order: encoding, JSON, version, digest, structure, rules between keys
    (``check``). Raises CalibrationFileError.
    """
    try:
        document = _parse_json(content)
        found = document.get("schema_version")
        if type(found) is not int or found not in versions:
            newer = type(found) is int and found > max(versions)
            remedy = "a newer file needs a newer cvo-edge" if newer else "make the file again"
            raise CalibrationFileError(
                f"schema_version: expected {_either(versions)}, found {shown(found)}; {remedy}"
            )
        _check_digest(content)
        decoded = msgspec.convert(document, kind, strict=True)
        check(decoded)
        # A JSON escape can encode half of a surrogate pair, which cannot be printed.
        json.dumps(document, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise CalibrationFileError(f"{where}: contains an unpaired UTF-16 surrogate") from None
    except CalibrationFileError as error:
        raise CalibrationFileError(f"{where}: {error}") from None
    except msgspec.ValidationError as error:
        raise CalibrationFileError(f"{where}: {one_line(str(error))}") from None
    return decoded


def encode_document(document: Struct, limit: int, name: str, *, dense: bool = False) -> bytes:
    """Return the bytes of a file of at most ``limit`` bytes, with the digest filled in.

    ``dense``: without blanks, which are a fifth of a file of numbers. Raises CalibrationFileError.
    """
    blank = msgspec.structs.replace(document, digest=UNWRITTEN)
    text = json.dumps(
        msgspec.to_builtins(blank),
        indent=0 if dense else 1,
        separators=(",", ":" if dense else ": "),
        ensure_ascii=False,
        allow_nan=False,
    )
    # Each list of numbers goes on one line, to keep the file readable.
    joined = partial(_joined, blank="" if dense else " ")
    text = re.sub(r"\[\s+([^\[\]{}\"]*?)\s+\]", joined, text) + "\n"
    if dense:
        # So do objects without others. Strings have no line breaks: these are escaped.
        text = re.sub(r"\{\n[^{}]*\n\}", lambda match: match[0].replace("\n", ""), text)
    content = text.encode("utf-8")
    start, stop = _digest_span(content)
    digest = hashlib.sha256(content).hexdigest().encode()
    content = content[:start] + digest + content[stop:]
    if len(content) > limit:
        raise CalibrationFileError(f"{name}: expected at most {limit} bytes, found {len(content)}")
    return content


def _either(versions: Sequence[int]) -> str:
    """Return numbers as text: ``1``, ``1 or 2``, ``1, 2 or 3``."""
    *others, last = map(str, versions)
    return f"{', '.join(others)} or {last}" if others else last


def _parse_json(content: bytes) -> dict[str, Any]:
    """Parse strict JSON: UTF-8 without BOM, one object, no duplicate keys, finite numbers only."""
    if content.startswith(b"\xef\xbb\xbf"):
        raise CalibrationFileError("expected UTF-8 without a byte order mark, found one")
    if _depth(content) > MAX_DEPTH:
        raise CalibrationFileError(f"expected at most {MAX_DEPTH} nested levels, found more")
    try:
        document = json.loads(
            content.decode("utf-8"),
            object_pairs_hook=_without_duplicates,
            parse_constant=_refuse_constant,
            parse_float=_finite_float,
            parse_int=_bounded_int,
        )
    except UnicodeDecodeError as error:
        raise CalibrationFileError(
            f"expected UTF-8, found an invalid byte at offset {error.start}"
        ) from None
    except json.JSONDecodeError as error:
        raise CalibrationFileError(
            f"expected JSON, found a syntax error in line {error.lineno} column {error.colno}: "
            f"{error.msg}"
        ) from None
    if not isinstance(document, dict):
        raise CalibrationFileError(f"expected one JSON object, found {type(document).__name__}")
    return document


def _depth(content: bytes) -> int:
    """Return the deepest nesting of brackets, including those in strings, without parsing."""
    deepest = depth = 0
    for byte in content:
        if byte in b"[{":
            depth += 1
            deepest = max(deepest, depth)
        elif byte in b"]}":
            depth -= 1
    return deepest


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys: dict[str, Any] = {}
    for key, value in pairs:
        if key in keys:
            raise CalibrationFileError(f"expected each key once, found {shown(key)} twice")
        keys[key] = value
    return keys


def _refuse_constant(name: str) -> float:
    raise CalibrationFileError(f"expected finite numbers, found {name}")


def _finite_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise CalibrationFileError(f"expected finite numbers, found {shown(text)}")
    return value


def _bounded_int(text: str) -> int:
    if len(text) > 20:
        raise CalibrationFileError(f"expected integers of at most 20 digits, found {len(text)}")
    return int(text)


_DIGEST = re.compile(rb'"digest"\s*:\s*"([0-9a-f]{64})"')


def _joined(match: re.Match[str], blank: str) -> str:
    return "[" + blank.join(match.group(1).split()) + "]"


def _digest_span(content: bytes) -> tuple[int, int]:
    # A quotation mark inside a JSON string is escaped, so only real keys match.
    spans = [match.span(1) for match in _DIGEST.finditer(content)]
    if len(spans) != 1:
        raise CalibrationFileError(
            f"digest: expected one key with 64 hexadecimal digits, found {len(spans)} keys; "
            "copy the file again"
        )
    return spans[0]


def _check_digest(content: bytes) -> None:
    start, stop = _digest_span(content)
    blank = content[:start] + UNWRITTEN.encode() + content[stop:]
    expected = hashlib.sha256(blank).hexdigest()
    found = content[start:stop].decode("ascii")
    if found != expected:
        raise CalibrationFileError(
            f"digest: expected {expected} for these bytes, found {found}; "
            "the file was altered: copy it again"
        )


def shown(value: object) -> str:
    """Return the repr of a value as one line of bounded length, for an error message."""
    return one_line(repr(value))


def one_line(text: str) -> str:
    """Return a text as one line of at most 160 characters."""
    line = " ".join(text.split())
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 3]}..."
