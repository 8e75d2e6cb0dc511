"""What a device remembers of the signed bundles that it has run, in ``$CVO_EDGE_STATE``.

Three files, each by the sha256 of a public key: ``versions.json`` has the highest version of each
bundle's name, ``names.json`` the name of the bundle in each folder, and ``prepared.json`` the
digest of the optimised form of each model that this device has made of signed bytes. Whoever can
write to these files can undo what they protect from, so that they are refused if other users can.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import stat
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec

from cvo_edge.errors import BundleMismatchError, SinkError
from cvo_edge.files import own_folder, untrusted, write_whole

STATE_VARIABLE = "CVO_EDGE_STATE"
VERSIONS_FILE, NAMES_FILE, PREPARED_FILE = "versions.json", "names.json", "prepared.json"
_LOCK_FILE = "versions.lock"
_UNDECODABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
# Updates take milliseconds.
_PATIENCE_S, _PAUSE_S = 10.0, 0.05

Value = TypeVar("Value", int, str)


@dataclass(frozen=True)
class DeviceRecord:
    """The record in a folder; ``patience_s`` limits the wait for another process's update."""

    folder: Path
    patience_s: float = _PATIENCE_S

    @classmethod
    def default(cls) -> DeviceRecord:
        """Use ``$CVO_EDGE_STATE``, or ``cvo-edge`` in the user's XDG state folder.

        Raises UsageError if the variable holds a relative path.
        """
        return cls(own_folder(STATE_VARIABLE, "XDG_STATE_HOME", "~/.local/state"))

    def highest(self, key: str, name: str) -> int:
        """Return the highest version that this device has run, or 0.

        Raises BundleMismatchError if the file exists but is damaged or others can write to it:
        ignoring it would let older versions run again.
        """
        return self._read(VERSIONS_FILE, int).get(key, {}).get(name, 0)

    def raise_to(self, key: str, name: str, version: int) -> None:
        """Record a version, unless a higher one is recorded; raises SinkError on failure."""
        if version <= self.highest(key, name):
            return
        with self._updated(VERSIONS_FILE, int) as known:
            of_key = known.setdefault(key, {})
            of_key[name] = max(version, of_key.get(name, 0))

    def name_in(self, key: str, folder: str) -> str | None:
        """Return the name of the bundle in a folder; errors as for ``highest``."""
        return self._read(NAMES_FILE, str).get(key, {}).get(folder)

    def keep_name(self, key: str, folder: str, name: str) -> None:
        """Record the name of the bundle in a folder; raises SinkError on failure."""
        if self.name_in(key, folder) != name:
            with self._updated(NAMES_FILE, str) as known:
                known.setdefault(key, {})[folder] = name

    def prepared(self, key: str, model_sha256: str) -> str | None:
        """Return the digest of a model's optimised form; errors as for ``highest``."""
        return self._read(PREPARED_FILE, str).get(key, {}).get(model_sha256)

    def keep_prepared(self, key: str, model_sha256: str, digest: str) -> None:
        """Record the digest of a model's optimised form; raises SinkError on failure."""
        with self._updated(PREPARED_FILE, str) as known:
            known.setdefault(key, {})[model_sha256] = digest

    @contextlib.contextmanager
    def _updated(self, file: str, kind: type[Value]) -> Iterator[dict[str, dict[str, Value]]]:
        """Yield the content of a file, and replace it atomically, even if the power fails."""
        path = self.folder / file
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with self._alone():
                known = self._read(file, kind)
                yield known
                write_whole(path, json.dumps(known, indent=1), durable=True, own=True)
        except OSError as error:
            raise SinkError(f"{path}: cannot be recorded: {error.strerror}") from None

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """Lock out other processes during an update; the lock ends with the process.

        The file is private: any user who can open it could hold the lock.
        """
        path = self.folder / _LOCK_FILE
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        descriptor = os.open(path, flags, 0o600)
        try:
            if os.fstat(descriptor).st_mode & 0o077:
                os.fchmod(descriptor, 0o600)
            deadline = time.monotonic() + self.patience_s
            while not _locked(descriptor):
                if time.monotonic() >= deadline:
                    raise SinkError(
                        f"{path}: another process has held this lock for {self.patience_s:g} s; "
                        f"fuser {path} names it"
                    )
                time.sleep(_PAUSE_S)
            yield
        finally:
            os.close(descriptor)

    def _read(self, file: str, kind: type[Value]) -> dict[str, dict[str, Value]]:
        path = self.folder / file
        try:
            self._check_private(path)
            content = path.read_bytes()
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise BundleMismatchError(
                f"{path}: cannot read what this device has run: {error.strerror}"
            ) from None
        try:
            return msgspec.json.decode(content, type=dict[str, dict[str, kind]])  # type: ignore[valid-type]
        except _UNDECODABLE:
            raise BundleMismatchError(
                f"{path}: the record of what this device has run is damaged; if you delete it, "
                "older versions and other bundles are accepted again"
            ) from None

    def _check_private(self, path: Path) -> None:
        """Raise BundleMismatchError if other users can write to the record."""
        # The folder may be a link of the user's.
        for each, found in ((self.folder, self.folder.stat()), (path, path.lstat())):
            if untrusted(found):
                raise BundleMismatchError(
                    f"{each}: expected files that only this user or root can write to, found mode "
                    f"{stat.S_IMODE(found.st_mode):04o} of user {found.st_uid}; others may have "
                    f"changed what this device remembers: check {path.name}, then chmod go-w"
                )


def _locked(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
