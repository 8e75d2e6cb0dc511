"""Signing a bundle: the private key's side of ``cvo_edge.bundle.signature``."""

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

# An encrypted key's passphrase, in the environment: on a command line others would see it.
PASSPHRASE = "CVO_SIGNING_PASSPHRASE"  # noqa: S105 - its name


def sign(folder: Path, key: Path, version: int | None = None) -> Signature:
    """Sign a bundle with an Ed25519 private key (PEM), in place of any signature it has.

    Parameters
    ----------
    folder
        The bundle; read and checked as a device does it.
    key
        PEM file; the passphrase of an encrypted one is taken from ``CVO_SIGNING_PASSPHRASE``.
    version
        A device that has run one refuses lower ones of the same name; by default the seconds since
        1970.

    Raises
    ------
    UsageError
        No such key, or a version out of range.
    CalibrationFileError, ModelError, BundleMismatchError
        No bundle that a device would read.
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
            "sign: expected the extra [sign] (pip install 'cvo-edge[sign]'), found no cryptography"
        ) from None
    passphrase = os.environ.get(PASSPHRASE)
    try:
        private = load_pem_private_key(
            read_regular_file(path, MAX_KEY_BYTES, UsageError, links=True),
            passphrase.encode() if passphrase else None,
        )
    except TypeError:
        raise UsageError(
            f"{path}: expected {PASSPHRASE} to be set for an encrypted key and for no other, found "
            f"it {'set' if passphrase else 'not set'}"
        ) from None
    except (ValueError, UnsupportedAlgorithm):
        raise UsageError(
            f"{path}: expected an Ed25519 private key in PEM form and its passphrase, found none"
        ) from None
    if not isinstance(private, Ed25519PrivateKey):
        raise UsageError(f"{path}: expected an Ed25519 private key, found one of another kind")
    return private
