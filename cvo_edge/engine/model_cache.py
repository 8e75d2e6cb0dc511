"""The model cache: the optimised form that an engine builds from a model on this machine.

Loading a model means parsing it, optimising its graph for this processor and rearranging its
weights. The cache stores the result as a folder of two files: the optimised graph, and its weights,
which the system maps into memory and shares between processes (OpenVINO keeps both in the first).
An entry belongs to one model, one release of one engine and one processor, and is used only if its
bytes are unchanged. Nobody but this user and root may be able to write to it, because digests in an
entry can be made to match.

A failure of the cache never stops a model from running: it only makes the start slower.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import platform
import re
import shutil
import stat
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
from msgspec import Struct

from cvo_edge.bundle.device_record import DeviceRecord
from cvo_edge.engine.own_files import FileIdentity, content, file_digests, identity, not_ours
from cvo_edge.errors import BundleMismatchError, SinkError
from cvo_edge.files import OTHERS_WRITE, own_folder, untrusted, write_whole
from cvo_edge.given import given_path
from cvo_edge.vocabulary import Provider

GRAPH_FILE, WEIGHTS_FILE, ENTRY_FILE = "graph.onnx", "weights.bin", "entry.json"
SEEN_FILE = "seen.json"
CACHE_VARIABLE = "CVO_EDGE_CACHE"

_UNFINISHED = ".unfinished-"
_ENTRY_NAME = re.compile("[0-9a-f]{32}")
# A build takes seconds; an unfinished folder older than this was interrupted.
_STALE_SECONDS = 3600.0
# File times are coarse: a file changed more recently than this may change again unnoticed.
_SETTLED_NS = 2_000_000_000
# Errors that msgspec raises for damaged or foreign content.
_UNDECODABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
# Errors that say nothing about the entry itself; reading it later may succeed.
_PASSING = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EACCES)
# Version of the entry's format and build settings; part of the entry's key.
_FORM = "5"
# Checked model files remembered per entry, e.g. several copies of a bundle.
_MOST_SEEN = 16


class Entry(Struct, frozen=True, forbid_unknown_fields=True):
    """``entry.json``: model, engine with its release, processor, and digests of both files."""

    name: str
    model_sha256: str
    engine: str
    processor: str
    graph_sha256: str
    weights_sha256: list[str]


@dataclass(frozen=True)
class CachedModel:
    """A checked cache entry: the bytes of the graph, and the folder with the weights."""

    folder: Path
    graph: bytes
    model_sha256: str
    provider: Provider


class Listed(Struct, frozen=True):
    """One line of ``cvo-edge cache``; ``current`` tells whether this machine can use it."""

    name: str
    model_sha256: str
    engine: str
    megabytes: float
    current: bool


class ModelCache:
    """A folder of models, optimised for this machine.

    Parameters
    ----------
    folder
        Created when the first model is stored. Not used if other users may write to it.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = given_path(folder, "cache")
        self._seal: tuple[DeviceRecord, str] | None = None

    @classmethod
    def default(cls) -> ModelCache:
        """Use ``$CVO_EDGE_CACHE``, or ``cvo-edge`` in the user's XDG cache folder.

        Raises UsageError if the variable holds a relative path.
        """
        return cls(own_folder(CACHE_VARIABLE, "XDG_CACHE_HOME", "~/.cache"))

    def sealed(self, record: DeviceRecord, key: str) -> ModelCache:
        """Return the same cache, of entries only that this device made of models with this key.

        A signature covers a model's own bytes. ``record`` keeps what became of them here, so that
        whoever can write to the cache alone changes nothing that runs.
        """
        cache = ModelCache(self.folder)
        cache._seal = record, key
        return cache

    def find(self, model_sha256: str, provider: Provider = "onnxruntime") -> CachedModel | None:
        """Return a provider's entry of a model, or None; a changed entry is removed."""
        if self.obstacle() is not None:
            return None
        folder = self._entry_folder(model_sha256, provider)
        try:
            if untrusted(folder.lstat()):
                raise not_ours(folder)
            stated = content(folder / ENTRY_FILE)
            if not self._is_sealed(model_sha256, stated):
                return None
            entry = msgspec.json.decode(stated, type=Entry)
            graph = content(folder / GRAPH_FILE)
            unchanged = (
                (entry.model_sha256, entry.engine, entry.processor)
                == (model_sha256, _engine(provider), _processor())
                and hashlib.sha256(graph).hexdigest() == entry.graph_sha256
                and file_digests(folder / WEIGHTS_FILE) == entry.weights_sha256
            )
        except _UNDECODABLE:
            unchanged = False
        except OSError as error:
            if error.errno in _PASSING:
                return None
            unchanged = False
        if unchanged:
            return CachedModel(folder, graph, model_sha256, provider)
        self.forget(model_sha256, provider)
        return None

    def knows(self, cached: CachedModel, model: Path) -> bool:
        """Whether this model file is unchanged since its digest was checked."""
        return identity(model) in _seen(cached)

    def remember(self, cached: CachedModel, model: Path, before: FileIdentity | None) -> None:
        """Record a model file whose digest matched; ``before`` is its identity before the check."""
        if before is None or before != identity(model):
            return
        if time.time_ns() - max(before.ctime_ns, before.mtime_ns) < _SETTLED_NS:
            return
        seen = [*_seen(cached), before][-_MOST_SEEN:]
        with contextlib.suppress(SinkError):
            write_whole(cached.folder / SEEN_FILE, msgspec.json.encode(seen), own=True)

    def new_folder(self) -> Path | None:
        """Create a folder for the files of a new entry; None if that is impossible."""
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if self.obstacle(writing=True) is not None:
                return None
            self._sweep()
            return Path(tempfile.mkdtemp(prefix=_UNFINISHED, dir=self.folder))
        except OSError:
            return None

    def keep(
        self, new: Path, name: str, model_sha256: str, provider: Provider = "onnxruntime"
    ) -> None:
        """Turn a new folder into an entry, unless another process was faster.

        The new folder no longer exists afterwards, even on failure.
        """
        try:
            for path in new.iterdir():
                path.chmod(path.stat().st_mode & ~OTHERS_WRITE)
            entry = Entry(
                name=name,
                model_sha256=model_sha256,
                engine=_engine(provider),
                processor=_processor(),
                graph_sha256=hashlib.sha256((new / GRAPH_FILE).read_bytes()).hexdigest(),
                weights_sha256=file_digests(new / WEIGHTS_FILE),
            )
            stated = msgspec.json.encode(entry)
            write_whole(new / ENTRY_FILE, stated, own=True)
            if self._seal is not None:
                # An entry that was found without its seal is not used, and would be in the way.
                self.forget(model_sha256, provider)
                digest = hashlib.sha256(stated).hexdigest()
                record, key = self._seal
                record.keep_prepared(key, model_sha256, digest)
            # The rename is atomic and fails if the entry already exists.
            new.rename(self._entry_folder(model_sha256, provider))
        except (OSError, SinkError, BundleMismatchError):
            pass
        finally:
            self.discard(new)

    def discard(self, new: Path) -> None:
        """Remove a new folder."""
        shutil.rmtree(new, ignore_errors=True)

    def forget(self, model_sha256: str, provider: Provider = "onnxruntime") -> None:
        """Remove a provider's entry of a model."""
        shutil.rmtree(self._entry_folder(model_sha256, provider), ignore_errors=True)

    def entries(self) -> list[Listed]:
        """Return the entries, sorted by name."""
        found = []
        for folder in self._folders():
            entry = _read_entry(folder)
            if entry is None:
                continue
            size = 0
            # Another process may remove the entry at the same time.
            with contextlib.suppress(OSError):
                size = sum(path.lstat().st_size for path in folder.iterdir())
            found.append(
                Listed(
                    entry.name,
                    entry.model_sha256,
                    entry.engine,
                    size / 1e6,
                    folder == self._folder_of(entry.model_sha256, _present(entry.engine)),
                )
            )
        return sorted(found, key=lambda listed: (listed.name, listed.model_sha256))

    def clear(self) -> int:
        """Remove all entries and interrupted builds; returns the number of entries removed."""
        count = 0
        for folder in self._folders():
            shutil.rmtree(folder, ignore_errors=True)
            count += not folder.name.startswith(_UNFINISHED) and not folder.exists()
        return count

    def obstacle(self, *, writing: bool = False) -> str | None:
        """Return why this cache cannot be used, or None if it can.

        ``writing``: for new entries, too. A folder that was filled before may be read-only.
        """
        try:
            found = self.folder.stat()
        except FileNotFoundError:
            return None
        except OSError as error:
            return f"cannot be read: {error.strerror}"
        if not stat.S_ISDIR(found.st_mode):
            return "not a folder"
        if untrusted(found):
            return "must belong to this user or root and be writable only by its owner"
        if not os.access(self.folder, os.R_OK | os.X_OK):
            return "no permission to read from this folder"
        if writing and not os.access(self.folder, os.W_OK):
            return "no permission to write to this folder"
        return None

    def _is_sealed(self, model_sha256: str, stated: bytes) -> bool:
        """Whether this cache may use the entry with this ``entry.json``."""
        if self._seal is None:
            return True
        record, key = self._seal
        return record.prepared(key, model_sha256) == hashlib.sha256(stated).hexdigest()

    def _folders(self) -> list[Path]:
        """Return only folders that the cache created: the folder may hold other files, too."""
        if self.obstacle() is not None or not self.folder.exists():
            return []
        return [
            path
            for path in sorted(self.folder.iterdir())
            if path.name.startswith(_UNFINISHED) or _is_entry(path)
        ]

    def _sweep(self) -> None:
        for path in self.folder.glob(f"{_UNFINISHED}*"):
            if time.time() - path.stat().st_mtime > _STALE_SECONDS:
                shutil.rmtree(path, ignore_errors=True)

    def _entry_folder(self, model_sha256: str, provider: Provider) -> Path:
        return self._folder_of(model_sha256, _engine(provider))

    def _folder_of(self, model_sha256: str, engine: str) -> Path:
        key = "\n".join((_FORM, model_sha256, engine, _processor()))
        return self.folder / hashlib.sha256(key.encode()).hexdigest()[:32]


def _is_entry(folder: Path) -> bool:
    """Whether a folder is named like an entry and holds only an entry's files."""
    ours = (GRAPH_FILE, WEIGHTS_FILE, ENTRY_FILE, SEEN_FILE)
    return (
        _ENTRY_NAME.fullmatch(folder.name) is not None
        and folder.is_dir()
        and all(path.name.startswith(ours) for path in folder.iterdir())
    )


def _read_entry(folder: Path) -> Entry | None:
    try:
        return msgspec.json.decode(content(folder / ENTRY_FILE), type=Entry)
    except (OSError, *_UNDECODABLE):
        return None


def _seen(cached: CachedModel) -> list[FileIdentity]:
    try:
        return msgspec.json.decode(content(cached.folder / SEEN_FILE), type=list[FileIdentity])
    except (OSError, *_UNDECODABLE):
        return []


def _engine(provider: Provider) -> str:
    """Return an engine's name and release; the name alone if it is not installed."""
    # Imported here because clearing the cache does not need the engine. Reading the version from
    # the package metadata instead takes as long as opening a small model.
    if provider == "onnxruntime":
        from onnxruntime import __version__ as version
    else:
        try:
            from openvino import __version__ as version
        # An older or incomplete installation may raise any exception.
        except Exception:  # noqa: BLE001
            return provider
    return f"{provider} {version}"


def _present(engine: str) -> str:
    """Return the installed release of an entry's engine; others are not imported."""
    return _engine("openvino" if engine.startswith("openvino") else "onnxruntime")


def _processor() -> str:
    """Return a digest of the architecture and CPU features, which determine the weight layout."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        lines = [platform.processor()]
    wanted = ("model name", "flags", "Features", "CPU part")
    told = sorted({line for line in lines if line.partition("\t")[0].strip() in wanted})
    text = "\n".join([platform.machine(), *told])
    return hashlib.sha256(text.encode()).hexdigest()[:16]
