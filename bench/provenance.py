"""Result files: where they are, and what each says of how it came about.

Every program of ``bench``, ``boards`` and ``fuzz`` that writes a result writes it with
``write_result``, so that command, commit, date and machine stand beside the figures.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cvo_edge.programs.measure import environment

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "bench" / "results"
# What a folder of results holds, and how the files were made that do not say so themselves.
STUDY_FILE = "study.json"


def write_result(path: Path, content: Mapping[str, Any]) -> None:
    """Write one result as JSON, its provenance first; folders are made where they are missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**provenance(), **content}, indent=1) + "\n", "utf-8")
    print(f"-> {path}")


def provenance() -> dict[str, Any]:
    """Return command, date (UTC), commit and machine of this process."""
    return {
        "command": command(),
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "environment": environment(),
    }


def command() -> str:
    """Return the command line of this process, with variables in place of this machine's folders.

    ``$CVO_DATA`` and ``$CVO_WEIGHTS`` stand for their values, a path within the repository is
    relative to it, of a path elsewhere only the name is kept, and the interpreter is called
    ``python``.
    """
    words = " ".join(["python", *sys.orig_argv[1:]])
    for name in ("CVO_DATA", "CVO_WEIGHTS"):
        if os.environ.get(name):
            words = words.replace(os.environ[name], f"${name}")
    return re.sub(r"(?<!\S)/(?:[^\s/]+/)*", "", words.replace(f"{ROOT}/", ""))


def commit() -> str:
    """Return the repository's commit, 12 digits; ``+`` where files differ from it."""
    describe = ["git", "describe", "--always", "--abbrev=12", "--exclude=*", "--dirty=+"]
    try:
        done = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()


def result_files(folder: str) -> list[Path]:
    """Return the result files of one folder of ``bench/results``, sorted by name."""
    return sorted(path for path in (RESULTS / folder).glob("*.json") if path.name != STUDY_FILE)


def read_result(folder: str, name: str) -> dict[str, Any]:
    """Return one result file's content, provenance included."""
    found: dict[str, Any] = json.loads((RESULTS / folder / f"{name}.json").read_text("utf-8"))
    return found
