"""Tables of ``results/decoders`` for ``bench/tables.py``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from markdown_table import table
from provenance import read_result

FILES = {"times": "synthetic room, 110 kB", "photographs": "redkitchen, 50 kB"}
DATA = {"room": "synthetic room, new flights", "kitchen": "redkitchen, between known frames"}
READ = {"half": "at half size", "means": "whole, then halved"}


def decoders() -> str:
    """Return time and equal pixels of each decoder, whole and at half size."""
    reports = [read_result("decoders", name) for name in FILES]
    head = ["decoder"]
    for files in FILES.values():
        head += [f"{files}, ms (10 %)", "/ cvo-edge, whole"]
    rows = []
    for name in reports[0]["results"]:
        cells = [name]
        for found in (report["results"][name] for report in reports):
            ms = found["ms"]
            cells += [f"{ms['median']:.2f} ({ms['p10']:.2f})"]
            cells += [f"{found['over_whole']['median']:.2f}"]
        equal = sum(report["results"][name]["equal_files"] for report in reports)
        total = sum(report["settings"]["files"] for report in reports)
        rows.append([*cells, f"{equal} of {total}"])
    return table([*head, "files with equal pixels"], rows)


def half_decoding() -> str:
    """Return coverage and width of bundles that read halves, and of the other pixels."""
    head = ["data", "calibrated on files read", "run on files read", "coverage at 0.9, joint"]
    head += ["mean width", "score", "poses moved by the other pixels, widths (99 %)"]
    return table(head, (row for name in DATA for row in _bundles(name)))


def _bundles(name: str) -> Iterator[list[str]]:
    for bundle, found in read_result("decoders", name)["results"].items():
        own = "means" if bundle == "full" else "half"
        moved = found["moved"]
        for way, seen in sorted(found["read"].items(), key=lambda item: item[0] != own):
            marginal, joint = seen["marginal"], seen["joint"]
            yield [
                *(DATA[name], READ[own], READ[way]),
                f"{np.mean(marginal['coverage']):.3f}, {joint['joint_coverage']:.3f}",
                _width(marginal),
                f"{marginal['normalised_interval_score']:.3f}",
                "" if way == own else f"{moved['median']:.3f} ({moved['p99']:.3f})",
            ]


def _width(level: dict[str, Any]) -> str:
    width = np.array(level["mean_width"])
    return f"{100 * width[:3].mean():.2f} cm, {np.degrees(width[3:].mean()):.2f} deg"


TABLES: dict[str, Callable[[], str]] = {"decoders": decoders, "half-decoding": half_decoding}
