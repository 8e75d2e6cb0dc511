"""Tables in documents come from result files, and result files record their origin."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "bench" / "results"
# Fills the tables in the text on standard input.
FILL = "import sys, tables; print(tables.filled(sys.stdin.read(), 'page'), end='')"


def run(*arguments, cwd=ROOT, text=""):
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=cwd, input=text, capture_output=True, text=True, check=False, timeout=300
    )


def fill(text):
    return run("-c", FILL, cwd=ROOT / "bench", text=text)


def test_every_table_of_every_document_is_as_generated():
    done = run("bench/tables.py", "--check")
    assert done.returncode == 0, done.stderr


def test_a_changed_number_is_replaced():
    path = ROOT / "docs" / "performance.md"
    page = path.read_text("utf-8")
    number = re.search(r"<!-- table: memory -->.*?(\d\.\d\d) \|", page, re.DOTALL)
    changed = page[: number.start(1)] + "9.99" + page[number.end(1) :]
    assert changed != page
    assert fill(changed).stdout == page


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("<!-- table: memory -->\n\n| 1 |\n", "page: a table marker has no partner"),
        ("| 1 |\n<!-- end table -->\n", "page: a table marker has no partner"),
        (
            "<!-- table: memory -->\n<!-- table: goals -->\n<!-- end table -->\n",
            "page: a table marker has no partner",
        ),
        ("<!-- table: nonsense -->\n<!-- end table -->\n", "page: table nonsense cannot be made"),
    ],
)
def test_a_marker_that_cannot_be_served_is_refused_in_one_line(text, complaint):
    done = fill(text)
    assert done.returncode == 1
    assert done.stderr.startswith(complaint)
    assert len(done.stderr.splitlines()) == 1


def test_the_documents_hold_every_table_of_speed_and_the_goals():
    text = "".join(path.read_text("utf-8") for path in (ROOT / "docs").rglob("*.md"))
    code = "import speed_tables; print(*speed_tables.TABLES)"
    names = run("-c", code, cwd=ROOT / "bench").stdout.split()
    assert len(names) > 10
    for name in (*names, "precisions", "goals", "faults"):
        assert f"<!-- table: {name} -->" in text, name


def test_every_result_file_says_how_it_came_about():
    files = sorted(RESULTS.rglob("*.json"))
    assert {path.parent.parent for path in files} == {RESULTS}
    for folder in sorted(path for path in RESULTS.iterdir() if path.is_dir()):
        study = json.loads((folder / "study.json").read_text("utf-8"))
        assert study["what"]
        assert study["commands"]
        assert study["machine"]
        listed = [name for added in study.get("added", ()) for name in added["files"]]
        assert len(listed) == len(set(listed))
        assert all((folder / name).is_file() for name in listed)
        for path in folder.glob("*.json"):
            if path.name != "study.json":
                found = json.loads(path.read_text("utf-8"))
                itself = {"command", "date", "commit", "environment"} <= found.keys()
                assert itself != (path.name in listed), (
                    f"{path}: drop or add its entry in study.json"
                )
