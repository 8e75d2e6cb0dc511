"""What 8 bits would gain on ARM boards, estimated from counts of instructions.

    python -m boards.instructions

Runs bundles on emulated processors with 8-bit dot products (Cortex-A76) and without (Cortex-A72)
and counts the instructions of one inference of the network and of one step, by kind. An emulator
says nothing about time: a ratio of instructions equals the ratio of times only if they take the
same time on average, and memory is not counted at all.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from bench.provenance import write_result
from boards.machine import (
    BOARDS,
    CORTEX_A72,
    FOLDER,
    ROOT,
    ArmProcessor,
    SetUpError,
    arm_cpuinfo,
    call,
    set_up,
)

EMULATOR = "qemu-aarch64"
# In the order of the plugin's counters.
KINDS = (
    *("float products", "8-bit dot products", "integer products"),
    *("other vector", "vector memory", "other memory", "other"),
)
METHODS = ("cjp", "scr")
REPEATS = 3


# Name, qemu's name and ``/proc/cpuinfo``. The second, r4p1, has 8-bit dot products (asimddp).
_FEATURES = f"{CORTEX_A72.features} atomics fphp asimdhp asimdrdm lrcpc dcpop asimddp"
PROCESSORS = (
    ("Cortex-A72", "cortex-a72", CORTEX_A72),
    ("Cortex-A76", "cortex-a76", ArmProcessor(_FEATURES, 4, 0xD0B, 1)),
)


def built_plugin() -> Path:
    """Compile the plugin and return its file; raises SetUpError without a compiler."""
    plugin = FOLDER / "instructions.so"
    plugin.parent.mkdir(exist_ok=True)
    if not shutil.which("cc"):
        raise SetUpError("cc: not found; the counting plugin needs a C compiler")
    source = ROOT / "boards" / "instructions.c"
    call("cc", "-O2", "-Wall", "-fPIC", "-shared", "-o", str(plugin), str(source))
    return plugin


def root_of(cpu: str, processor: ArmProcessor) -> Path:
    """Return the board's system with this processor's ``/proc/cpuinfo``, which engines read."""
    system, root = FOLDER / "arm64" / "root", FOLDER / "arm64" / cpu
    (root / "proc").mkdir(parents=True, exist_ok=True)
    for entry in system.iterdir():
        if entry.name != "proc" and not (root / entry.name).is_symlink():
            (root / entry.name).symlink_to(entry)
    text = arm_cpuinfo(os.cpu_count() or 1, processor)
    (root / "proc" / "cpuinfo").write_text(text, "ascii")
    return root


def counted(
    processor: tuple[str, str, ArmProcessor], bundle: Path, python: Path, plugin: Path
) -> dict[str, Any]:
    """Return the millions of instructions of one inference and of one step, by kind."""
    name, cpu, told_of = processor
    root = root_of(cpu, told_of)
    (interpreter,) = (root / "usr" / "bin").glob("python3.[0-9]*[0-9]")
    command = (
        *(EMULATOR, "-cpu", cpu, "-plugin", str(plugin), "-L", str(root)),
        *("-0", str(python), str(interpreter), str(ROOT / "boards" / "counted.py")),
        *(str(bundle), str(REPEATS)),
    )
    # Threads that spin would be counted, too.
    alone = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    environment = {**os.environ, **alone, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    told = [line.split() for line in done.stderr.splitlines() if line.startswith("instructions ")]
    if done.returncode or len(told) != 3:
        said = (done.stderr.strip() or "no output").splitlines()[-1]
        raise SetUpError(f"{bundle.name} on {name}: exit {done.returncode}: {said}")
    marks = np.array([line[1:] for line in told], float) / 1e6
    network, step = np.diff(marks, axis=0) / REPEATS
    return {
        "processor": name,
        "bundle": bundle.name,
        **{
            what: {kind: round(float(count), 3) for kind, count in zip(KINDS, counts, strict=True)}
            for what, counts in (("network", network), ("step", step))
        },
    }


def main() -> int:
    """Count, print and write."""
    parser = argparse.ArgumentParser(prog="python -m boards.instructions", description=__doc__)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    artifacts = ROOT / "calibration_artifacts"
    bundles = [
        artifacts / f"synthetic-room-{method}{suffix}"
        for method, suffix in product(METHODS, ("", "-int8"))
    ]
    try:
        python = set_up(BOARDS["arm64"])
        if not shutil.which(EMULATOR):
            raise SetUpError(f"{EMULATOR}: not found; install the package qemu-user")
        plugin = built_plugin()
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            count = partial(counted, python=python, plugin=plugin)
            processors, given = zip(*product(PROCESSORS, bundles), strict=True)
            rows = list(pool.map(count, processors, given))
    except SetUpError as error:
        print(error)
        return 2
    for row in rows:
        network, step = (sum(row[what].values()) for what in ("network", "step"))
        print(f"{row['processor']} {row['bundle']:28} {network:7.1f} {step:7.1f} million")
    if options.json is not None:
        done = subprocess.run([EMULATOR, "--version"], capture_output=True, text=True, check=True)
        write_result(options.json, {"emulator": done.stdout.splitlines()[0], "counts": rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
