"""Bundle signatures (Ed25519) and protection against older versions.

Digests show that a bundle is intact, not who made it. ``signature.json`` signs the bundle's name, a
version and the sha256 of ``calibration.json``, which contains the sha256 of the model. A device
records the highest version that it has run of each name and rejects older ones, even if their
signature is valid.

Signatures follow RFC 8032 and need ``cryptography`` (extra ``[sign]``).
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from cvo_edge.bundle.format import Calibration, Sha256, Text
from cvo_edge.errors import BundleMismatchError, SinkError, UsageError
from cvo_edge.files import own_folder, read_regular_file, write_whole

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

SIGNATURE_FILE = "signature.json"
STATE_VARIABLE = "CVO_EDGE_STATE"
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


@dataclass
class Trust:
    """Accept bundles that are signed with one key and not older than those this device has run.

    ``accepted`` is the name and version of the bundle that was checked last.
    """

    key: Ed25519PublicKey
    versions: Versions
    accepted: tuple[str, int] | None = None

    @classmethod
    def in_key(cls, path: Path) -> Trust:
        """Read a public key from a PEM file, and use this device's record of versions.

        Raises UsageError if it is not an Ed25519 key or ``cryptography`` is not installed.
        """
        return cls(_public_key(path), Versions.default())

    @property
    def key_sha256(self) -> str:
        """The sha256 of the public key's 32 bytes."""
        return hashlib.sha256(self.key.public_bytes_raw()).hexdigest()

    def check(self, folder: Path, calibration: Calibration, content: bytes) -> None:
        """Check a bundle's signature and version; ``content`` holds its ``calibration.json``.

        Raises BundleMismatchError if the bundle is not signed, was altered after signing, is signed
        with another key, or is older than a version that this device has run.
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
        highest = self.versions.highest(self.key_sha256, name)
        if signature.version < highest:
            raise BundleMismatchError(
                f"{path}: expected version {highest} or later of {name}, because this device has "
                f"run version {highest}, found {signature.version}"
            )
        self.accepted = name, signature.version

    def remember(self) -> None:
        """Record the accepted version, so that older ones are rejected from now on.

        Raises SinkError if the record cannot be written.
        """
        if self.accepted is not None:
            self.versions.raise_to(self.key_sha256, *self.accepted)


@dataclass(frozen=True)
class Versions:
    """Record of the highest version that this device has run, by key and bundle name."""

    path: Path

    @classmethod
    def default(cls) -> Versions:
        """Use ``versions.json`` in ``$CVO_EDGE_STATE``, or in the user's XDG state folder.

        Raises UsageError if the variable holds a relative path.
        """
        folder = own_folder(STATE_VARIABLE, "XDG_STATE_HOME", "~/.local/state")
        return cls(folder / "versions.json")

    def highest(self, key: str, name: str) -> int:
        """Return the highest version that this device has run, or 0.

        Raises BundleMismatchError if the file exists but is damaged: ignoring it would let older
        versions run again.
        """
        return self._read().get(key, {}).get(name, 0)

    def raise_to(self, key: str, name: str, version: int) -> None:
        """Record a version, unless a higher one is recorded; raises SinkError on failure."""
        if version <= self.highest(key, name):
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self._alone():
                known = self._read()
                of_key = known.setdefault(key, {})
                of_key[name] = max(version, of_key.get(name, 0))
                self._write(known)
        except OSError as error:
            raise SinkError(
                f"{self.path}: cannot record the bundle's version: {error.strerror}"
            ) from None

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """Lock out other processes during an update; the lock ends with the process."""
        with (self.path.parent / "versions.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield

    def _read(self) -> dict[str, dict[str, int]]:
        try:
            content = self.path.read_bytes()
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise BundleMismatchError(
                f"{self.path}: cannot read the versions that this device has run: {error.strerror}"
            ) from None
        try:
            return msgspec.json.decode(content, type=dict[str, dict[str, int]])
        except _UNDECODABLE:
            raise BundleMismatchError(
                f"{self.path}: the record of versions that this device has run is damaged; if you "
                "delete it, older versions are accepted again"
            ) from None

    def _write(self, known: dict[str, dict[str, int]]) -> None:
        """Replace the file atomically, even if the power fails."""
        write_whole(self.path, json.dumps(known, indent=1), durable=True)


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
