"""Compare the runtime on an emulated board with this machine: ``python -m boards arm64``.

Runs the runtime's tests and every bundle's self-test on the board. Then runs every bundle over the
same test frames on both and compares the records. Exits with 1 if a test or a self-test fails or a
difference exceeds its tolerance, and with 2 if the board cannot be set up.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from bench.provenance import write_result
from boards.compare import (
    TOLERANCES,
    Difference,
    Records,
    coverage,
    coverage_lines,
    difference,
    difference_lines,
    exceeded,
    stacked,
)
from boards.frames import DATASET, write_test_frames
from boards.machine import BOARDS, FOLDER, ROOT, Board, SetUpError, emulator_version, set_up
from cvo_edge.bundle.format import CALIBRATION_FILE, Calibration
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.engine.cores import allowed_cores
from cvo_edge.errors import CvoError
from cvo_edge.output.records import read_records
from cvo_edge.pose import Chart
from cvo_edge.trajectories.poses import MATRIX_SUFFIX, read_pose_matrix

CONFIDENCE = 0.9

# Marker of tests that are too slow on an emulated processor.
MARKS = "whole_clip"

# Joint sets differ from marginal sets only in their thresholds. A fifth of the frames is enough for
# them, because an emulated inference takes a second.
JOINT_SHARE = 5
# Saturated products move positions by centimetres, rounding by less than a micrometre.
CONTROL_FRAMES = 5
LEAST_SATURATION_M = 1e-3

# Methods whose sets change by whole classes.
STEPWISE = ("csp",)

_RUNTIME = ("-c", "from cvo_edge.__main__ import main; main()")


def main() -> int:
    """Run everything, print the tables and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m boards")
    parser.add_argument("board", choices=BOARDS)
    parser.add_argument(
        "--bundles", nargs="+", type=Path, default=demonstrations(), help="default: all"
    )
    parser.add_argument(
        "--frames-per-flight", type=int, choices=range(1, 51), default=5, metavar="N"
    )
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    board, per_flight = BOARDS[options.board], options.frames_per_flight
    frames = FOLDER / f"frames-{per_flight}"
    try:
        python = set_up(board)
        calibrations = {folder: read_calibration(folder) for folder in options.bundles}
        for calibration in calibrations.values():
            write_test_frames(frames, calibration.calibration.split, per_flight)
    except (SetUpError, CvoError) as error:
        print(f"boards: {error}", file=sys.stderr)
        return 2
    print(f"== {board.meaning}: {emulator_version(board)}, {board.cpu}", flush=True)
    tests = run_tests(board, python)
    with ThreadPoolExecutor(allowed_cores()) as pool:
        jobs = partial(examine, board, python, frames)
        reports = list(pool.map(jobs, calibrations.keys(), calibrations.values()))
    print_tables(reports)
    if options.json:
        figures = {
            "emulated": {
                "processor": f"{board.meaning} ({board.cpu})",
                "emulator": emulator_version(board),
                **software(python),
            },
            "compared_with": software(Path(sys.executable)),
            "dataset": f"{DATASET}, {per_flight} frames of each test flight",
            "confidence": CONFIDENCE,
            "tests": tests,
            "tolerances": {name: asdict(each) for name, each in TOLERANCES.items()},
            "bundles": reports,
        }
        write_result(options.json, figures)
    failures = [f"{r['name']}: {line}" for r in reports for line in r["failures"]]
    if tests["failed"]:
        failures.insert(0, f"tests: {tests['failed']} failed")
    print(*failures or [f"{board.name} agrees with {platform.machine()}"], sep="\n")
    return 1 if failures else 0


def demonstrations() -> list[Path]:
    """Return the folders of the bundles in the repository."""
    files = sorted((ROOT / "calibration_artifacts").glob(f"*/{CALIBRATION_FILE}"))
    return [file.parent for file in files]


def run_tests(board: Board, python: Path) -> dict[str, int]:
    """Run the runtime's tests on the board, with their output, and return counts by outcome."""
    report = FOLDER / f"{board.name}-tests.xml"
    report.unlink(missing_ok=True)
    print(f"tests: {', '.join(board.tests)}; without those marked {MARKS}", flush=True)
    marks = ("-m", f"not ({MARKS})", f"--junitxml={report}")
    parallel = ("-n", str(allowed_cores()), "--dist=load")
    command: list[str | Path] = [python, "-m", "pytest", "-q"]
    command += [*parallel, *marks, "--timeout=1800", *board.tests]
    code = subprocess.run(command, cwd=ROOT, env=_environment(), check=False).returncode
    if not report.is_file():
        return {"passed": 0, "skipped": 0, "failed": 1}
    suite = next(ElementTree.parse(report).iter("testsuite"))
    counts = {name: int(suite.get(name, 0)) for name in ("tests", "skipped", "failures", "errors")}
    # pytest itself may fail although every test passed.
    failed = counts["failures"] + counts["errors"] or int(code != 0)
    passed = counts["tests"] - counts["skipped"] - counts["failures"] - counts["errors"]
    return {"passed": passed, "skipped": counts["skipped"], "failed": failed}


def examine(
    board: Board, python: Path, frames: Path, folder: Path, calibration: Calibration
) -> dict[str, Any]:
    """Run one bundle's self-test and compare its records; returns its figures and failures."""
    name, precision = calibration.name, calibration.model.precision
    tolerance, stepwise = TOLERANCES[precision], calibration.method in STEPWISE
    failures = []
    tested = _call(python, *_RUNTIME, "verify", folder, "--threads=1", "--timeout=3600")
    said = (tested.stdout or tested.stderr).strip()
    if tested.returncode != 0:
        failures.append(f"verify: {said}")
    print(f"{board.name}: {said}", flush=True)
    count = len(list(frames.glob("*" + MATRIX_SUFFIX)))
    scopes: dict[str, Any] = {}
    limits = {"marginal": count, "joint": max(1, count // JOINT_SHARE)}
    for scope, limit in limits.items() if precision in board.compared else ():
        options = (f"--scope={scope}", f"--max-frames={limit}")
        here, there = (
            _records(each, f"{on}-{calibration.name}-{scope}", folder, frames, options)
            for on, each in ((platform.machine(), Path(sys.executable)), (board.name, python))
        )
        found = difference(here, there, tolerance)
        failures += [f"{scope}: {line}" for line in exceeded(found, tolerance, stepwise=stepwise)]
        scopes[scope] = {
            "difference": asdict(found),
            "coverage": {
                platform.machine(): _coverage(here, frames, calibration),
                board.name: _coverage(there, frames, calibration),
            },
        }
    report = {"name": name, "precision": precision, "self_test": said, "scopes": scopes}
    if board.saturates and precision == "int8":
        control = saturation(python, folder, frames)
        report["saturation"] = control
        if not control["without_m"] > LEAST_SATURATION_M:
            failures.append("control: expected 8-bit products to saturate without the option")
    return {**report, "failures": failures}


def saturation(python: Path, folder: Path, frames: Path) -> dict[str, float]:
    """Return the largest position error, against this machine, with and without the option.

    This is a control: if nothing saturates without onnxruntime's option, the emulated processor
    does not behave like one without VNNI.
    """
    script = (ROOT / "boards" / "saturation.py", folder, frames, str(CONTROL_FRAMES))
    here, there = (
        {key: np.array(poses) for key, poses in json.loads(_output(each, *script)).items()}
        for each in (Path(sys.executable), python)
    )
    return {
        f"{key}_m": float(np.abs(there[key] - here["with"])[:, :3].max())
        for key in ("with", "without")
    }


def software(python: Path) -> dict[str, Any]:
    """Return versions and processor as reported by ``cvo-edge doctor`` under this Python."""
    report = json.loads(_output(python, *_RUNTIME, "doctor", "--json"))
    versions = {name: text for name, text in report["versions"].items() if name != "cvo-edge"}
    # An emulated x86 reads this machine's /proc/cpuinfo, but numpy queries the processor itself.
    find = "import numpy; print(*numpy.show_config('dicts')['SIMD Extensions'].get('found', ()))"
    return {
        "architecture": report["architecture"],
        "numpy_kernels": _output(python, "-c", find).split(),
        "versions": versions,
    }


def print_tables(reports: list[dict[str, Any]]) -> None:
    """Print differences, coverage and the control, if there is one."""
    rows = [
        (report["name"], scope, each)
        for report in reports
        for scope, each in report["scopes"].items()
    ]
    print(
        *difference_lines((n, s, Difference(**each["difference"])) for n, s, each in rows), sep="\n"
    )
    print()
    print(
        *coverage_lines((n, s, on, c) for n, s, each in rows for on, c in each["coverage"].items()),
        sep="\n",
    )
    print()
    for report in reports:
        if "saturation" in report:
            control = report["saturation"]
            print(
                f"{report['name']}: position off by {1e3 * control['with_m']:.2g} mm with "
                f"session.x64quantprecision, by {1e3 * control['without_m']:.2g} mm without"
            )


def _records(
    python: Path, name: str, folder: Path, frames: Path, options: tuple[str, ...]
) -> Records:
    output = FOLDER / f"{name}.jsonl"
    output.unlink(missing_ok=True)
    # Cache keys use /proc/cpuinfo, which an emulated x86 shares with this machine.
    how = (f"--confidence={CONFIDENCE}", "--threads=1", "--no-cache", "--quiet")
    _output(python, *_RUNTIME, "run", folder, frames, *options, *how, f"--output={output}")
    return stacked(read_records(output))


def _coverage(records: Records, frames: Path, calibration: Calibration) -> dict[str, Any]:
    reference = calibration.pose.reference_q_xyzw
    chart = Chart(calibration.pose.rotation, None if reference is None else np.array(reference))
    truth = {}
    for source in records.sources:
        pose = read_pose_matrix(frames / source.replace(".color.jpg", MATRIX_SUFFIX))
        if pose is not None:
            truth[source] = pose
    return coverage(records, chart, truth)


def _output(python: Path, *arguments: str | Path) -> str:
    done = _call(python, *arguments)
    if done.returncode != 0:
        raise SystemExit(f"boards: {' '.join(map(str, arguments))}: {done.stderr.strip()}")
    return done.stdout


def _call(python: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [python, *arguments]
    return subprocess.run(
        command, cwd=ROOT, env=_environment(), capture_output=True, text=True, check=False
    )


def _environment() -> dict[str, str]:
    """Return this process's environment with the project as the only entry of PYTHONPATH.

    The model cache is separate, because its entries depend on the processor's flags.
    """
    own = {"PYTHONPATH": str(ROOT), "CVO_EDGE_CACHE": str(FOLDER / "models")}
    return {**os.environ, **own}


if __name__ == "__main__":
    sys.exit(main())
