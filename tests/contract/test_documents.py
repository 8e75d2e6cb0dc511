"""Figures in the documents are those that the programs of ``bench`` wrote."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def printed(program: str) -> str:
    command = [sys.executable, f"bench/{program}.py"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def tables(text: str) -> list[str]:
    blocks = "\n".join(line if line.startswith("|") else "" for line in text.splitlines())
    return [block for block in blocks.split("\n\n") if block.strip()]


def test_the_readme_has_the_goals_as_measured() -> None:
    assert printed("goals") in (ROOT / "README.md").read_text("utf-8")


def test_the_page_on_speed_has_every_table_as_measured() -> None:
    page = (ROOT / "docs" / "performance.md").read_text("utf-8")
    found = [block.strip() for block in tables(page)]
    expected = tables(printed("speed_tables")) + tables(printed("precision_table"))
    assert expected
    for table in expected:
        assert table.strip() in found, f"expected in docs/performance.md:\n{table}"
