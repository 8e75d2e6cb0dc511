"""Who made a bundle: an Ed25519 signature beside it, and versions that only grow on a device.

Digests say that a bundle is whole, not whose it is. ``signature.json`` signs the sha256 of the
whole ``calibration.json``, which names that of the model, with the bundle's name and a version. A
device remembers the highest version of each name that it has run: an older bundle, however well
signed, is not taken any more.

Signatures are made and checked by ``cryptography`` (extra ``[sign]``); RFC 8032.
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
# Seconds since 1970 are versions, too, for a long time.
HIGHEST_VERSION = 2**53


class Signature(Struct, frozen=True, forbid_unknown_fields=True):
    """The whole of ``signature.json``.

    ``key`` is the sha256 of the public key's 32 bytes, to say which one is needed; the signature
    itself decides. ``signature`` is of ``message``, 64 bytes in hexadecimal digits.
    """

    schema_version: Literal[1]
    name: Text
    version: Annotated[int, Meta(ge=1, le=HIGHEST_VERSION)]
    calibration_sha256: Sha256
    key: Sha256
    signature: Annotated[str, Meta(pattern="^[0-9a-f]{128}$(?!\n)")]


def message(name: str, version: int, calibration_sha256: str) -> bytes:
    """Return what is signed. A name has no line breaks, so that no two bundles share a message."""
    return f"cvo-edge bundle 1\n{name}\n{version}\n{calibration_sha256}\n".encode()


@dataclass
class Trust:
    """Bundles signed with one key, in versions that this device has not gone beyond.

    ``accepted`` is name and version of the bundle that was checked last.
    """

    key: Ed25519PublicKey
    versions: Versions
    accepted: tuple[str, int] | None = None

    @classmethod
    def in_key(cls, path: Path) -> Trust:
        """Read a public key (PEM), and use this device's record of versions.

        Raises UsageError where it is no Ed25519 public key, or ``cryptography`` is not installed.
        """
        return cls(_public_key(path), Versions.default())

    @property
    def key_sha256(self) -> str:
        """The sha256 of the public key's 32 bytes."""
        return hashlib.sha256(self.key.public_bytes_raw()).hexdigest()

    def check(self, folder: Path, calibration: Calibration, content: bytes) -> None:
        """Check the signature of these bytes of a ``calibration.json``, and the bundle's version.

        Raises BundleMismatchError for a bundle that is not signed, was altered after it, is signed
        with another key, or is older than one that this device has run.
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
                f"{path}: expected a signature of {name}, calibration.json with sha256 {found}, "
                f"found one of {signature.name}, {signature.calibration_sha256}"
            )
        signed = message(name, signature.version, found)
        try:
            self.key.verify(bytes.fromhex(signature.signature), signed)
        except InvalidSignature:
            raise BundleMismatchError(
                f"{path}: expected a signature of {name} in version {signature.version}, found one "
                "that does not fit it"
            ) from None
        highest = self.versions.highest(self.key_sha256, name)
        if signature.version < highest:
            raise BundleMismatchError(
                f"{path}: expected version {highest} of {name} or a later one, as this device has "
                f"run it, found {signature.version}"
            )
        self.accepted = name, signature.version

    def remember(self) -> None:
        """Take no older version of the accepted bundle from now on.

        Raises SinkError where that cannot be written down.
        """
        if self.accepted is not None:
            self.versions.raise_to(self.key_sha256, *self.accepted)


@dataclass(frozen=True)
class Versions:
    """The highest version of each bundle by key and name, in a file of this device."""

    path: Path

    @classmethod
    def default(cls) -> Versions:
        """``versions.json`` in ``$CVO_EDGE_STATE``, or in cvo-edge's folder of the user's state.

        Raises UsageError for a relative path in that variable.
        """
        folder = own_folder(STATE_VARIABLE, "XDG_STATE_HOME", "~/.local/state")
        return cls(folder / "versions.json")

    def highest(self, key: str, name: str) -> int:
        """Return the highest version that was run, 0 if none was.

        Raises BundleMismatchError where the file is there and cannot be understood: a record that
        may be anything protects from nothing.
        """
        return self._read().get(key, {}).get(name, 0)

    def raise_to(self, key: str, name: str, version: int) -> None:
        """Put down a version, unless a higher one is; raises SinkError where it cannot be kept."""
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
                f"{self.path}: the version that was run cannot be kept: {error.strerror}"
            ) from None

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """Two processes do not read and write in turns; the lock ends with its process."""
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
                f"{self.path}: expected the versions that this device has run, found it "
                f"unreadable: {error.strerror}"
            ) from None
        try:
            return msgspec.json.decode(content, type=dict[str, dict[str, int]])
        except _UNDECODABLE:
            raise BundleMismatchError(
                f"{self.path}: expected the versions that this device has run, found something "
                "else; without it, removed by hand, any version is taken once more"
            ) from None

    def _write(self, known: dict[str, dict[str, int]]) -> None:
        """The whole new file or the old one, also after a loss of power."""
        write_whole(self.path, json.dumps(known, indent=1), durable=True)


def _read_signature(path: Path) -> Signature:
    content = read_regular_file(path, _MAX_SIGNATURE_BYTES, BundleMismatchError)
    try:
        return msgspec.json.decode(content, type=Signature, strict=True)
    except _UNDECODABLE as error:
        raise BundleMismatchError(f"{path}: expected a signature, found none: {error}") from None


def _public_key(path: Path) -> Ed25519PublicKey:
    try:
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
        from cryptography.hazmat.primitives.serialization import load_pem_public_key
    except ImportError:
        raise UsageError(
            "public key: expected the extra [sign] (pip install 'cvo-edge[sign]'), found no "
            "cryptography"
        ) from None
    # Secrets are often mounted as links.
    content = read_regular_file(path, MAX_KEY_BYTES, UsageError, links=True)
    try:
        key = load_pem_public_key(content)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        key = None
    if not isinstance(key, Ed25519PublicKey):
        raise UsageError(f"{path}: expected an Ed25519 public key in PEM form, found none")
    return key
