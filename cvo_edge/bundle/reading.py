"""Reading and writing a bundle folder: strict JSON, digests, and errors that name key and rule.

Both sides of the project read and write bundles through this module alone.
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
# Stands for the digest of a calibration that has not been written.
UNWRITTEN = "0" * 64
MAX_CALIBRATION_BYTES = 64 * 1024
MAX_MODEL_BYTES = 1 << 30
MAX_DEPTH = 16


# What else must hold for a bundle, of its folder, its calibration and the bytes it was read from.
Check = Callable[[Path, Calibration, bytes], None]


def read_model(folder: Path, calibration: Calibration) -> bytes:
    """Read ``model.onnx`` once; returns the very bytes whose digest matches the calibration's.

    Raises ModelError where the file is missing, not a regular one or too large, and
    BundleMismatchError where it is not the calibrated model.
    """
    path = folder / MODEL_FILE
    model = read_regular_file(path, MAX_MODEL_BYTES, ModelError)
    _check_model_digest(path, hashlib.sha256(model).hexdigest(), calibration)
    return model


def check_model_file(folder: Path, calibration: Calibration) -> None:
    """Raise as ``read_model`` where a model file is not the calibrated one, keeping none of it."""
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
            f"found {found}"
        )


def read_calibration(folder: str | os.PathLike[str]) -> Calibration:
    """Read and check ``calibration.json`` of a bundle folder; raises CalibrationFileError."""
    return read_calibration_file(folder)[0]


def read_calibration_file(folder: str | os.PathLike[str]) -> tuple[Calibration, bytes]:
    """Return also the file's bytes, for a signature; else as ``read_calibration``."""
    # Not is_dir(): it raises for a name that is too long.
    if not os.path.isdir(folder):  # noqa: PTH112
        raise CalibrationFileError(f"{folder}: expected a bundle folder, found none")
    path = Path(folder) / CALIBRATION_FILE
    content = read_regular_file(path, MAX_CALIBRATION_BYTES, CalibrationFileError)
    return decode_calibration(content, str(path)), content


def decode_calibration(content: bytes, where: str = CALIBRATION_FILE) -> Calibration:
    """Bytes of ``calibration.json`` -> Calibration; ``where`` names them in errors.

    The order of the checks is that of the trust they need: encoding, JSON, version, digest,
    structure, then the rules between keys. Raises CalibrationFileError.
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
        # JSON can say half of a surrogate pair, which nobody can print.
        json.dumps(document, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise CalibrationFileError(f"{where}: expected characters, found half of one") from None
    except CalibrationFileError as error:
        raise CalibrationFileError(f"{where}: {error}") from None
    except msgspec.ValidationError as error:
        raise CalibrationFileError(f"{where}: {one_line(str(error))}") from None
    return calibration


def _parse_json(content: bytes) -> dict[str, Any]:
    """Strict JSON: UTF-8 without BOM, one object, no duplicate key, every number finite."""
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
            f"expected UTF-8, found byte {error.start} that is not"
        ) from None
    except json.JSONDecodeError as error:
        raise CalibrationFileError(
            f"expected JSON, found an error in line {error.lineno} column {error.colno}: "
            f"{error.msg}"
        ) from None
    if not isinstance(document, dict):
        raise CalibrationFileError(f"expected one JSON object, found {type(document).__name__}")
    return document


def _depth(content: bytes) -> int:
    """Deepest nesting of brackets, counted before parsing; brackets in strings count as well."""
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
        raise CalibrationFileError(f"expected at most 20 digits, found a number of {len(text)}")
    return int(text)


_DIGEST = re.compile(rb'"digest"\s*:\s*"([0-9a-f]{64})"')


def encode_calibration(calibration: Calibration) -> bytes:
    """Calibration -> the bytes of ``calibration.json`` with its own digest filled in.

    What was written is read back before it is returned, so that nothing the reader would refuse
    is ever written. Raises CalibrationFileError.
    """
    blank = msgspec.structs.replace(calibration, digest=UNWRITTEN)
    text = json.dumps(msgspec.to_builtins(blank), indent=1, ensure_ascii=False, allow_nan=False)
    # One line a list of numbers: the file is read by people, too.
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
            f"digest: expected one key with 64 hexadecimal digits, found {len(spans)}"
        )
    return spans[0]


def _check_digest(content: bytes) -> None:
    start, stop = _digest_span(content)
    blank = content[:start] + UNWRITTEN.encode() + content[stop:]
    expected = hashlib.sha256(blank).hexdigest()
    found = content[start:stop].decode("ascii")
    if found != expected:
        raise CalibrationFileError(
            f"digest: expected {expected} for these bytes, found {found}; the file was altered"
        )
