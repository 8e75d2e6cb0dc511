"""Read and write bundle folders: strict JSON, digests, errors that name the key and the rule.

Both packages read and write bundles only through this module.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from cvo_edge.bundle.format import CALIBRATION_FILE, MODEL_FILE, Calibration, one_line, shown
from cvo_edge.bundle.rules import check_rules
from cvo_edge.errors import BundleMismatchError, CalibrationFileError, ModelError
from cvo_edge.files import read_regular_file, regular_file

SCHEMA_VERSION = 1
# Placeholder for the digest of a calibration that has not been written.
UNWRITTEN = "0" * 64
MAX_CALIBRATION_BYTES = 64 * 1024
MAX_MODEL_BYTES = 1 << 30
MAX_DEPTH = 16


# An additional check of a bundle, given its folder, its calibration and the file's bytes.
Check = Callable[[Path, Calibration, bytes], None]


def read_model(folder: Path, calibration: Calibration) -> bytes:
    """Read ``model.onnx`` once and return the bytes whose digest was checked.

    Raises ModelError if the file is missing, not a regular file or too large, and
    BundleMismatchError if it is not the calibrated model.
    """
    path = folder / MODEL_FILE
    model = read_regular_file(path, MAX_MODEL_BYTES, ModelError)
    _check_model_digest(path, hashlib.sha256(model).hexdigest(), calibration)
    return model


def check_model_file(folder: Path, calibration: Calibration) -> None:
    """Check the model file without keeping its contents; raises as ``read_model``."""
    path = folder / MODEL_FILE
    with regular_file(path, MAX_MODEL_BYTES, ModelError) as stream:
        try:
            found = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as failure:
            raise ModelError(f"{path}: cannot be read: {failure.strerror}") from None
    _check_model_digest(path, found, calibration)


def _check_model_digest(path: Path, found: str, calibration: Calibration) -> None:
    if found != calibration.model.sha256:
        raise BundleMismatchError(
            f"{path}: expected sha256 {calibration.model.sha256} (from {CALIBRATION_FILE}), "
            f"found {found}; copy the bundle again"
        )


def read_calibration(folder: str | os.PathLike[str]) -> Calibration:
    """Read and check the ``calibration.json`` of a bundle; raises CalibrationFileError."""
    return read_calibration_file(folder)[0]


def read_calibration_file(folder: str | os.PathLike[str]) -> tuple[Calibration, bytes]:
    """Do the same as ``read_calibration``, and return the file's bytes for signature checks."""
    # Path.is_dir() raises for a name that is too long.
    if not os.path.isdir(folder):  # noqa: PTH112
        raise CalibrationFileError(
            f"{folder}: no such folder; expected a bundle with {CALIBRATION_FILE} and {MODEL_FILE}"
        )
    path = Path(folder) / CALIBRATION_FILE
    content = read_regular_file(path, MAX_CALIBRATION_BYTES, CalibrationFileError)
    return decode_calibration(content, str(path)), content


def decode_calibration(content: bytes, where: str = CALIBRATION_FILE) -> Calibration:
    """Parse and check the bytes of ``calibration.json``; ``where`` names them in errors.

    The checks run in this order: encoding, JSON, version, digest, structure, rules between keys.
    Raises CalibrationFileError.
    """
    try:
        document = _parse_json(content)
        version = document.get("schema_version")
        if type(version) is not int or version != SCHEMA_VERSION:
            raise CalibrationFileError(
                f"schema_version: expected {SCHEMA_VERSION}, found {shown(version)}; "
                "a newer file needs a newer cvo-edge"
            )
        _check_digest(content)
        calibration = msgspec.convert(document, Calibration, strict=True)
        check_rules(calibration)
        # A JSON escape can encode half of a surrogate pair, which cannot be printed.
        json.dumps(document, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise CalibrationFileError(f"{where}: contains an unpaired UTF-16 surrogate") from None
    except CalibrationFileError as error:
        raise CalibrationFileError(f"{where}: {error}") from None
    except msgspec.ValidationError as error:
        raise CalibrationFileError(f"{where}: {one_line(str(error))}") from None
    return calibration


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


def encode_calibration(calibration: Calibration) -> bytes:
    """Return the bytes of ``calibration.json`` with the digest filled in.

    The bytes are decoded again before they are returned, so that every written file is readable.
    Raises CalibrationFileError.
    """
    blank = msgspec.structs.replace(calibration, digest=UNWRITTEN)
    text = json.dumps(msgspec.to_builtins(blank), indent=1, ensure_ascii=False, allow_nan=False)
    # Each list of numbers goes on one line, to keep the file readable.
    text = re.sub(r"\[\s+([^\[\]{}\"]*?)\s+\]", _joined, text) + "\n"
    content = text.encode("utf-8")
    start, stop = _digest_span(content)
    digest = hashlib.sha256(content).hexdigest().encode()
    content = content[:start] + digest + content[stop:]
    if len(content) > MAX_CALIBRATION_BYTES:
        raise CalibrationFileError(
            f"{CALIBRATION_FILE}: expected at most {MAX_CALIBRATION_BYTES} bytes, "
            f"found {len(content)}"
        )
    decode_calibration(content)
    return content


def _joined(match: re.Match[str]) -> str:
    return "[" + " ".join(match.group(1).split()) + "]"


def _digest_span(content: bytes) -> tuple[int, int]:
    # A quotation mark inside a JSON string is escaped, so only real keys match.
    spans = [match.span(1) for match in _DIGEST.finditer(content)]
    if len(spans) != 1:
        raise CalibrationFileError(
            f"digest: expected one key with 64 hexadecimal digits, found {len(spans)} keys; "
            "copy the bundle again"
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
            "the file was altered: copy the bundle again"
        )
