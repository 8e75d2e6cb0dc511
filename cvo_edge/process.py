"""Process handling of the command lines: signals, standard streams, exit codes.

Both command lines run in ``guarded``; importing this module has no side effects.
"""

from __future__ import annotations

import contextlib
import io
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

import typer
from typer.main import get_command

from cvo_edge.errors import CvoError, SinkError, SourceError, printable
from cvo_edge.output.named import reopen_files

# With less address space than this, numpy, OpenCV and onnxruntime cannot be loaded and run.
_LEAST_MEMORY = 512 << 20
# How the loader, C++ and torch say that memory is missing.
_NO_MEMORY = ("failed to map segment", "annot allocate memory", "an't allocate memory", "bad_alloc")
# How long regular cleanup after a signal may take, s.
_patience_s = 0.8
# Signals that end a process silently by default, and mean nothing to this program.
_MEANINGLESS = frozenset(
    (
        *(signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM, signal.SIGVTALRM, signal.SIGPROF),
        *(signal.SIGIO, signal.SIGXCPU, getattr(signal, "SIGPWR", signal.SIGUSR1)),
        *range(getattr(signal, "SIGRTMIN", 0), getattr(signal, "SIGRTMAX", -1) + 1),
    )
)
# Names of the threads that may be blocked in a read when the program exits.
_LEFT_BEHIND = ("cvo-edge reader", "cvo-edge worker")


def check_memory(program: str) -> None:
    """Exit with one line if a limit of the address space (``ulimit -v``) leaves too little.

    Below it, libraries end the process themselves, without a word: OpenBLAS, for example.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < _LEAST_MEMORY:
        message = (
            f"not enough memory: expected an address space of at least {_LEAST_MEMORY >> 20} MiB, "
            f"found a limit of {limit >> 20} MiB (ulimit -v)"
        )
        sys.exit(_complain(program, message, 1))


def prepare_environment() -> None:
    """Set the environment variables that numpy, OpenCV and FFmpeg read on import.

    numpy's thread pool would double the memory of a process that does no large linear algebra.
    OpenCV and FFmpeg print warnings to stderr, where this program prints its own messages.
    OpenCV's pixel limit backs up the check of image headers in ``cvo_edge.input.decoding``.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    quiet_libraries()
    os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(1 << 26)


def quiet_libraries() -> None:
    """Silence warnings of OpenCV and FFmpeg, unless the user enabled them."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def guarded(program: str, app: typer.Typer) -> NoReturn:
    """Run a command line and exit with the documented exit code.

    Every external error prints one line to stderr. A closed stdout pipe ends the program silently.
    SIGINT and SIGTERM unwind the stack, so that sinks are flushed and closed; so do signals that
    have no meaning here, with one line.
    """
    signal.signal(signal.SIGTERM, _terminate)
    for number in _MEANINGLESS:
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _terminate)
    if sys.stdout is None:
        sys.stdout = _Closed()
    else:
        # Escape characters that the terminal's character set lacks.
        with contextlib.suppress(AttributeError):
            sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    command = get_command(app)
    try:
        if f"_{program.replace('-', '_').upper()}_COMPLETE" in os.environ:
            # The shell requests completions, which typer handles itself.
            command.main(prog_name=program)
        # command.main() would use other exit codes for signals and closed pipes.
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
    except Terminated as ended:
        code = int(ended.code or 0)
        if code - 128 in _MEANINGLESS:
            say(f"{program}: {_ended_by(code - 128)}")
    except SystemExit as leaving:
        # Ray replaces the exception that a signal raises while it waits.
        if _received:
            code = 128 + _received[-1]
        # rich exits by itself if the reader of a help page has closed the pipe.
        elif isinstance(leaving.__context__, BrokenPipeError):
            code = 0
        else:
            raise
    except MemoryError:
        code = _complain(program, "not enough memory for this command", 1)
    except Exception as error:
        if any(text in str(error) for text in _NO_MEMORY):
            _leave(_complain(program, "not enough memory for a library (ulimit -v)", 1))
        if isinstance(error, RuntimeError) and "can't start new thread" in str(error):
            _leave(_complain(program, "this machine cannot start more threads", 1))
        # A C extension that is being imported replaces the exception that a signal raises.
        if _received:
            code = 128 + _received[-1]
        elif not isinstance(error, OSError):
            raise
        else:
            code = _unforeseen(program, error)
    _leave(code)


def _unforeseen(program: str, error: OSError) -> int:
    """Report an unhandled OSError, e.g. a path that is too long or a full disk."""
    failed = SourceError if error.filename else SinkError
    where = error.filename or "standard output"
    code = _complain(program, f"{where}: {error.strerror}", failed.exit_code)
    _drop_stdout()
    return code


def _leave(code: int) -> NoReturn:
    """Exit, even if a thread waits for a camera that delivers no more frames.

    Python would either wait for such a thread or end it inside OpenCV, which crashes the process
    and loses the exit code. All output is written before this call.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            # Otherwise Python flushes again at exit, fails, and changes the exit code.
            setattr(sys, name, None)
    if any(thread.name.startswith(_LEFT_BEHIND) for thread in threading.enumerate()):
        os._exit(code)
    sys.exit(code)


def _complain(program: str, message: str, code: int) -> int:
    """Print one line to stderr and return the exit code."""
    say(f"{program}: {printable(message)}")
    return code


def say(text: str) -> None:
    """Print to stderr; failures are ignored, because the exit code reports the error, too."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):
            print(text, file=sys.stderr, flush=True)


class _Closed(io.TextIOBase):
    """A standard output that was closed: only a command that needs it fails."""

    def __init__(self) -> None:
        # Otherwise the next file would get its number, and whatever prints would write into it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

    def write(self, _: str) -> NoReturn:
        """Raise SinkError."""
        raise SinkError("standard output: closed; redirect it to a file or /dev/null")

    def fileno(self) -> int:
        """Raise SinkError."""
        self.write("")


def _drop_stdout() -> None:
    """Redirect a broken stdout, so that Python does not report an error at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Terminated(SystemExit):
    """Raised on SIGTERM, meaningless signals and, in a terminal, SIGHUP, to close files and end."""


# Numbers of the signals that have raised it.
_received: list[int] = []


def follow_hang_ups() -> None:
    """Have SIGHUP open output files again, as log rotation asks daemons to.

    In a terminal, it ends the process as ever: the terminal is gone. Ignored by the parent process
    (nohup), it stays ignored.
    """
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        signal.signal(signal.SIGHUP, _hang_up)


def _hang_up(number: int, frame: FrameType | None) -> None:
    if _has_terminal():
        _terminate(number, frame)
    reopen_files()


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


def _terminate(number: int, _: FrameType | None) -> NoReturn:
    _received.append(number)
    raise Terminated(128 + number)


def _ended_by(number: int) -> str:
    name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
    return f"ended by {name}, a signal without a meaning here"


@contextlib.contextmanager
def signals_deferred() -> Iterator[None]:
    """Handle SIGINT and SIGTERM after this block only, e.g. while a child process starts.

    A handler that raises between the start of a process and the registration of its clean-up would
    leave it running. Other threads never run handlers, so nothing is deferred there.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []
    kinds = (signal.SIGINT, signal.SIGTERM)
    before = {kind: signal.signal(kind, lambda number, _: caught.append(number)) for kind in kinds}
    try:
        yield
    finally:
        for kind, handler in before.items():
            # None: a handler that was not installed from Python.
            signal.signal(kind, signal.SIG_DFL if handler is None else handler)
        for number in caught:
            signal.raise_signal(number)


def end_within_a_second() -> None:
    """Make signals that end this process end it within a second, even while C code runs.

    Python runs its signal handlers only between bytecodes, so a hanging inference, decoder or read
    would delay them. Finished records are already written.
    """
    receiver, sender = os.pipe()
    os.set_blocking(sender, False)
    signal.set_wakeup_fd(sender)

    def watch() -> None:
        while True:
            (number,) = os.read(receiver, 1)
            # A command may give a signal a meaning of its own.
            unasked = number in _MEANINGLESS and signal.getsignal(number) is _terminate
            if unasked or number in (signal.SIGINT, signal.SIGTERM):
                time.sleep(_patience_s)
                if unasked:
                    say(_ended_by(number))
                os._exit(128 + number)

    with contextlib.suppress(RuntimeError):  # no thread: only Python's own handlers
        threading.Thread(target=watch, name="cvo-edge signals", daemon=True).start()


def clean_up_within(seconds: float) -> None:
    """Grant more time after a signal, to a program that has more to finish."""
    global _patience_s
    _patience_s = seconds


def keep_libraries_off_stderr() -> None:
    """Reserve stderr for this program: C decoders and engines print messages there."""
    # If a standard descriptor is closed, the next file opened would take its place.
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
