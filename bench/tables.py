"""Tables in Markdown files, generated from ``bench/results``.

    python bench/tables.py            # fill every table of every Markdown file
    python bench/tables.py --check    # exit 1 where a file is not what would be written
    python bench/tables.py NAME ...   # print tables; --list prints all names

A table stands between two comments, ``<!-- table: NAME -->`` and ``<!-- end table -->``; what is
between them is replaced. ``python bench/tables.py "evaluation FOLDER/NAME"`` prints one evaluation
of ``paper-methods``, ``augmentation``, ``members`` or ``demonstrations`` with all confidences.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path

import accuracy_tables
import comparison_tables
import decoder_tables
import localiser_tables
import message_tables
import motion_tables
import odometry_tables
import pareto_tables
import promised_table
import reconstruct_tables
import recording_tables
import service_tables
import speed_tables
import study_tables
import vigilance_tables
from goals import goals_table
from instead_table import instead_table
from provenance import ROOT
from results_index import results_index

BLOCK = re.compile(r"<!-- table: (?P<name>[^\n]+?) -->\n.*?<!-- end table -->", re.DOTALL)
MARKER = re.compile(r"<!-- (?:table: [^\n]+?|end table) -->")
EVALUATION = "evaluation "


def faults() -> str:
    """Return what was tried with damaged input, as ``python -m fuzz`` prints it."""
    sys.path.insert(0, str(ROOT))
    # Only here: it takes the start of everything that is tried.
    from fuzz.__main__ import table

    return table().strip()


TABLES: dict[str, Callable[[], str]] = {
    **accuracy_tables.TABLES,
    **comparison_tables.TABLES,
    **decoder_tables.TABLES,
    **study_tables.TABLES,
    **localiser_tables.TABLES,
    **speed_tables.TABLES,
    **vigilance_tables.TABLES,
    **promised_table.TABLES,
    **message_tables.TABLES,
    **motion_tables.TABLES,
    **odometry_tables.TABLES,
    **pareto_tables.TABLES,
    **recording_tables.TABLES,
    **reconstruct_tables.TABLES,
    **service_tables.TABLES,
    "faults": faults,
    "goals": goals_table,
    "instead": instead_table,
    "results": results_index,
}


def table(name: str) -> str:
    """Return a table by its name; raises KeyError where there is no such table."""
    if name.startswith(EVALUATION):
        return accuracy_tables.evaluation(name.removeprefix(EVALUATION))
    return TABLES[name]()


def filled(text: str, where: str) -> str:
    """Return a Markdown text with the content of every table replaced.

    Raises SystemExit where a marker has no partner or a name is unknown.
    """
    if len(MARKER.findall(text)) != 2 * len(BLOCK.findall(text)):
        raise SystemExit(f"{where}: a table marker has no partner")

    def replaced(block: re.Match[str]) -> str:
        name = block["name"]
        try:
            content = table(name)
        except (KeyError, OSError) as error:
            raise SystemExit(f"{where}: table {name} cannot be made: {error!r}") from None
        return f"<!-- table: {name} -->\n\n{content}\n\n<!-- end table -->"

    return BLOCK.sub(replaced, text)


def pages() -> list[Path]:
    """Return the Markdown files that may hold tables."""
    found = [*ROOT.glob("*.md"), *ROOT.glob("*/README.md"), *ROOT.glob("bench/results/*.md")]
    return sorted({*found, *ROOT.glob("docs/**/*.md")})


def main() -> int:
    """Fill, check or print -> the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="tables to print")
    parser.add_argument("--check", action="store_true", help="write nothing")
    parser.add_argument("--list", action="store_true", help="print the names of all tables")
    arguments = parser.parse_args()
    if arguments.list:
        print(*TABLES, f"{EVALUATION}FOLDER/NAME", sep="\n")
        return 0
    if arguments.names:
        print(*map(table, arguments.names), sep="\n\n")
        return 0
    stale = []
    for path in pages():
        text, where = path.read_text("utf-8"), str(path.relative_to(ROOT))
        if (new := filled(text, where)) == text:
            continue
        stale.append(where)
        if not arguments.check:
            path.write_text(new, "utf-8")
    if stale and arguments.check:
        print(f"{', '.join(stale)}: not as generated; run python bench/tables.py", file=sys.stderr)
        return 1
    print(*(f"-> {where}" for where in stale), sep="\n", end="\n" if stale else "")
    return 0


if __name__ == "__main__":
    sys.exit(main())
