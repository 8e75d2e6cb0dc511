"""PreparedModel models: what onnxruntime makes of a model on this machine, built once and kept.

Loading a model means parsing it, rewriting its graph for this processor and laying out its weights
anew. The result is kept as a folder of two files: the rewritten graph, and its weights, which the
system maps into memory and shares between processes. An entry belongs to one model, one release of
onnxruntime and one processor, and is used only while every byte of it is what was written.

Nothing here may keep a model from running: what goes wrong with the cache costs its advantage only.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import os
import platform
import re
import shutil
import stat
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import msgspec
from msgspec import Struct

from cvo_edge.files import own_folder

GRAPH_FILE, WEIGHTS_FILE, ENTRY_FILE = "graph.onnx", "weights.bin", "entry.json"
SEEN_FILE = "seen.json"
CACHE_VARIABLE = "CVO_EDGE_CACHE"

# What a core's own cache holds.
_CHUNK_BYTES = 1 << 20
_UNFINISHED = ".unfinished-"
_ENTRY_NAME = re.compile("[0-9a-f]{32}")
# A build takes seconds: what is older was interrupted.
_STALE_SECONDS = 3600.0
# A file that changed less than this ago may change again without a sign: clocks tick slowly.
_SETTLED_NS = 2_000_000_000
# What msgspec raises at bytes that it did not write.
_UNDECODABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
# With these nothing is wrong with an entry: it may be read later.
_PASSING = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EACCES)
# Of what is kept, and of the settings it was made with; another one is another entry.
_FORM = "4"
# Copies of a bundle on one machine.
_MOST_SEEN = 16


class Entry(Struct, frozen=True, forbid_unknown_fields=True):
    """``entry.json``: what was prepared, by what, for what, and what both files hold."""

    name: str
    model_sha256: str
    onnxruntime: str
    processor: str
    graph_sha256: str
    weights_sha256: list[str]


class FileIdentity(Struct, frozen=True, array_like=True):
    """What the system says of a file; its ``ctime_ns`` moves with every change of it."""

    device: int
    inode: int
    size: int
    mtime_ns: int
    ctime_ns: int


@dataclass(frozen=True)
class PreparedModel:
    """An entry whose bytes were checked: the graph itself, and the folder with its weights."""

    folder: Path
    graph: bytes
    model_sha256: str


class Listed(Struct, frozen=True):
    """One line of ``cvo-edge cache``; ``current`` says whether this machine would use it."""

    name: str
    model_sha256: str
    onnxruntime: str
    megabytes: float
    current: bool


class ModelCache:
    """A folder of prepared models.

    Parameters
    ----------
    folder
        Made when the first model is kept. One that others may write to is not used.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def default(cls) -> ModelCache:
        """The cache in ``$CVO_EDGE_CACHE``, else in ``cvo-edge`` of the user's own caches.

        Raises UsageError for a relative path in that variable.
        """
        return cls(own_folder(CACHE_VARIABLE, "XDG_CACHE_HOME", "~/.cache"))

    def find(self, model_sha256: str) -> PreparedModel | None:
        """Return the entry of a model if this machine has one and its bytes are unchanged.

        A changed one is removed.
        """
        if self.obstacle() is not None:
            return None
        folder = self._entry_folder(model_sha256)
        try:
            entry = msgspec.json.decode(_content(folder / ENTRY_FILE), type=Entry)
            graph = _content(folder / GRAPH_FILE)
            unchanged = (
                (entry.model_sha256, entry.onnxruntime, entry.processor)
                == (model_sha256, _onnxruntime_version(), _processor())
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
            return PreparedModel(folder, graph, model_sha256)
        self.forget(model_sha256)
        return None

    def knows(self, prepared: PreparedModel, model: Path) -> bool:
        """Whether this very model file has had its digest taken, and has not changed since."""
        return identity(model) in _seen(prepared)

    def remember(self, prepared: PreparedModel, model: Path, before: FileIdentity | None) -> None:
        """Note a model file whose digest was right; ``before`` is what it was before that."""
        if before is None or before != identity(model):
            return
        if time.time_ns() - max(before.ctime_ns, before.mtime_ns) < _SETTLED_NS:
            return
        seen = [*_seen(prepared), before][-_MOST_SEEN:]
        with contextlib.suppress(OSError):
            descriptor, partial = tempfile.mkstemp(prefix=SEEN_FILE, dir=prepared.folder)
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(msgspec.json.encode(seen))
            Path(partial).replace(prepared.folder / SEEN_FILE)

    def new_folder(self) -> Path | None:
        """Return a folder to write an entry's files to; None where none can be made."""
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if self.obstacle() is not None:
                return None
            self._sweep()
            return Path(tempfile.mkdtemp(prefix=_UNFINISHED, dir=self.folder))
        except OSError:
            return None

    def keep(self, new: Path, name: str, model_sha256: str) -> None:
        """Make an entry of a new folder's two files, unless another process was faster.

        The folder is gone afterwards, whatever happened.
        """
        try:
            entry = Entry(
                name=name,
                model_sha256=model_sha256,
                onnxruntime=_onnxruntime_version(),
                processor=_processor(),
                graph_sha256=hashlib.sha256((new / GRAPH_FILE).read_bytes()).hexdigest(),
                weights_sha256=file_digests(new / WEIGHTS_FILE),
            )
            (new / ENTRY_FILE).write_bytes(msgspec.json.encode(entry))
            # Whole or not at all; a folder that is there and not empty is left as it is.
            new.rename(self._entry_folder(model_sha256))
        except OSError:
            pass
        finally:
            self.discard(new)

    def discard(self, new: Path) -> None:
        """Remove a new folder."""
        shutil.rmtree(new, ignore_errors=True)

    def forget(self, model_sha256: str) -> None:
        """Remove the entry of a model."""
        shutil.rmtree(self._entry_folder(model_sha256), ignore_errors=True)

    def entries(self) -> list[Listed]:
        """Return what the cache holds, in order of its names."""
        found = []
        for folder in self._folders():
            entry = _read_entry(folder)
            if entry is None:
                continue
            size = 0
            # What another process has just removed has no size.
            with contextlib.suppress(OSError):
                size = sum(path.lstat().st_size for path in folder.iterdir())
            found.append(
                Listed(
                    entry.name,
                    entry.model_sha256,
                    entry.onnxruntime,
                    size / 1e6,
                    folder == self._entry_folder(entry.model_sha256),
                )
            )
        return sorted(found, key=lambda listed: (listed.name, listed.model_sha256))

    def clear(self) -> int:
        """Remove every entry and what interrupted builds left; returns how many entries."""
        count = 0
        for folder in self._folders():
            shutil.rmtree(folder, ignore_errors=True)
            count += not folder.name.startswith(_UNFINISHED) and not folder.exists()
        return count

    def obstacle(self) -> str | None:
        """Say why this cache is not used; None where it is, or could be made."""
        try:
            found = self.folder.stat()
        except FileNotFoundError:
            return None
        except OSError as error:
            return f"cannot be read: {error.strerror}"
        if not stat.S_ISDIR(found.st_mode):
            return "expected a folder, found another kind"
        if found.st_uid != os.getuid() or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            return "expected a folder of this user's that nobody else may write to"
        if not os.access(self.folder, os.R_OK | os.W_OK | os.X_OK):
            return "expected a folder that may be written to"
        return None

    def _folders(self) -> list[Path]:
        """Folders of ours: a cache that someone put elsewhere may lie among other files."""
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

    def _entry_folder(self, model_sha256: str) -> Path:
        key = "\n".join((_FORM, model_sha256, _onnxruntime_version(), _processor()))
        return self.folder / hashlib.sha256(key.encode()).hexdigest()[:32]


def _is_entry(folder: Path) -> bool:
    """Whether a folder has the name of an entry and holds nothing else, whole or damaged."""
    ours = (GRAPH_FILE, WEIGHTS_FILE, ENTRY_FILE, SEEN_FILE)
    return (
        _ENTRY_NAME.fullmatch(folder.name) is not None
        and folder.is_dir()
        and all(path.name.startswith(ours) for path in folder.iterdir())
    )


def _read_entry(folder: Path) -> Entry | None:
    try:
        return msgspec.json.decode(_content(folder / ENTRY_FILE), type=Entry)
    except (OSError, *_UNDECODABLE):
        return None


def identity(path: Path) -> FileIdentity | None:
    """Return what the system says of a regular file, None where there is none."""
    try:
        found = path.lstat()
    except OSError:
        return None
    if not stat.S_ISREG(found.st_mode):
        return None
    return FileIdentity(
        found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
    )


def _seen(prepared: PreparedModel) -> list[FileIdentity]:
    try:
        return msgspec.json.decode(_content(prepared.folder / SEEN_FILE), type=list[FileIdentity])
    except (OSError, *_UNDECODABLE):
        return []


def _opened(path: Path) -> io.FileIO:
    """Open a regular file; neither links are followed nor pipes waited for."""
    stream = io.FileIO(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK))
    if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise FileNotFoundError(errno.ENOENT, "expected a regular file", str(path))
    return stream


def _content(path: Path) -> bytes:
    with _opened(path) as stream:
        return stream.read()


def file_digests(path: Path) -> list[str]:
    """Sha256 of each MiB of a file, by all cores beside each other; raises OSError."""
    with _opened(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        workers = os.cpu_count() or 1

        def digests(first: int) -> dict[int, str]:
            buffer = memoryview(bytearray(_CHUNK_BYTES))
            return {
                offset: hashlib.sha256(
                    buffer[: os.preadv(stream.fileno(), [buffer], offset)]
                ).hexdigest()
                for offset in range(first * _CHUNK_BYTES, size, workers * _CHUNK_BYTES)
            }

        found: dict[int, str] = {}
        with ThreadPoolExecutor(workers) as pool:
            for part in pool.map(digests, range(workers)):
                found |= part
    return [found[offset] for offset in sorted(found)]


def _onnxruntime_version() -> str:
    # Not at the top: a cache is cleared without the engine. Asking the installed
    # package's metadata instead takes as long as opening a small model.
    from onnxruntime import __version__ as version

    return str(version)


def _processor() -> str:
    """What decides the layout of weights: architecture, and what the processor can do."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        lines = [platform.processor()]
    wanted = ("model name", "flags", "Features", "CPU part")
    told = sorted({line for line in lines if line.partition("\t")[0].strip() in wanted})
    text = "\n".join([platform.machine(), *told])
    return hashlib.sha256(text.encode()).hexdigest()[:16]
