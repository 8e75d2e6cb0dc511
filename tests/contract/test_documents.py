"""Figures in the documents are those that the programs of ``bench`` wrote."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

from cvo_edge import Reason, errors
from fuzz.__main__ import KINDS, RESULTS
from fuzz.__main__ import table as fuzz_table

ROOT = Path(__file__).resolve().parents[2]


def printed(program: str) -> str:
    command = [sys.executable, f"bench/{program}.py"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def tables(text: str) -> list[str]:
    blocks = "\n".join(line if line.startswith("|") else "" for line in text.splitlines())
    return [block for block in blocks.split("\n\n") if block.strip()]


def test_every_program_has_its_results_and_no_figure_is_left_open() -> None:
    found = {path.stem for path in (ROOT / "bench" / "results" / "speed").glob("*.json")}
    programs = ("frame", "stream", "start", "scaling", "peers", "uncertainty_peers", "soak")
    assert found == set(programs)
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("*/README.md")):
        assert not re.search(r"@[A-Z]+@", page.read_text("utf-8")), page


def test_the_page_on_speed_has_the_goals_as_measured() -> None:
    assert printed("goals") in (ROOT / "docs" / "performance.md").read_text("utf-8")


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 150


def test_the_page_on_speed_has_every_table_as_measured() -> None:
    page = (ROOT / "docs" / "performance.md").read_text("utf-8")
    found = [block.strip() for block in tables(page)]
    expected = tables(printed("speed_tables")) + tables(printed("precision_table"))
    assert expected
    for table in expected:
        assert table.strip() in found, f"expected in docs/performance.md:\n{table}"


def test_every_reason_and_every_exit_code_is_explained() -> None:
    rows = re.findall(
        r"^\| `?([a-z0-9_, ]+)`? \|", (ROOT / "docs" / "faults.md").read_text("utf-8"), re.MULTILINE
    )
    assert {row for row in rows if "_" in row} == {reason.value for reason in Reason}
    codes = {str(error.exit_code) for error in errors.CvoError.__subclasses__()}
    assert {row for row in rows if row.isdigit()} == codes | {"0", "1"}
    assert f"{128 + signal.SIGINT}, {128 + signal.SIGTERM}" in rows


def test_what_was_tried_is_told_as_counted() -> None:
    assert fuzz_table() in (ROOT / "docs" / "faults.md").read_text("utf-8")
    assert fuzz_table() == (RESULTS / "table.txt").read_text("utf-8")
    found = {kind: json.loads((RESULTS / f"{kind}.json").read_text("utf-8")) for kind in KINDS}
    for kind, (what, count, _) in KINDS.items():
        assert (found[kind]["what"], found[kind]["findings"]) == (what, []), kind
        assert found[kind]["trials"] >= count, kind
