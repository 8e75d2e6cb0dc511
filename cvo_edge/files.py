"""Bounded reading of untrusted files, atomic writing, folders for cache and state, and order."""

from __future__ import annotations

import errno
import glob
import io
import json
import os
import re
import stat
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from cvo_edge.errors import CvoError, SinkError, UsageError
from cvo_edge.vocabulary import VERSION

# Every file that this program writes says so, in the way of its format.
SOFTWARE = f"cvo-edge {VERSION}"
# So many bytes of a file tell whose it is.
_SEEN = 4096
_OURS = re.compile(
    rb'\{.*"software": ?"cvo-edge '
    rb"|#(?: kind: .*\n#)?(?: schema_version: .*\n#)? software: cvo-edge "
    rb"|\x89PNG\r\n\x1a\n.*Software\0cvo-edge "
    rb"|\x89MCAP0\r\n.{0,40}cvo-edge"
    rb"|RRF2.{0,400}cvo-edge"
    rb"|<\?xml .*<dc:title>cvo-edge "
    rb'|<!doctype html>\n.{0,100}<meta name="generator" content="cvo-edge '
    # Of earlier versions, and tables.
    rb'|\{"seq":|seq,stamp_ns,|Position and half the width',
    re.DOTALL,
)
# A PDF says it before its table of objects.
_PDF_END, _PDF_CREATOR = 1 << 16, b"/Creator (cvo-edge "


# Permissions of the group and of everyone else.
OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def regular_file(
    path: Path | str, limit: int, error: type[CvoError], *, links: bool = False
) -> io.BufferedReader:
    """Open a regular file of at most ``limit`` bytes; raises ``error`` for anything else.

    Symbolic links are followed only if ``links`` is set. Never blocks on pipes or devices.
    """
    # O_NONBLOCK: opening a FIFO without a writer must not block before fstat refuses it.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)
    if not links:
        flags |= getattr(os, "O_NOFOLLOW", 0)
    try:
        descriptor = os.open(path, flags)
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except OSError as failure:
        if failure.errno == errno.ELOOP:
            raise error(
                f"{path}: expected a regular file, found a symbolic link; copy with cp -L"
            ) from None
        raise error(f"{path}: cannot be opened as a regular file: {failure.strerror}") from None
    found = os.fstat(descriptor)
    if stat.S_ISREG(found.st_mode) and found.st_size <= limit:
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISREG(found.st_mode):
        raise error(f"{path}: expected at most {limit} bytes, found {found.st_size}")
    kind = "a folder" if stat.S_ISDIR(found.st_mode) else "another kind of file"
    raise error(f"{path}: expected a regular file, found {kind}")


def read_regular_file(
    path: Path | str, limit: int, error: type[CvoError], *, links: bool = False
) -> bytes:
    """Return all bytes of a regular file; parameters and errors as for ``regular_file``."""
    with regular_file(path, limit, error, links=links) as stream:
        try:
            # Allocating the file's present size is faster than allocating the limit.
            size = min(os.fstat(stream.fileno()).st_size, limit)
            content = stream.read(size + 1)
            if len(content) > size:
                content += stream.read(limit + 1 - len(content))
        except OSError as failure:
            raise error(f"{path}: cannot be read: {failure.strerror}") from None
        except MemoryError:
            raise error(f"{path}: not enough memory to read the file") from None
    if len(content) > limit:
        raise error(f"{path}: expected at most {limit} bytes, found more")
    return content


def untrusted(found: os.stat_result) -> bool:
    """Whether others than this user and root own a file or folder, or may write to it."""
    return found.st_uid not in (os.geteuid(), 0) or bool(found.st_mode & OTHERS_WRITE)


@contextmanager
def whole_file(
    path: Path, *, durable: bool = False, make_folder: bool = False, own: bool = False
) -> Iterator[BinaryIO]:
    """Yield a stream whose content becomes the file when the block ends without an error.

    Readers see either the old or the complete new file. A link at ``path`` is replaced, not
    followed.

    Parameters
    ----------
    durable
        Flush the file and its folder to the disk, so that this also holds after a power loss.
    make_folder
        Create the folder and its parents if they are missing.
    own
        Let nobody else write to the file, whatever the umask is; see ``untrusted``.

    Raises
    ------
    SinkError
        The file cannot be written.
    """
    unfinished = _unfinished(path)
    try:
        if make_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        opened = unfinished.open("xb")
    # A ValueError means that the name is not a valid file name.
    except (OSError, ValueError) as error:
        raise _unwritable(path, error) from None
    try:
        with opened as stream:
            if own:
                os.fchmod(stream.fileno(), os.fstat(stream.fileno()).st_mode & ~OTHERS_WRITE)
            yield stream
            if durable:
                stream.flush()
                os.fsync(stream.fileno())
        unfinished.replace(path)
        if durable:
            _flush_folder(path.parent)
    except BaseException as error:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
        # torch.save raises a RuntimeError if a write fails.
        cause = error if isinstance(error, OSError) else error.__context__
        if isinstance(error, Exception) and isinstance(cause, OSError):
            raise _unwritable(path, cause) from None
        raise


@contextmanager
def whole_path(output: str) -> Iterator[str]:
    """Yield a name to write to; that file becomes ``output`` if the block ends without an error.

    Standard output (``-``), pipes, devices and links are yielded themselves. Raises SinkError; one
    that the block raises names ``output``.
    """
    path = Path(output)
    if output == "-" or path.is_symlink() or (path.exists() and not path.is_file()):
        yield output
        return
    unfinished = _unfinished(path)
    try:
        yield str(unfinished)
        # Without any record, there may be no file.
        if unfinished.exists():
            unfinished.replace(path)
    except SinkError as error:
        raise SinkError(str(error).replace(str(unfinished), output)) from None
    except OSError as error:
        raise _unwritable(path, error) from None
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)


def _unfinished(path: Path) -> Path:
    # A random name: processes on several machines may write to one shared folder.
    return path.with_name(f"{path.name}.{os.urandom(4).hex()}.partial")


def _unwritable(path: Path | str, error: OSError | ValueError) -> SinkError:
    return SinkError(f"{path}: cannot be written: {getattr(error, 'strerror', error)}")


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_whole(
    path: Path,
    content: str | bytes,
    *,
    durable: bool = False,
    make_folder: bool = False,
    own: bool = False,
) -> None:
    """Write text (UTF-8) or bytes to a file, as ``whole_file`` does; raises SinkError."""
    with whole_file(path, durable=durable, make_folder=make_folder, own=own) as stream:
        stream.write(content.encode() if isinstance(content, str) else content)


def write_text(target: str, text: str) -> None:
    """Write text to a file, or to standard output for ``-``; raises SinkError.

    A regular file is replaced atomically; pipes, devices and links are written to directly.
    """
    if target == "-":
        sys.stdout.write(text)
        return
    path = Path(target)
    try:
        if path.is_symlink() or (path.exists() and not path.is_file()):
            path.write_text(text, "utf-8")
            return
    except OSError as error:
        raise _unwritable(target, error) from None
    write_whole(path, text)


def write_report(target: str, report: Mapping[str, Any]) -> None:
    """Write a report as indented JSON that names this program; as ``write_text``."""
    write_text(target, json.dumps({"software": SOFTWARE, **report}, indent=1) + "\n")


def picture_metadata(suffix: str) -> dict[str, str]:
    """Return what matplotlib is to put into a ``.png``, ``.svg`` or ``.pdf`` that names us."""
    return {"Software" if suffix.lower() == ".png" else "Creator": SOFTWARE}


def own_folder(variable: str, base_variable: str, base: str) -> Path:
    """Return the folder that a variable names, or else ``cvo-edge`` in an XDG base folder.

    Parameters
    ----------
    variable
        This project's environment variable, e.g. ``CVO_EDGE_CACHE``.
    base_variable, base
        Variable of the XDG specification, e.g. ``XDG_CACHE_HOME``, and the default if it is unset.

    Raises UsageError if ``variable`` holds a relative path, whose meaning would depend on the
    current folder.
    """
    named = os.environ.get(variable)
    if named:
        if not Path(named).is_absolute():
            raise UsageError(f"{variable}: expected an absolute path, found {named!r}")
        return Path(named)
    given = os.environ.get(base_variable, "")
    if Path(given).is_absolute():
        return Path(given) / "cvo-edge"
    try:
        return Path(base).expanduser() / "cvo-edge"
    except RuntimeError:
        # The user has no home folder: return a path that cannot be created.
        return Path(os.devnull) / "cvo-edge"


def check_output(
    output: str | Path, *inputs: str | Path | None, force: bool | None = False
) -> None:
    """Raise UsageError for an output that must not be replaced.

    That is an input, a file in an input's folder or glob, and, without ``force``, a file that this
    program did not write; None says that a command has no such option. Neither needs to exist: some
    inputs are written, too. Empty files, pipes and devices are never refused.
    """
    output = str(output)
    if output == "-":
        return
    _refuse_inputs(output, inputs)
    if not force:
        advice = "choose another name" + ("" if force is None else ", or --force to replace it")
        _refuse_foreign(output, advice)


def _refuse_inputs(output: str, inputs: Iterable[str | Path | None]) -> None:
    written, place = Path(output), os.path.realpath(output)
    if any(given is not None and os.path.realpath(given) == place for given in inputs):
        raise UsageError(f"output: expected a new file, found {output} among the inputs")
    try:
        output_stat = written.stat()
    except (OSError, ValueError):  # also of a name too long, or of none
        return
    for given in inputs:
        if given is None:
            continue
        name = str(given)
        if any(map(partial(_is, output_stat), [name, *glob.iglob(name, recursive=True)])) or any(
            map(partial(_is, output_stat), _maybe(output_stat, name))
        ):
            raise UsageError(f"output: expected a new file, found {output} among the inputs")


def _refuse_foreign(output: str, advice: str) -> None:
    try:
        with Path(output).open("rb", buffering=0) as stream:
            found = os.fstat(stream.fileno())
            if not stat.S_ISREG(found.st_mode):
                return
            beginning = stream.read(_SEEN)
            ours = bool(_OURS.match(beginning))
            if beginning.startswith(b"%PDF"):
                stream.seek(max(0, found.st_size - _PDF_END))
                ours = _PDF_CREATOR in stream.read(_PDF_END)
    # A ValueError means that the name is not a valid file name. None there, or one that opening it
    # for writing judges.
    except (OSError, ValueError):
        return
    if beginning and not ours:
        raise UsageError(
            f"{output}: expected a new file or one of cvo-edge, found another one; {advice}"
        )


def _is(found: os.stat_result, path: str) -> bool:
    try:
        return os.path.samestat(found, os.stat(path))  # noqa: PTH116 - of hundreds of thousands
    except (OSError, ValueError):
        return False


def _maybe(found: os.stat_result, folder: str) -> Iterator[str]:
    """Yield the entries of a folder that may be a file, without their status."""
    with suppress(OSError, ValueError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.inode() == found.st_ino or entry.is_symlink():
                yield entry.path


def natural_key(path: Path) -> list[tuple[int, int, str]]:
    """Sort key that compares digits as numbers: ``frame-2`` before ``frame-10``."""
    parts = re.split("([0-9]+)", str(path))
    return [
        (1, 0, part) if index % 2 == 0 else (0, int(part), "")
        for index, part in enumerate(parts)
        if part
    ]


def natural_text(name: str) -> str:
    """Sort key with the order of ``natural_key``, as one string, for hundreds of thousands."""
    return _DIGITS.sub(_with_length, name)


_DIGITS = re.compile("[0-9]+")


def _with_length(found: re.Match[str]) -> str:
    # No file's name holds the character 0, so that numbers come before all others.
    digits = found[0].lstrip("0") or "0"
    return f"\0{chr(len(digits))}{digits}"
