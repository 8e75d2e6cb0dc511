"""The index of ``bench/results`` for ``bench/tables.py``: what each folder holds, and how."""

from __future__ import annotations

import json

from provenance import RESULTS, STUDY_FILE


def results_index() -> str:
    """Return a section for each folder, from its ``study.json``."""
    sections = []
    for path in sorted(RESULTS.glob(f"*/{STUDY_FILE}")):
        study = json.loads(path.read_text("utf-8"))
        lines = [f"### {path.parent.name}", "", study["what"], ""]
        lines += [f"    {command}" for command in study["commands"]]
        lines += ["", f"Machine: {study['machine']}."]
        for added in study.get("added", ()):
            lines.append(
                f"{len(added['files'])} result(s) added in commit {added['commit']} "
                f"({added['date']})."
            )
        sections.append("\n".join(lines))
    return "\n\n".join(sections)
