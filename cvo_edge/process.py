"""The life cycle of a program's process: signals, standard streams, exit codes.

Both command lines run within ``guarded``; nothing happens when this module is imported.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import NoReturn

import typer
from typer.main import get_command

from cvo_edge.errors import CvoError, SinkError, SourceError, printable

# How long a signal may take by the ordinary way, which closes what is open.
_PATIENCE_S = 0.8
# Threads that read, of cameras and videos, and of files beside each other.
_LEFT_BEHIND = ("cvo-edge reader", "cvo-edge worker")


def prepare_environment() -> None:
    """Set what numpy, OpenCV and FFmpeg read when they are imported.

    numpy's thread pool would double the memory of a process that does no linear algebra in it.
    OpenCV and FFmpeg print warnings of their own to stderr; this program reports what matters.
    OpenCV's pixel limit backs up the check of image headers in ``cvo_edge.input.decoding``.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    quiet_libraries()
    os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(1 << 26)


def quiet_libraries() -> None:
    """Keep OpenCV and FFmpeg from printing warnings, unless the user asked for them."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def guarded(program: str, app: typer.Typer) -> NoReturn:
    """Run a command line and leave with the documented exit code.

    One line on stderr for every error from outside; a reader of stdout that has left ends it
    quietly; SIGINT and SIGTERM unwind, so that sinks are flushed and closed. Both programs go
    through here.
    """
    signal.signal(signal.SIGTERM, _terminate)
    if sys.stdout is not None:
        # A terminal of another character set is told what it can show.
        with contextlib.suppress(AttributeError):
            sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    command = get_command(app)
    try:
        if sys.stdout is None:
            raise SinkError("standard output: expected an open stream, found it closed")
        if f"_{program.replace('-', '_').upper()}_COMPLETE" in os.environ:
            # The shell asks for completions; they are not commands of ours.
            command.main(prog_name=program)
        # Not command.main(): it has exit codes of its own for signals and closed pipes.
        with command.make_context(program, sys.argv[1:] or ["--help"]) as context:
            command.invoke(context)
        sys.stdout.flush()
        code = 0
    except typer.Exit as leaving:
        code = leaving.exit_code
    except CvoError as error:
        code = _complain(program, str(error), error.exit_code)
    except typer.TyperException as error:
        code = _complain(program, error.format_message().strip(), error.exit_code)
    except BrokenPipeError:
        _drop_stdout()
        code = 0
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    except Terminated:
        code = 128 + signal.SIGTERM
    except SystemExit as leaving:
        # rich ends the process itself where the reader of a help page has left.
        if not isinstance(leaving.__context__, BrokenPipeError):
            raise
        code = 0
    except MemoryError:
        code = _complain(program, "not enough memory for this command", 1)
    except Exception as error:
        if isinstance(error, RuntimeError) and "can't start new thread" in str(error):
            _leave(_complain(program, "no more threads can be started on this machine", 1))
        # A module in C that is being initialised makes an error of its own of what a signal raises.
        if _terminated.is_set():
            code = 128 + signal.SIGTERM
        elif not isinstance(error, OSError):
            raise
        else:
            code = _unforeseen(program, error)
    _leave(code)


def _unforeseen(program: str, error: OSError) -> int:
    """What the modules did not foresee: a path too long, standard output on a full disk."""
    failed = SourceError if error.filename else SinkError
    where = error.filename or "standard output"
    code = _complain(program, f"{where}: {error.strerror}", failed.exit_code)
    _drop_stdout()
    return code


def _leave(code: int) -> NoReturn:
    """End the process, also where a thread waits for a camera that gives no more frames.

    Python would end such a thread inside OpenCV, which takes the process with it, exit code and
    all, or wait for it. Everything of ours is written by now.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            # Or Python tries again, fails, and has an exit code of its own for that.
            setattr(sys, name, None)
    if any(thread.name.startswith(_LEFT_BEHIND) for thread in threading.enumerate()):
        os._exit(code)
    sys.exit(code)


def _complain(program: str, message: str, code: int) -> int:
    """One line on stderr."""
    say(f"{program}: {printable(message)}")
    return code


def say(text: str) -> None:
    """Print to stderr; where nobody can read it, the exit code is what is left to say."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):
            print(text, file=sys.stderr, flush=True)


def _drop_stdout() -> None:
    """Keep Python from complaining when it flushes a broken stdout once more at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Terminated(SystemExit):
    """SIGTERM has come: what is open is to be closed, and the process to end."""


_terminated = threading.Event()


def _terminate(number: int, _: FrameType | None) -> NoReturn:
    _terminated.set()
    raise Terminated(128 + number)


def end_within_a_second() -> None:
    """Have SIGINT and SIGTERM end this process soon, also where no handler of Python's can run.

    An inference without end, a picture of many passes, a file that is not given: while C is at
    work, Python waits. Every finished record is on its way to the disk by then.
    """
    receiver, sender = os.pipe()
    os.set_blocking(sender, False)
    signal.set_wakeup_fd(sender)

    def watch() -> None:
        while True:
            (number,) = os.read(receiver, 1)
            if number in (signal.SIGINT, signal.SIGTERM):
                time.sleep(_PATIENCE_S)
                os._exit(128 + number)

    with contextlib.suppress(RuntimeError):  # without a thread it is as it was
        threading.Thread(target=watch, name="cvo-edge signals", daemon=True).start()


def keep_libraries_off_stderr() -> None:
    """Leave stderr to us: decoders and engines in C write there what they think of their input."""
    # Whoever started us without one of the first three would have a file of ours there.
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    if sys.stderr is None:
        return
    own = os.dup(2)
    sys.stderr = os.fdopen(own, "w", buffering=1, errors="backslashreplace")
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    os.close(null)
