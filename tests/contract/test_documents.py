"""Documents explain every reason and exit code, and every program has stored results."""

import json
import re
import signal
from pathlib import Path

import cvo_edge
from cvo_edge import Reason, errors
from fuzz.__main__ import FAULTS, KINDS

ROOT = Path(__file__).resolve().parents[2]


def test_every_program_has_its_results_and_no_figure_is_left_open() -> None:
    found = {path.stem for path in (ROOT / "bench" / "results" / "speed").glob("*.json")}
    programs = [
        "against",
        "files",
        "frame",
        "peers",
        "scaling",
        "soak",
        "stages",
        "start",
        "stream",
        "uncertainty_peers",
    ]
    assert found == {*programs, "study"}
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("*/README.md")):
        assert not re.search(r"@[A-Z]+@", page.read_text("utf-8")), page


def test_every_public_name_is_in_the_reference() -> None:
    page = (ROOT / "docs" / "api" / "runtime.md").read_text("utf-8")
    assert set(cvo_edge.__all__) <= set(re.findall(r"(?m)^::: cvo_edge\.(\w+)$", page))


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 150


def test_every_reason_and_every_exit_code_is_explained() -> None:
    rows = re.findall(
        r"^\| `?([a-z0-9_, ]+)`? \|", (ROOT / "docs" / "faults.md").read_text("utf-8"), re.MULTILINE
    )
    assert {row for row in rows if "_" in row} == {reason.value for reason in Reason}
    codes = {str(error.exit_code) for error in errors.CvoError.__subclasses__()}
    hung_up = str(128 + signal.SIGHUP)
    assert {row for row in rows if row.isdigit()} == codes | {"0", "1", hung_up}
    assert f"{128 + signal.SIGINT}, {128 + signal.SIGTERM}" in rows


def test_every_reason_that_takes_the_interval_has_its_remedy() -> None:
    table = (ROOT / "docs" / "faults.md").read_text("utf-8")
    degraded = set(re.findall(r"(?m)^\| `([a-z0-9_]+)` \| `degraded`", table))
    page = (ROOT / "docs" / "degraded.md").read_text("utf-8")
    headings = "".join(re.findall(r"(?m)^### .*$", page))
    assert set(re.findall(r"`([a-z0-9_]+)`", headings)) == degraded


def test_every_kind_of_damage_was_tried_without_a_finding() -> None:
    for kind, (what, count, _) in KINDS.items():
        found = json.loads((FAULTS / f"{kind}.json").read_text("utf-8"))
        assert (found["what"], found["findings"]) == (what, []), kind
        assert found["trials"] >= count, kind
