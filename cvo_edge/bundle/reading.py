"""Read and write bundle folders; errors name the key and the rule.

Both packages read and write bundles only through this module.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

from cvo_edge.bundle.format import CALIBRATION_FILE, MODEL_FILE, Calibration
from cvo_edge.bundle.rules import check_rules
from cvo_edge.documents import decode_document, encode_document
from cvo_edge.errors import BundleMismatchError, CalibrationFileError, ModelError
from cvo_edge.files import read_regular_file, regular_file

SCHEMA_VERSIONS = (1, 2, 3)
MAX_CALIBRATION_BYTES = 64 * 1024
MAX_MODEL_BYTES = 1 << 30


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

    Raises CalibrationFileError.
    """
    return decode_document(content, Calibration, SCHEMA_VERSIONS, where, check_rules)


def encode_calibration(calibration: Calibration) -> bytes:
    """Return the bytes of ``calibration.json`` with the digest filled in.

    The bytes are decoded again before they are returned, so that every written file is readable.
    Raises CalibrationFileError.
    """
    content = encode_document(calibration, MAX_CALIBRATION_BYTES, CALIBRATION_FILE)
    decode_calibration(content)
    return content
