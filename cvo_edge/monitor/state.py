"""The file that keeps an adaptation's state over restarts and power cuts."""

from __future__ import annotations

import fcntl
import math
import os
import weakref
import zlib
from contextlib import suppress
from glob import escape
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from cvo_edge.bundle.format import Calibration, Sha256
from cvo_edge.documents import one_line
from cvo_edge.errors import BundleMismatchError, CalibrationFileError, CvoError, SinkError
from cvo_edge.files import read_regular_file, write_whole
from cvo_edge.given import given_path
from cvo_edge.vocabulary import Scope

# A state has about 500 bytes.
_MOST_BYTES = 1 << 16
_ANOTHER = "give another file, or delete this one to start from the calibrated thresholds"

# Far beyond what any adaptation reaches.
_X = Annotated[float, Meta(ge=-1e3, le=1e3)]


class State(Struct, frozen=True):
    """``x`` of each factor, the number of labels behind them, and whether they are frozen."""

    x: tuple[float, ...]
    labels: int = 0
    frozen: bool = False


class _Stored(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The file: a JSON object with what it belongs to, the state, and a checksum of the rest."""

    schema_version: Literal[1] = 1
    bundle: str
    digest: Sha256
    confidence: float
    scope: Scope
    x: tuple[_X, ...]
    labels: Annotated[int, Meta(ge=0)]
    frozen: bool
    crc32: int = 0

    def encoded(self) -> bytes:
        """Return the file's bytes."""
        plain = msgspec.json.encode(msgspec.structs.replace(self, crc32=0))
        whole = msgspec.structs.replace(self, crc32=zlib.crc32(plain))
        return msgspec.json.encode(whole) + b"\n"


class StateFile:
    """A state file of one bundle, confidence and scope, for one odometer at a time.

    While it is used, ``FILE.lock`` beside it is locked against other odometers; the lock ends with
    the process. Each write replaces the file as a whole and reaches the disk before it returns: a
    kill or a power cut at any point leaves the old state or the new one.

    Parameters
    ----------
    path
        The file; it need not exist.
    calibration, confidence, scope
        What the state belongs to.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        calibration: Calibration,
        confidence: float,
        scope: Scope,
    ) -> None:
        self.path = given_path(path, "state")
        self._name, self._digest = calibration.name, calibration.digest
        self._confidence: float = confidence
        self._scope: Scope = scope
        self._release: weakref.finalize[..., StateFile] | None = None

    def read(self, size: int) -> State | None:
        """Return the stored state of ``size`` factors, or None without a file.

        Raises
        ------
        CalibrationFileError
            The file is damaged, of another version, or cannot be read.
        BundleMismatchError
            It belongs to another bundle, confidence or scope.
        SinkError
            Another odometer uses it.
        """
        self._lock()
        self._sweep()
        if not os.path.lexists(self.path):
            return None
        content = read_regular_file(self.path, _MOST_BYTES, CalibrationFileError)
        try:
            stored = msgspec.json.decode(content, type=_Stored)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise self._damaged(one_line(str(error))) from None
        if stored.encoded() != content:
            raise self._damaged("the checksum does not match")
        if stored.digest != self._digest:
            raise self._other(
                f"bundle {self._name} ({self._digest[:12]})",
                f"{stored.bundle} ({stored.digest[:12]})",
            )
        wanted, found = (self._confidence, self._scope), (stored.confidence, stored.scope)
        if wanted != found:
            raise self._other(*(f"{confidence:g} {scope}" for confidence, scope in (wanted, found)))
        if len(stored.x) != size or not all(map(math.isfinite, stored.x)):
            raise self._damaged(f"expected {size} finite numbers x, found {len(stored.x)}")
        return State(stored.x, stored.labels, stored.frozen)

    def write(self, state: State) -> None:
        """Write a state to the disk; raises SinkError, after which the old state stands."""
        stored = _Stored(
            bundle=self._name,
            digest=self._digest,
            confidence=self._confidence,
            scope=self._scope,
            x=state.x,
            labels=state.labels,
            frozen=state.frozen,
        )
        write_whole(self.path, stored.encoded(), durable=True)

    def release(self) -> None:
        """Let other odometers use the file."""
        if self._release is not None:
            self._release()

    def _lock(self) -> None:
        """Lock the file against other odometers; raises SinkError if one of them uses it."""
        path = self.path.with_name(f"{self.path.name}.lock")
        while self._release is None:
            try:
                # Private: any user who can open the file could hold the lock.
                descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            except OSError:
                return  # nothing can be written here either, and the first write says so
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(descriptor)
                raise SinkError(
                    f"{self.path}: another odometer adapts with this state; give each its own file"
                ) from None
            except OSError:
                os.close(descriptor)
                return  # the file system does not support locks
            # Whoever held the lock before may have removed the file meanwhile.
            if _is_file(descriptor, path):
                self._release = weakref.finalize(self, _unlock, descriptor, path, os.getpid())
            else:
                os.close(descriptor)

    def _sweep(self) -> None:
        """Remove what writes that were killed have left beside the file."""
        for unfinished in self.path.parent.glob(f"{escape(self.path.name)}.*.partial"):
            with suppress(OSError):
                unfinished.unlink()

    def _damaged(self, why: str) -> CvoError:
        return CalibrationFileError(
            f"{self.path}: expected the state of an adaptation, found a damaged file: {why}; "
            "restore a copy, or delete it to start from the calibrated thresholds"
        )

    def _other(self, expected: str, found: str) -> CvoError:
        return BundleMismatchError(
            f"{self.path}: expected the state of {expected}, found that of {found}; {_ANOTHER}"
        )


def _is_file(descriptor: int, path: Path) -> bool:
    with suppress(OSError):
        return os.path.samestat(os.fstat(descriptor), path.stat())
    return False


def _unlock(descriptor: int, path: Path, owner: int) -> None:
    # A forked process shares the lock of its parent, and must leave it.
    if os.getpid() == owner:
        with suppress(OSError):
            path.unlink()
    os.close(descriptor)
