"""Emulated boards: Python for another processor, with the runtime only, under qemu-user.

Each board is a virtual environment in its own folder, and its ``bin/python`` starts the emulator.
Python treats this script as its executable, so child processes are emulated too.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, NamedTuple

from cvo_edge.vocabulary import Precision

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / ".boards"

# Packages required by tests/edge and pytest's settings in pyproject.toml. The other packages of the
# extra are oracles.
TEST_PACKAGES = ("pytest", "hypothesis", "pytest-timeout", "pytest-xdist")

# Python version of Debian 12, and the newest glibc that its wheels may require.
_DEBIAN_PYTHON = "3.11"
_GLIBC_MINOR = 36

_PROCESSOR = """\
processor\t: {number}
BogoMIPS\t: 108.00
Features\t: {features}
CPU implementer\t: 0x41
CPU architecture: 8
CPU variant\t: 0x{variant:x}
CPU part\t: 0x{part:x}
CPU revision\t: {revision}

"""


class ArmProcessor(NamedTuple):
    """What ``/proc/cpuinfo`` says of an ARM processor."""

    features: str
    variant: int
    part: int
    revision: int


# Revision r0p3, with the features of qemu's.
CORTEX_A72 = ArmProcessor("fp asimd evtstrm aes pmull sha1 sha2 crc32 cpuid", 0, 0xD08, 3)


class SetUpError(Exception):
    """A board's requirement is missing or failed; the message is one line."""


@dataclass(frozen=True)
class Board:
    """A processor to emulate.

    Attributes
    ----------
    name, meaning
        Name on the command line and description.
    emulator, cpu
        qemu program, and its name for the processor.
    saturates
        Whether 8-bit products saturate unless an option of onnxruntime prevents it.
    tests
        Tests to run on the board. They need only the runtime; other contract tests also need onnx.
    compared
        Precisions whose records are compared; for the others, only the self-test runs.
    """

    name: str
    meaning: str
    emulator: str
    cpu: str
    saturates: bool
    tests: tuple[str, ...]
    compared: tuple[Precision, ...]


_WITHOUT_NETWORKS = ("conformal", "geometry", "ground_truth", "heads", "pose", "preprocess")
_PREPARED = "tests/edge/test_model_cache.py::test_a_prepared_model_computes_the_very_same"

BOARDS = {
    board.name: board
    for board in (
        Board(
            "arm64",
            "64-bit ARM, as in a Raspberry Pi 4",
            "qemu-aarch64-static",
            "cortex-a72",
            saturates=False,
            tests=("tests/edge", "tests/contract/test_demonstrations.py"),
            compared=("fp32", "int8"),
        ),
        Board(
            "avx2",
            "x86-64 with AVX2, without AVX-512 and VNNI",
            "qemu-x86_64-static",
            # The emulator warns on stderr about features it lacks, so they are disabled here.
            "Haswell-noTSX,-pcid,-x2apic,-tsc-deadline,-invpcid",
            saturates=True,
            # Under this emulator a frame takes 18 seconds in float32 and one second in 8 bits.
            tests=(
                *(f"tests/edge/test_{name}.py" for name in _WITHOUT_NETWORKS),
                f"{_PREPARED}[cjp-int8]",
            ),
            compared=("int8",),
        ),
    )
}


def set_up(board: Board) -> Path:
    """Install the board's Python in ``.boards/<name>/`` and return its path.

    Reuses existing parts. Raises SetUpError if a requirement is missing or a step fails.
    """
    if (sys.platform, platform.machine()) != ("linux", "x86_64"):
        found = f"{platform.system()} on {platform.machine()}"
        raise SetUpError(f"{board.name}: expected Linux on x86_64 to compare with, found {found}")
    _install_emulator(board)
    folder = FOLDER / board.name
    folder.mkdir(parents=True, exist_ok=True)
    if board.name == "arm64":
        root = folder / "root"
        if not root.is_dir():
            _extract_debian(folder, root)
        interpreter = root / "usr" / "bin" / f"python{_DEBIAN_PYTHON}"
        emulator = f'{board.emulator} -cpu {board.cpu} -L "{root}"'
        wheels = _arm_wheel_options()
        version = _DEBIAN_PYTHON
    else:
        interpreter = Path(sys.executable).resolve()
        emulator = f"{board.emulator} -cpu {board.cpu}"
        wheels = []
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
    # Otherwise the packages of this machine's Python would be visible.
    alone = "include-system-site-packages = false"
    (folder / "pyvenv.cfg").write_text(f"home = {interpreter.parent}\n{alone}\n", "utf-8")
    python = folder / "bin" / "python"
    python.parent.mkdir(exist_ok=True)
    python.write_text(f'#!/bin/sh\nexec {emulator} -0 "$0" "{interpreter}" "$@"\n', "utf-8")
    python.chmod(0o755)
    _install_packages(folder, folder / "lib" / f"python{version}" / "site-packages", wheels)
    return python


def emulator_version(board: Board) -> str:
    """Return the emulator's own statement of name and version."""
    done = subprocess.run([board.emulator, "--version"], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[0]


def requirements(project: Mapping[str, Any]) -> list[str]:
    """Return the requirements of the runtime and its tests from the parsed ``pyproject.toml``.

    Raises SetUpError if the extra ``test`` lacks one of ``TEST_PACKAGES``.
    """
    table = project["project"]
    tests = {_package(line): line for line in table["optional-dependencies"]["test"]}
    missing = [name for name in TEST_PACKAGES if name not in tests]
    if missing:
        raise SetUpError(f"pyproject.toml: expected {', '.join(missing)} in the extra test")
    return [*table["dependencies"], *(tests[name] for name in TEST_PACKAGES)]


def _package(requirement: str) -> str:
    return re.split(r"[^A-Za-z0-9._-]", requirement, maxsplit=1)[0].lower()


def _install_emulator(board: Board) -> None:
    if shutil.which(board.emulator):
        return
    if not shutil.which("apt-get") or os.geteuid() != 0:
        raise SetUpError(
            f"{board.emulator}: not found; install the package qemu-user-static, or run this as "
            "root on a system with apt-get"
        )
    call("apt-get", "-qq", "update")
    call("apt-get", "-qq", "-y", "--no-install-recommends", "install", "qemu-user-static")


def _extract_debian(folder: Path, root: Path) -> None:
    """Unpack Debian's Python for ARM into ``root``, without installing any package."""
    for program in ("apt-get", "dpkg-deb"):
        if not shutil.which(program):
            raise SetUpError(f"{program}: not found; the ARM Python comes from Debian packages")
    work, partial = folder / "packages", folder / "root.partial"
    for old in (work, partial):
        shutil.rmtree(old, ignore_errors=True)
    (work / "lists" / "partial").mkdir(parents=True)
    (work / "cache" / "archives" / "partial").mkdir(parents=True)
    (work / "status").touch()
    # Use separate lists and an empty status, so that all dependencies are downloaded and this
    # machine's package database is not changed.
    settings = {
        "APT::Architecture": "arm64",
        "APT::Architectures": "arm64",
        "APT::Sandbox::User": "root",
        "Dir::State": work,
        "Dir::State::status": work / "status",
        "Dir::Cache": work / "cache",
        "Dir::Etc::preferences": "/dev/null",
        "Dir::Etc::preferencesparts": "/dev/null",
    }
    apt = ["apt-get", "-qq", *(f"--option={key}={value}" for key, value in settings.items())]
    call(*apt, "update")
    download = ["--yes", "--no-install-recommends", "--download-only", "install"]
    call(*apt, *download, f"python{_DEBIAN_PYTHON}", "libstdc++6")
    for package in sorted((work / "cache" / "archives").glob("*.deb")):
        call("dpkg-deb", "--extract", str(package), str(partial))
    # onnxruntime reads /proc/cpuinfo on import and crashes if it describes an x86 processor.
    (partial / "proc").mkdir()
    (partial / "proc" / "cpuinfo").write_text(arm_cpuinfo(os.cpu_count() or 1, CORTEX_A72), "ascii")
    shutil.rmtree(work)
    partial.rename(root)


def arm_cpuinfo(cores: int, processor: ArmProcessor) -> str:
    """Return ``/proc/cpuinfo`` of a processor."""
    told = processor._asdict()
    return "".join(_PROCESSOR.format(number=number, **told) for number in range(cores))


def _arm_wheel_options() -> list[str]:
    """Return pip options that select wheels for ARM and Debian's Python."""
    platforms = [f"manylinux_2_{minor}_aarch64" for minor in range(_GLIBC_MINOR, 16, -1)]
    tag = "cp" + _DEBIAN_PYTHON.replace(".", "")
    return [
        "--only-binary=:all:",
        "--implementation=cp",
        f"--python-version={_DEBIAN_PYTHON}",
        *(f"--abi={abi}" for abi in (tag, "abi3", "none")),
        *(f"--platform={name}" for name in (*platforms, "manylinux2014_aarch64")),
    ]


def _install_packages(folder: Path, site: Path, wheels: list[str]) -> None:
    """Install the packages of the runtime and its tests, in the versions of this Python.

    Other versions could compute different numbers on the same processor.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    wanted = "\n".join(requirements(project)) + "\n"
    found = {_package(item.name): item.version for item in distributions()}
    same = "".join(f"{name}=={version}\n" for name, version in sorted(found.items()))
    stamp = folder / "installed"
    state = hashlib.sha256("\n".join([wanted, same, *wheels]).encode()).hexdigest()
    if stamp.is_file() and stamp.read_text("ascii") == state:
        return
    shutil.rmtree(site, ignore_errors=True)
    (folder / "requirements.txt").write_text(wanted, "utf-8")
    (folder / "constraints.txt").write_text(same, "utf-8")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-compile", f"--target={site}"]
    files = (f"{folder}/requirements.txt", f"--constraint={folder}/constraints.txt")
    call(*pip, *wheels, "--requirement", *files)
    stamp.write_text(state, "ascii")


def call(*command: str) -> None:
    """Run a command; raises SetUpError with the last line that it said if it fails."""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode != 0:
        said = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()
        raise SetUpError(f"{Path(command[0]).name}: exit code {done.returncode}: {said[-1]}")
