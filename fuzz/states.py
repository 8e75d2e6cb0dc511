"""Kill writers of an adaptation's state at random times: the file is the old state or the new one.

A server process forks a writer for each trial. It writes one state after the other to a file that
outlives it, with the product's own code, and counts finished writes in memory that it shares with
the server. The server kills it and reads the file, which must hold the last finished write or the
one after it. The server has no inference engine, so that a fork takes a millisecond and ten
thousand kills take minutes.
"""

from __future__ import annotations

import json
import mmap
import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from cvo_edge.bundle.reading import read_calibration
from cvo_edge.errors import CvoError
from cvo_edge.monitor.state import State, StateFile
from fuzz.trials import Tally

ROOT = Path(__file__).resolve().parent.parent
BUNDLE = ROOT / "calibration_artifacts" / "synthetic-room-cjp"
_PROGRAM = "from fuzz.states import serve; serve()"
# Kills per server, seconds from a fork to its kill, and for all of a server's kills.
_BATCH, _MOST_S, _PATIENCE_S = 250, 0.02, 600.0
_DOF = 6


def states(count: int) -> Tally:
    """Kill ``count`` writers, in servers of their own on every core."""
    tally = Tally()
    batches = [(first, min(_BATCH, count - first)) for first in range(0, count, _BATCH)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for (first, wanted), found in zip(batches, pool.map(_served, batches), strict=True):
            for number, (outcome, finding) in enumerate(found, start=first):
                tally.add(outcome, finding and f"{number}: {finding}")
            if len(found) < wanted:
                tally.add("ended", f"{first}: the server ended after {len(found)} kills")
    return tally


def _served(batch: tuple[int, int]) -> list[tuple[str, str | None]]:
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *map(str, batch)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=_PATIENCE_S,
        check=False,
    )
    return [(outcome, finding) for outcome, finding in map(json.loads, done.stdout.splitlines())]


def serve() -> None:
    """Kill writers with the numbers of the command line; print each outcome as a JSON line."""
    first, count = map(int, sys.argv[1:])
    finished = mmap.mmap(-1, 8)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "state.json"
        file = StateFile(path, read_calibration(BUNDLE), 0.9, "marginal")
        file.write(_numbered(0))
        for number in range(first, first + count):
            _kill_a_writer(file, finished, np.random.default_rng([2028, number]))
            print(json.dumps(_left(file, finished)), flush=True)


def _numbered(number: int) -> State:
    """Return a state that its number of labels tells apart from all others; lengths differ."""
    x = tuple(((number * (dof + 0.37)) % 16.0 - 8.0) / (1 + number % 7) for dof in range(_DOF))
    return State(x, number, number % 2 == 1)


def _kill_a_writer(file: StateFile, finished: mmap.mmap, generator: np.random.Generator) -> None:
    life_s = float(generator.uniform(0.0, _MOST_S))
    writer = os.fork()
    if writer == 0:
        # Ends by itself if the server is gone.
        signal.alarm(10)
        (number,) = struct.unpack("=Q", finished[:])
        while True:
            number += 1
            file.write(_numbered(number))
            finished[:] = struct.pack("=Q", number)
    time.sleep(life_s)
    os.kill(writer, signal.SIGKILL)
    os.waitpid(writer, 0)


def _left(file: StateFile, finished: mmap.mmap) -> tuple[str, str | None]:
    """Return the outcome and the finding of a kill; the file's state is where the next begins."""
    (last,) = struct.unpack("=Q", finished[:])
    torn = any(file.path.parent.glob("*.partial"))
    try:
        found = file.read(_DOF)
    except CvoError as error:
        return "unreadable", str(error)
    if found is None:
        return "lost", "no file"
    if found not in (_numbered(last), _numbered(last + 1)):
        return "another state", f"{found} after {last} finished writes"
    finished[:] = struct.pack("=Q", found.labels)
    outcome = "the new state" if found.labels > last else "the old state"
    return f"{outcome}, and an unfinished file" if torn else outcome, None
