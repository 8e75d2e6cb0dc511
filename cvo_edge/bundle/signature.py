"""Bundle signatures (Ed25519), and protection against older versions and exchanged bundles.

Digests show that a bundle is intact, not who made it. ``signature.json`` signs the bundle's name, a
version and the sha256 of ``calibration.json``, which contains the sha256 of the model. A device
records the highest version that it has run of each name, and the name of the bundle in each folder
(``cvo_edge.bundle.device_record``). It rejects older versions, and other bundles in the same place,
even if their signature is valid.

Signatures follow RFC 8032 and need ``cryptography`` (extra ``[sign]``).
"""

from __future__ import annotations

import hashlib
import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import msgspec
from msgspec import Meta, Struct

from cvo_edge.bundle.device_record import DeviceRecord
from cvo_edge.bundle.format import Calibration, Sha256, Text
from cvo_edge.errors import BundleMismatchError, UsageError
from cvo_edge.files import read_regular_file

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

SIGNATURE_FILE = "signature.json"
_MAX_SIGNATURE_BYTES = 4096
MAX_KEY_BYTES = 16384
_UNDECODABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
# Large enough to use Unix timestamps as versions.
HIGHEST_VERSION = 2**53


class Signature(Struct, frozen=True, forbid_unknown_fields=True):
    """The contents of ``signature.json``.

    ``key`` is the sha256 of the public key's 32 bytes; it tells which key is needed and proves
    nothing. ``signature`` is the signature of ``message``, 64 bytes in hexadecimal digits.
    """

    schema_version: Literal[1]
    name: Text
    version: Annotated[int, Meta(ge=1, le=HIGHEST_VERSION)]
    calibration_sha256: Sha256
    key: Sha256
    signature: Annotated[str, Meta(pattern="^[0-9a-f]{128}$(?!\n)")]


def message(name: str, version: int, calibration_sha256: str) -> bytes:
    """Return the signed bytes; names have no line breaks, so no two bundles share a message."""
    return f"cvo-edge bundle 1\n{name}\n{version}\n{calibration_sha256}\n".encode()


class Accepted(NamedTuple):
    """A bundle whose signature is valid: its name, its version, and the folder that it is in."""

    name: str
    version: int
    folder: str


@dataclass
class Trust:
    """Accept bundles that are signed with one key, and are what this device has run before.

    ``name`` is the name that a bundle must have; None stands for the one that this device has run
    from the same folder, if it has. ``accepted`` is the bundle that was checked last.
    """

    key: Ed25519PublicKey
    record: DeviceRecord
    name: str | None = None
    accepted: Accepted | None = None

    @classmethod
    def in_key(cls, path: Path, name: str | None = None) -> Trust:
        """Read a public key from a PEM file, and use this device's record.

        Raises UsageError if it is not an Ed25519 key or ``cryptography`` is not installed.
        """
        return cls(_public_key(path), DeviceRecord.default(), name)

    @property
    def key_sha256(self) -> str:
        """The sha256 of the public key's 32 bytes."""
        return hashlib.sha256(self.key.public_bytes_raw()).hexdigest()

    def check(self, folder: Path, calibration: Calibration, content: bytes) -> None:
        """Check a bundle's signature and version; ``content`` holds its ``calibration.json``.

        Raises BundleMismatchError if the bundle is not signed, was altered after signing, is signed
        with another key, has another name than expected, or is older than a version that this
        device has run.
        """
        from cryptography.exceptions import InvalidSignature

        path, name = folder / SIGNATURE_FILE, calibration.name
        signature = _read_signature(path)
        if signature.key != self.key_sha256:
            raise BundleMismatchError(
                f"{path}: expected a signature with the key {self.key_sha256}, found one with "
                f"{signature.key}"
            )
        found = hashlib.sha256(content).hexdigest()
        if (signature.calibration_sha256, signature.name) != (found, name):
            raise BundleMismatchError(
                f"{path}: expected a signature for {name} with calibration.json sha256 {found}, "
                f"found one for {signature.name} with {signature.calibration_sha256}"
            )
        signed = message(name, signature.version, found)
        try:
            self.key.verify(bytes.fromhex(signature.signature), signed)
        except InvalidSignature:
            raise BundleMismatchError(
                f"{path}: the signature is not valid for {name} version {signature.version}"
            ) from None
        # Not resolved: devices change bundles by a link in the same place.
        place = os.path.abspath(folder)  # noqa: PTH100
        self._check_name(path, place, name)
        highest = self.record.highest(self.key_sha256, name)
        if signature.version < highest:
            raise BundleMismatchError(
                f"{path}: expected version {highest} or later of {name}, because this device has "
                f"run version {highest}, found {signature.version}"
            )
        self.accepted = Accepted(name, signature.version, place)

    def _check_name(self, path: Path, place: str, name: str) -> None:
        """Check that the bundle is the one meant: the key may have signed others, too."""
        if self.name is not None:
            if self.name != name:
                raise BundleMismatchError(f"{path}: expected the bundle {self.name}, found {name}")
            return
        known = self.record.name_in(self.key_sha256, place)
        if known not in (None, name):
            raise BundleMismatchError(
                f"{path}: expected {known}, which this device has run from this folder, found "
                f"{name}; if that is meant, give --name {shlex.quote(name)} once"
            )

    @property
    def is_new(self) -> bool:
        """Whether this device has not run the accepted version from its folder yet."""
        if self.accepted is None:
            return False
        name, version, folder = self.accepted
        key = self.key_sha256
        return version > self.record.highest(key, name) or self.record.name_in(key, folder) != name

    def remember(self) -> None:
        """Record the accepted bundle, so that older versions and others are rejected from now on.

        Raises SinkError if the record cannot be written.
        """
        if self.accepted is not None:
            name, version, folder = self.accepted
            self.record.raise_to(self.key_sha256, name, version)
            self.record.keep_name(self.key_sha256, folder, name)


def _read_signature(path: Path) -> Signature:
    content = read_regular_file(path, _MAX_SIGNATURE_BYTES, BundleMismatchError)
    try:
        return msgspec.json.decode(content, type=Signature, strict=True)
    except _UNDECODABLE as error:
        raise BundleMismatchError(f"{path}: not a valid signature file: {error}") from None


def _public_key(path: Path) -> Ed25519PublicKey:
    try:
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
        from cryptography.hazmat.primitives.serialization import load_pem_public_key
    except ImportError:
        raise UsageError(
            "public key: the package cryptography is not installed; run pip install "
            "'cvo-edge[sign]'"
        ) from None
    # Keys are often mounted as symbolic links.
    content = read_regular_file(path, MAX_KEY_BYTES, UsageError, links=True)
    try:
        key = load_pem_public_key(content)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        key = None
    if not isinstance(key, Ed25519PublicKey):
        raise UsageError(f"{path}: not an Ed25519 public key in PEM format")
    return key
