"""The self-test of a bundle that nobody trusts yet, in a process of its own with limits.

A model is a program: of a few hundred bytes it can loop for ever or ask for all memory, and an
engine that is given a damaged one may crash. So whoever asks is not the one who loads it: the child
process has a limit of memory and time, and ends with whatever its model did; its answer is one line
of JSON.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import subprocess
import sys
import traceback
from dataclasses import asdict, dataclass
from pathlib import Path

from cvo_edge.errors import (
    BundleMismatchError,
    CalibrationFileError,
    CvoError,
    GateError,
    ModelError,
    UsageError,
)

TIMEOUT_S, SHORTEST_S, LONGEST_S = 60.0, 0.1, 86400.0
# What a process needs before there is a model, and what onnxruntime makes of a byte of one.
_BASE_BYTES, _PER_MODEL_BYTE = 1 << 30, 8
# A thread's, where the system has no limit for it.
_STACK_BYTES = 8 << 20
# A pipe takes 64 KiB without a reader.
_LONGEST_ANSWER, _LONGEST_DEFECT = 1 << 16, 8000

_CHILD = "from cvo_edge.programs.verify import child; child()"
_ERRORS: dict[int, type[CvoError]] = {
    error.exit_code: error
    for error in (UsageError, CalibrationFileError, ModelError, BundleMismatchError, GateError)
}


@dataclass(frozen=True)
class Verdict:
    """A bundle that passed: its name, the largest difference in its self-test, the tolerance."""

    name: str
    largest_difference: float
    tolerance: float

    def line(self) -> str:
        """Return the verdict as a line of text for a person."""
        return (
            f"{self.name}: digests match, model loads, self-test passed (largest difference "
            f"{self.largest_difference:.2g}, tolerance {self.tolerance:g})"
        )


def verify_bundle(
    folder: Path,
    *,
    threads: int | None = None,
    timeout_s: float = TIMEOUT_S,
    public_key: Path | None = None,
) -> Verdict:
    """Check the digests of a bundle, load it and run its self-test, in a child process.

    Of the model as it is, and as the cache of prepared models has it, where it has. With a public
    key the signature as well, and that the version is none that this device has gone beyond.

    Raises
    ------
    CalibrationFileError, BundleMismatchError
        As ``read_bundle`` and ``Odometer``.
    ModelError
        As well where loading and self-test took longer than ``timeout_s`` seconds, more memory than
        1 GiB, eight times the model's size and its threads' stacks, or the process itself.
    GateError
        The model computes something else than what was calibrated.
    UsageError
        ``threads`` or ``timeout_s`` is out of range.
    """
    if not SHORTEST_S <= timeout_s <= LONGEST_S:
        raise UsageError(
            f"timeout: expected {SHORTEST_S:g} to {LONGEST_S:g} s, found {timeout_s:g}"
        )
    receiver, sender = os.pipe()
    # All there is once the process has ended, whoever else may hold the other end.
    os.set_blocking(receiver, False)
    with contextlib.ExitStack() as stack:
        answers = stack.enter_context(os.fdopen(receiver, "rb"))
        order = {
            "folder": str(folder),
            "threads": threads,
            "timeout_s": timeout_s,
            "public_key": None if public_key is None else str(public_key),
        }
        try:
            process = subprocess.Popen(  # noqa: S603 - this very interpreter, no shell
                # -P: a folder that happens to be the current one is not where modules come from.
                [sys.executable, "-P", "-c", _CHILD, str(sender), json.dumps(order)],
                stdin=subprocess.DEVNULL,
                # An engine may print there.
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=(sender,),
            )
        except OSError as error:
            raise ModelError(
                f"{folder}: expected a process for the self-test, found none: {error.strerror}"
            ) from None
        finally:
            os.close(sender)
        stack.callback(process.wait)
        stack.callback(process.kill)
        try:
            code = process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise ModelError(
                f"{folder}: expected loading and self-test within {timeout_s:g} s, found them "
                "still at work (--timeout for a slow machine)"
            ) from None
        answer = answers.read(_LONGEST_ANSWER) or b""
    return _judged(folder, code, answer)


def _judged(folder: Path, code: int, answer: bytes) -> Verdict:
    if code != 0 or not answer:
        how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
        raise ModelError(
            f"{folder}: expected a model that loads and answers, found its process ended {how}"
        )
    found = json.loads(answer)
    if "verdict" in found:
        return Verdict(**found["verdict"])
    if "defect" in found:
        raise RuntimeError(f"in the process of the self-test:\n{found['defect']}")
    raise _ERRORS[found["exit_code"]](found["message"])


def child() -> None:
    """Answer the order in ``sys.argv`` on the pipe it names."""
    sender, order = int(sys.argv[1]), json.loads(sys.argv[2])
    try:
        verdict = _selftest(**order)
        answer: dict[str, object] = {"verdict": asdict(verdict)}
    except CvoError as error:
        answer = {"exit_code": error.exit_code, "message": str(error)}
    except MemoryError:
        answer = {
            "exit_code": ModelError.exit_code,
            "message": f"{order['folder']}: expected a model of bearable size, found no memory",
        }
    except Exception:  # noqa: BLE001 - a defect of ours is shown by whoever asked
        answer = {"defect": traceback.format_exc()[-_LONGEST_DEFECT:]}
    with os.fdopen(sender, "wb") as stream:
        stream.write(json.dumps(answer).encode())
    # Whatever a model left running ends here.
    os._exit(0)


def _selftest(
    folder: str, threads: int | None, timeout_s: float, public_key: str | None
) -> Verdict:
    from cvo_edge.cores import checked_threads
    from cvo_edge.engine.loading import Bundle, prepared_model, read_bundle
    from cvo_edge.engine.model_cache import ModelCache
    from cvo_edge.odometer import Odometer
    from cvo_edge.programs.selftest import check_selftest

    check = None
    if public_key is not None:
        from cvo_edge.bundle.signature import Trust

        check = Trust.in_key(Path(public_key)).check
    bundle = read_bundle(folder, check=check)
    calibration = bundle.calibration
    _limit(len(bundle.model_bytes), checked_threads(threads), timeout_s)
    forms = [bundle]
    prepared = prepared_model(ModelCache.default(), calibration)
    if prepared is not None:
        forms.append(Bundle(calibration, bundle.head, prepared))
    first, worst = calibration.thresholds[0], 0.0
    for form in forms:
        with Odometer(
            form, threads=threads, confidence=first.confidence, scope=first.scope
        ) as odometer:
            worst = max(worst, check_selftest(odometer))
    return Verdict(calibration.name, worst, calibration.selftest.tolerance)


def _limit(model_bytes: int, threads: int, timeout_s: float) -> None:
    """Bound this process's memory, and its processor time should nobody be left to end it."""
    stack, _ = resource.getrlimit(resource.RLIMIT_STACK)
    stacks = threads * (_STACK_BYTES if stack == resource.RLIM_INFINITY else stack)
    _lower(resource.RLIMIT_DATA, _BASE_BYTES + stacks + _PER_MODEL_BYTE * model_bytes)
    _lower(resource.RLIMIT_CPU, int(timeout_s * (os.cpu_count() or 1)) + 1)
    _lower(resource.RLIMIT_CORE, 0)
    # Where the machine itself has less, this process is the first to go.
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", "ascii")


def _lower(kind: int, value: int) -> None:
    _, hard = resource.getrlimit(kind)
    limit = value if hard == resource.RLIM_INFINITY else min(value, hard)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(kind, (limit, limit))
