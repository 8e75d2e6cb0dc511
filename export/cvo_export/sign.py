"""Sign bundles with a private key; ``cvo_edge.bundle.signature`` verifies the signatures."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from cvo_edge.bundle.format import Calibration
from cvo_edge.bundle.signature import (
    HIGHEST_VERSION,
    MAX_KEY_BYTES,
    SIGNATURE_FILE,
    Signature,
    message,
)
from cvo_edge.engine.loading import read_bundle
from cvo_edge.errors import UsageError
from cvo_edge.files import read_regular_file
from cvo_export.files import write_json

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

# An environment variable, because other users could see a passphrase on the command line.
PASSPHRASE = "CVO_SIGNING_PASSPHRASE"  # noqa: S105 - the variable's name, not a passphrase


def sign(folder: Path, key: Path, version: int | None = None) -> Signature:
    """Sign a bundle with an Ed25519 private key (PEM); replaces any existing signature.

    Parameters
    ----------
    folder
        The bundle; it is read and checked in the same way as on a device.
    key
        PEM file; ``CVO_SIGNING_PASSPHRASE`` gives the passphrase of an encrypted key.
    version
        A device that has run this version refuses lower versions of the same name. None: the
        seconds since 1970.

    Raises
    ------
    UsageError
        The key cannot be read, or the version is out of range.
    CalibrationFileError, ModelError, BundleMismatchError
        A device would refuse the bundle.
    SinkError
        The signature cannot be written.
    """
    version = int(time.time()) if version is None else version
    if not 1 <= version <= HIGHEST_VERSION:
        raise UsageError(f"version: expected 1 to {HIGHEST_VERSION}, found {version}")
    private = _private_key(key)
    digests = []

    def take(_: Path, __: Calibration, content: bytes) -> None:
        digests.append(hashlib.sha256(content).hexdigest())

    calibration = read_bundle(folder, check=take).calibration
    (digest,) = digests
    signature = Signature(
        schema_version=1,
        name=calibration.name,
        version=version,
        calibration_sha256=digest,
        key=hashlib.sha256(private.public_key().public_bytes_raw()).hexdigest(),
        signature=private.sign(message(calibration.name, version, digest)).hex(),
    )
    write_json(folder / SIGNATURE_FILE, msgspec.to_builtins(signature))
    return signature


def _private_key(path: Path) -> Ed25519PrivateKey:
    try:
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
        from cryptography.hazmat.primitives.serialization import load_pem_private_key
    except ImportError:
        raise UsageError(
            "sign: the package cryptography is not installed; pip install 'cvo-edge[sign]'"
        ) from None
    passphrase = os.environ.get(PASSPHRASE)
    try:
        private = load_pem_private_key(
            read_regular_file(path, MAX_KEY_BYTES, UsageError, links=True),
            passphrase.encode() if passphrase else None,
        )
    except TypeError:
        raise UsageError(
            f"{path}: the key is not encrypted, but {PASSPHRASE} is set; unset it"
            if passphrase
            else f"{path}: the key is encrypted; set {PASSPHRASE} to its passphrase"
        ) from None
    except (ValueError, UnsupportedAlgorithm):
        raise UsageError(
            f"{path}: expected an Ed25519 private key in PEM form, with the right passphrase if "
            "it is encrypted; the file cannot be decoded"
        ) from None
    if not isinstance(private, Ed25519PrivateKey):
        raise UsageError(f"{path}: expected an Ed25519 private key, found another type of key")
    return private
