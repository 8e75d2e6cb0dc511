"""The first table of the performance page: what one would take instead, and what it costs."""

from __future__ import annotations

from typing import Any

from markdown_table import table
from networks import BACKBONES
from provenance import read_result
from speed_tables import SHORT, number

_COMPARED = ("files", "uncertainty_peers", "stream", "start", "frame")
_NAIVE = ("forms", "naive", "over_ours", "median")


def instead_table() -> str:
    """Return the table."""
    results = {name: read_result("speed", name)["results"] for name in _COMPARED}

    def cells(program: str, *keys: str, digits: int = 2, inverse: bool = False) -> list[str]:
        row = []
        for name in BACKBONES:
            found: Any = results[program][name]
            for key in keys:
                found = found[key]
            row.append(f"1/{found:.1f}" if inverse else number(found, digits))
        return row

    files_over = ("jpg, 2", "default", "over_script", "median")
    over, fastest = ("over_onnxruntime", "median"), "fastest_over_ours"
    load_over = ("load", "cvo-edge fp32", "load_ms", "over_onnxruntime")
    costs = [
        [
            found["fp32"]["cost_of_uncertainty"]["median"]
            for found in results["frame"][name].values()
        ]
        for name in BACKBONES
    ]
    rows = [
        ["a script over JPEG files, float32", *cells("files", "cjp", "fp32", *files_over)],
        ["the script, 8 bits", *cells("files", "cjp", "int8", *files_over)],
        [
            "MC-dropout with 30 passes, in its fastest form",
            *cells("uncertainty_peers", "mc-dropout", fastest, inverse=True),
        ],
        [
            "five networks, called one after the other",
            *cells("uncertainty_peers", "ensemble", *_NAIVE, inverse=True),
        ],
        [
            "five networks, in their fastest form",
            *cells("uncertainty_peers", "ensemble", fastest, inverse=True),
        ],
        [
            "onnxruntime on a camera at 30 frames per second, float32: processor time",
            *cells("stream", "camera", "live fp32, 2", *over),
        ],
        [
            "the same, ours in 8 bits on one thread",
            *cells("stream", "camera", "live int8, 1", *over),
        ],
        ["loading the model with onnxruntime, warm cache", *cells("start", *load_over)],
        [
            "the same network without bounds, checks and alarm, float32, by method",
            *(f"{1 + min(row):.3f} to {1 + max(row):.3f}" for row in costs),
        ],
    ]
    head = ["instead of", *(f"time with cvo-edge: {SHORT[name]}" for name in BACKBONES)]
    return table(head, rows)
