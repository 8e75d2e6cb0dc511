"""Runs that are killed at any time: every record that was there before is there after."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from cvo_edge.errors import SourceError
from cvo_edge.records import read_records
from fuzz.bundles import ARTIFACTS
from fuzz.trials import Tally, beside_each_other

BUNDLE, CLIP = ARTIFACTS / "synthetic-room-cjp-int8", ARTIFACTS / "synthetic-room-clip"
_PROGRAM = "from cvo_edge.cli import main; main()"
_LONGEST_S = 60.0


def kills(count: int) -> Tally:
    """Kill a run after a random number of records that a reader has seen, and a random moment."""

    def trial(number: int) -> tuple[str, str | None]:
        generator = np.random.default_rng([2027, number])
        wanted, more_s = int(generator.integers(1, 49)), float(generator.exponential(0.002))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "records.jsonl"
            process = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM, "run", BUNDLE, CLIP, "-o", path, "--threads", "1"],
                stderr=subprocess.DEVNULL,
            )
            seen, late = 0, time.monotonic() + _LONGEST_S
            while seen < wanted and process.poll() is None and time.monotonic() < late:
                seen = path.read_bytes().count(b"\n") if path.exists() else 0
                time.sleep(0.0005)
            time.sleep(more_s)
            # What the last look saw is what was acknowledged.
            seen = path.read_bytes().count(b"\n") if path.exists() else 0
            ended = process.poll() is not None
            process.kill()
            process.wait()
            try:
                records = [record.seq for record in read_records(path)]
            except SourceError as error:
                return "unreadable", str(error)
            torn = not path.read_bytes().endswith(b"\n")
            if records != list(range(len(records))) or len(records) < seen:
                return "lost", f"{seen} records were seen, {len(records)} are there"
            if ended:
                return "had ended before", None
            return "torn last line" if torn else "whole", None

    return beside_each_other(trial, count)
