"""Kill runs at random times: no record that was readable before may be lost."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from cvo_edge.errors import SourceError
from cvo_edge.output.records import read_records
from fuzz.bundles import ARTIFACTS
from fuzz.trials import Tally, in_parallel

BUNDLE, CLIP = ARTIFACTS / "synthetic-room-cjp-int8", ARTIFACTS / "synthetic-room-clip"
_PROGRAM = "from cvo_edge.__main__ import main; main()"
_LONGEST_S, _ATTEMPTS = 60.0, 3


def kills(count: int) -> Tally:
    """Kill a run after a random number of readable records and a short random delay."""

    def trial(number: int) -> tuple[str, str | None]:
        generator = np.random.default_rng([2027, number])
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "records.jsonl"
            for _ in range(_ATTEMPTS):
                try:
                    seen, code = _killed(path, generator)
                except RuntimeError as hang:
                    return "hangs", str(hang)
                if code == -signal.SIGKILL:
                    return _what_is_left(path, seen)
                if code != 0:
                    return "ended", f"ended with exit code {code} before it was killed"
        return "ended", "ended before it was killed, in every attempt"

    return in_parallel(trial, count)


def _killed(path: Path, generator: np.random.Generator) -> tuple[int, int]:
    """Start a run and kill it; returns the number of records before, and the exit code."""
    wanted, more_s = int(generator.integers(1, 49)), float(generator.exponential(0.002))
    path.unlink(missing_ok=True)
    process = subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, "run", BUNDLE, CLIP, "-o", path, "--threads", "1"],
        stderr=subprocess.DEVNULL,
    )
    try:
        late = time.monotonic() + _LONGEST_S
        while _written(path) < wanted and process.poll() is None:
            if time.monotonic() > late:
                raise RuntimeError(f"expected {wanted} records within {_LONGEST_S:g} s")
            time.sleep(0.0005)
        time.sleep(more_s)
        seen = _written(path)
    finally:
        process.kill()
    return seen, process.wait()


def _written(path: Path) -> int:
    """Return the number of complete record lines; the first line is the header."""
    return max(0, path.read_bytes().count(b"\n") - 1) if path.exists() else 0


def _what_is_left(path: Path, seen: int) -> tuple[str, str | None]:
    try:
        records = [record.seq for record in read_records(path)]
    except SourceError as error:
        return "unreadable", str(error)
    if records != list(range(len(records))) or len(records) < seen:
        return "lost", f"{seen} records before the kill, {len(records)} after it"
    torn = path.read_bytes()[-1:] not in (b"", b"\n")
    return "torn last line" if torn else "whole", None
