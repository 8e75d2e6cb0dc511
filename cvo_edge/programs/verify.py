"""The self-test of an untrusted bundle, in a child process with limits.

A model is a program: a few hundred bytes suffice to loop forever or to request all memory, and a
damaged model may crash the engine. Therefore a child process with limited memory and time loads the
model, and answers with one line of JSON.
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
from cvo_edge.process import signals_deferred

TIMEOUT_S, SHORTEST_S, LONGEST_S = 60.0, 0.1, 86400.0
# Memory of a process without a model, and memory that onnxruntime needs per byte of a model.
_BASE_BYTES, _PER_MODEL_BYTE = 1 << 30, 8
# Stack size of a thread if the system sets no limit.
_STACK_BYTES = 8 << 20
# A pipe buffers 64 KiB without a reader.
_LONGEST_ANSWER, _LONGEST_DEFECT = 1 << 16, 8000

_CHILD = "from cvo_edge.programs.verify import child; child()"
_ERRORS: dict[int, type[CvoError]] = {
    error.exit_code: error
    for error in (UsageError, CalibrationFileError, ModelError, BundleMismatchError, GateError)
}


@dataclass(frozen=True)
class Verdict:
    """Result of a bundle that passed: name, largest self-test difference, tolerance."""

    name: str
    largest_difference: float
    tolerance: float

    def line(self) -> str:
        """Return the verdict as one line of readable text."""
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
    name: str | None = None,
) -> Verdict:
    """Check a bundle's digests and numbers, load it and run its self-test, in a child process.

    The self-test runs on the model itself and, if the cache holds one, on its cached form. With
    a public key, signature, name and version are checked, too, as ``Odometer.load`` does; nothing
    is recorded.

    Raises
    ------
    CalibrationFileError, BundleMismatchError
        As ``read_bundle`` and ``Odometer``; CalibrationFileError also as ``check_plausible``.
    ModelError
        Also if loading and self-test take longer than ``timeout_s`` seconds, need more memory than
        1 GiB plus eight times the model's size plus its threads' stacks, or end the process.
    GateError
        The model's outputs differ from those of the calibrated model, or never change.
    UsageError
        ``threads`` or ``timeout_s`` is out of range.
    """
    if not SHORTEST_S <= timeout_s <= LONGEST_S:
        raise UsageError(
            f"timeout: expected {SHORTEST_S:g} to {LONGEST_S:g} s, found {timeout_s:g}"
        )
    receiver, sender = os.pipe()
    # Non-blocking, because another process may still hold the other end of the pipe.
    os.set_blocking(receiver, False)
    with contextlib.ExitStack() as stack:
        answers = stack.enter_context(os.fdopen(receiver, "rb"))
        order = {
            "folder": str(folder),
            "threads": threads,
            "timeout_s": timeout_s,
            "public_key": None if public_key is None else str(public_key),
            "name": name,
        }
        with signals_deferred():
            try:
                process = subprocess.Popen(  # noqa: S603 - this very interpreter, no shell
                    # -P: do not import modules from the current folder.
                    [sys.executable, "-P", "-c", _CHILD, str(sender), json.dumps(order)],
                    stdin=subprocess.DEVNULL,
                    # The engine may print to stdout and stderr.
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    pass_fds=(sender,),
                )
            except OSError as error:
                raise ModelError(
                    f"{folder}: cannot start a process for the self-test: {error.strerror}"
                ) from None
            finally:
                os.close(sender)
            stack.callback(process.wait)
            stack.callback(process.kill)
        try:
            code = process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise ModelError(
                f"{folder}: loading and self-test did not end within {timeout_s:g} s; on a slow "
                "machine, give a longer --timeout"
            ) from None
        answer = answers.read(_LONGEST_ANSWER) or b""
    return _judged(folder, code, answer)


def _judged(folder: Path, code: int, answer: bytes) -> Verdict:
    if code != 0 or not answer:
        how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
        raise ModelError(f"{folder}: the process that loads and tests the model ended {how}")
    found = json.loads(answer)
    if "verdict" in found:
        return Verdict(**found["verdict"])
    if "defect" in found:
        raise RuntimeError(f"in the process of the self-test:\n{found['defect']}")
    raise _ERRORS[found["exit_code"]](found["message"])


def child() -> None:
    """Run the self-test given in ``sys.argv``, and write the result to the pipe named there."""
    sender, order = int(sys.argv[1]), json.loads(sys.argv[2])
    try:
        verdict = _selftest(**order)
        answer: dict[str, object] = {"verdict": asdict(verdict)}
    except CvoError as error:
        answer = {"exit_code": error.exit_code, "message": str(error)}
    except MemoryError:
        answer = {
            "exit_code": ModelError.exit_code,
            "message": f"{order['folder']}: not enough memory to load and test the model",
        }
    except Exception:  # noqa: BLE001 - the parent process reports a defect
        answer = {"defect": traceback.format_exc()[-_LONGEST_DEFECT:]}
    with os.fdopen(sender, "wb") as stream:
        stream.write(json.dumps(answer).encode())
    # Ends threads that a model may have left running.
    os._exit(0)


def _selftest(
    folder: str,
    threads: int | None,
    timeout_s: float,
    public_key: str | None,
    name: str | None,
) -> Verdict:
    from cvo_edge.engine.cores import checked_threads
    from cvo_edge.engine.loading import Bundle, cached_model, read_bundle
    from cvo_edge.engine.model_cache import ModelCache
    from cvo_edge.engine.selftest import check_reaction, check_selftest
    from cvo_edge.heads.plausible import check_plausible
    from cvo_edge.odometer import Odometer

    check, cache = None, ModelCache.default()
    if public_key is not None:
        from cvo_edge.bundle.signature import Trust

        trust = Trust.in_key(Path(public_key), name)
        check, cache = trust.check, cache.sealed(trust.record, trust.key_sha256)
    elif name is not None:
        raise UsageError(f"name: expected a public key with it, found none with {name}")
    bundle = read_bundle(folder, check=check)
    calibration = bundle.calibration
    _limit(len(bundle.model_bytes), checked_threads(threads), timeout_s)
    check_plausible(calibration, bundle.head)
    forms = [bundle]
    cached = cached_model(cache, calibration)
    if cached is not None:
        forms.append(Bundle(calibration, bundle.head, cached))
    first, worst = calibration.thresholds[0], 0.0
    for form in forms:
        with Odometer(
            form, threads=threads, confidence=first.confidence, scope=first.scope
        ) as odometer:
            worst = max(worst, check_selftest(odometer))
            check_reaction(odometer)
    return Verdict(calibration.name, worst, calibration.selftest.tolerance)


def _limit(model_bytes: int, threads: int, timeout_s: float) -> None:
    """Limit this process's memory, and its processor time in case the parent dies."""
    stack, _ = resource.getrlimit(resource.RLIMIT_STACK)
    stacks = threads * (_STACK_BYTES if stack == resource.RLIM_INFINITY else stack)
    _lower(resource.RLIMIT_DATA, _BASE_BYTES + stacks + _PER_MODEL_BYTE * model_bytes)
    _lower(resource.RLIMIT_CPU, int(timeout_s * (os.cpu_count() or 1)) + 1)
    _lower(resource.RLIMIT_CORE, 0)
    # If the machine runs out of memory, this process is killed first.
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", "ascii")


def _lower(kind: int, value: int) -> None:
    _, hard = resource.getrlimit(kind)
    limit = value if hard == resource.RLIM_INFINITY else min(value, hard)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(kind, (limit, limit))
