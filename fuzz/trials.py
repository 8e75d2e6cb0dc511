"""Run trials, check how commands end, and count outcomes and findings."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

_PROGRAM = "from cvo_edge.__main__ import main; main()"


@dataclass
class Tally:
    """Outcomes and findings of one kind of trial; each finding is a line that identifies its trial.

    ``summary`` is the text for the table, by default the outcomes.
    """

    trials: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)
    summary: str = ""

    def add(self, outcome: str, finding: str | None = None) -> None:
        """Count one trial."""
        self.trials += 1
        self.outcomes[outcome] += 1
        if finding is not None:
            self.findings.append(finding)


@dataclass(frozen=True)
class Ended:
    """How a command ended; ``code`` is negative for a signal and None after a timeout."""

    code: int | None
    output: bytes
    errors: str
    seconds: float

    def misbehaviour(self, allowed: Sequence[int]) -> str | None:
        """Return how the command violated its contract, or None."""
        if self.code is None:
            return f"still running after {self.seconds:.0f} s"
        if self.code not in allowed:
            return f"exit code {self.code}: {self.errors[-300:]!r}"
        if "Traceback" in self.errors:
            return f"traceback: {self.errors[-300:]!r}"
        if self.code != 0 and len(self.errors.splitlines()) != 1:
            return f"expected one line on stderr: {self.errors[-300:]!r}"
        return None


def command(arguments: Sequence[object], timeout_s: float = 120.0) -> Ended:
    """Run ``cvo-edge`` with these arguments."""
    begin = time.monotonic()
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROGRAM, *map(str, arguments)],
            capture_output=True,
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired as late:
        return Ended(None, late.stdout or b"", "", time.monotonic() - begin)
    errors = done.stderr.decode("utf-8", "replace")
    return Ended(done.returncode, done.stdout, errors, time.monotonic() - begin)


def in_parallel(trial: Callable[[int], tuple[str, str | None]], count: int) -> Tally:
    """Run numbered trials in parallel, one per core; each returns an outcome and a finding."""
    tally, begin = Tally(), time.monotonic()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for number, (outcome, finding) in enumerate(pool.map(trial, range(count))):
            tally.add(outcome, finding and f"{number}: {finding}")
            if (number + 1) % max(1, count // 10) == 0:
                spent = time.monotonic() - begin
                print(
                    f"  {number + 1:>6} of {count}, {spent:.0f} s, {len(tally.findings)} findings",
                    flush=True,
                )
    return tally
