"""Fresh processes that measure when they are told to, of this checkout or of another.

Both checkouts read the same bundles, on the same cores, and take turns of a fraction of a second,
so that a change of the machine's speed affects both.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from provenance import ROOT

# What every worker does: one line of JSON out for each line in. The text that defines ``answer``
# comes before it, and may import no more than both checkouts have.
_LOOP = """
for line in sys.stdin:
    print(json.dumps(answer(json.loads(line))), flush=True)
"""


class Worker:
    """One process; ``program`` defines ``answer(what)`` and finds its arguments in ``sys.argv``.

    It may use the first ``cores`` of the cores that this process may use.
    """

    def __init__(
        self, program: str, arguments: Sequence[object], cores: int, checkout: Path = ROOT
    ) -> None:
        allowed = sorted(os.sched_getaffinity(0))[:cores]
        if len(allowed) < cores:
            raise SystemExit(f"expected at least {cores} cores, found {len(allowed)}")
        pin = f"import os, sys, json; os.sched_setaffinity(0, {allowed})\n"
        text = [sys.executable, "-P", "-c", pin + program + _LOOP, *map(str, arguments)]
        environment = {**os.environ, "PYTHONPATH": str(checkout), "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            text,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=checkout,
            env=environment,
        )

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End the process."""
        self._process.communicate()

    def turn(self, what: object = None) -> Any:  # noqa: ANN401 - whatever the program answers
        """Measure one turn; raises SystemExit where the process has ended."""
        stdin, stdout = self._process.stdin, self._process.stdout
        if stdin is None or stdout is None:
            raise RuntimeError("expected pipes to the process")
        stdin.write(json.dumps(what) + "\n")
        stdin.flush()
        line = stdout.readline()
        if not line:
            raise SystemExit(f"a worker ended with exit code {self._process.wait()}")
        return json.loads(line)


def commit_of(checkout: Path) -> str:
    """Return the commit of another checkout, 12 digits."""
    done = subprocess.run(
        ["git", "rev-parse", "--short=12", "HEAD"],
        cwd=checkout,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()
