"""Tables of ``results/speed`` and ``results/boards`` for ``bench/tables.py``.

Figures are medians, with 95th percentiles in brackets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from markdown_table import table
from networks import BACKBONES
from provenance import read_result

SHORT = {
    "mobilenetv2_100": "MobileNetV2",
    "resnet34": "ResNet34",
    "demonstration": "truncated network",
}

Rows = Iterator[list[str]]


def number(value: float, digits: int = 2) -> str:
    """Fixed digits."""
    return f"{value:.{digits}f}"


def two(found: Mapping[str, float], digits: int = 2) -> str:
    """Median and 95th percentile."""
    return f"{found['median']:.{digits}f} ({found['p95']:.{digits}f})"


def frame(results: dict[str, Any]) -> Rows:
    """One frame of every bundle."""
    yield [
        *("network", "method", "", "raw call, ms", "array to interval / raw call"),
        *("array to interval - raw call, ms", "file to record / raw call", "cost of uncertainty"),
        "after the network, ms",
    ]
    for name, label in SHORT.items():
        for method, found in results[name].items():
            for precision in ("fp32", "int8"):
                yield [label, method, precision, *_frame_cells(found[precision])]
    for name, found in results["halved"].items():
        yield [f"{SHORT[name]}, 240x240", "cjp", "fp32", *_frame_cells(found)]


def _frame_cells(found: dict[str, Any]) -> list[str]:
    return [
        two(found["ms"]["raw"]),
        two(found["step_over_raw"], 3),
        two(found["step_minus_raw_ms"]),
        two(found["record_over_raw"]),
        two(found["cost_of_uncertainty"], 3),
        two(found["after_network_ms"], 3),
    ]


def precision(results: dict[str, Any]) -> Rows:
    """What 8 bits save in the bare call."""
    methods = list(results[BACKBONES[0]])
    yield ["raw call: float32 / 8 bits", *methods]
    for name, label in SHORT.items():
        yield [label, *(two(results[name][m]["fp32_over_int8"]) for m in methods)]


def files(results: dict[str, Any]) -> Rows:
    """Files to records over the script's time."""
    yield [
        *("network", "method", "", "script, ms", "`latency`", "`throughput`", "default"),
        *("default before", "one core: `latency`", "default", "BMP: default", "on one core"),
    ]
    for name in BACKBONES:
        for method, rows in results[name].items():
            for kind, found in rows.items():
                two_cores, one_core = found["jpg, 2"], found["jpg, 1"]
                # One bundle is for JPEG files alone.
                plain = [found.get(f"bmp, {cores}", {}) for cores in (2, 1)]
                cells = [
                    *(_over(two_cores, mode) for mode in ("latency", "throughput", "default")),
                    _over(two_cores, "before, default"),
                    *(_over(one_core, mode) for mode in ("latency", "default")),
                    *(_over(row, "default") for row in plain),
                ]
                yield [SHORT[name], method, kind, two(two_cores["script"]["ms"]), *cells]


def _over(found: dict[str, Any], call: str) -> str:
    return number(found[call]["over_script"]["median"]) if call in found else "-"


def first_record(results: dict[str, Any]) -> Rows:
    """Start of `run` to its first record."""
    yield ["network", "", "`latency`, ms", "`throughput`, ms", "`throughput` / `latency`"]
    for name in BACKBONES:
        for kind, row in results[name]["first_record"].items():
            cells = [two(row["latency_ms"], 0), two(row["throughput_ms"], 0)]
            yield [SHORT[name], kind, *cells, two(row["throughput_over_latency"], 3)]


def camera(results: dict[str, Any]) -> Rows:
    """A steady camera."""
    yield [
        *("network", "30 frames per second", "processor ms per frame", "/ onnxruntime"),
        *("age of a frame, ms", "dropped"),
    ]
    for name in BACKBONES:
        for what, row in results[name]["camera"].items():
            age = two(row["age_ms"]) if row["age_ms"] else "-"
            cells = [two(row["cpu_ms_per_frame"]), two(row["over_onnxruntime"], 3), age]
            yield [SHORT[name], what, *cells, f"{row['frames_skipped']} of {row['frames']}"]


def neighbour(results: dict[str, Any]) -> Rows:
    """Steps with and without a busy process beside them."""
    calls = list(results[BACKBONES[0]]["neighbour"]["alone"])
    yield ["network", "ms of a step in mode, threads", *calls]
    for name in BACKBONES:
        for what, row in results[name]["neighbour"].items():
            yield [SHORT[name], what, *(two(row[call]) for call in calls)]


def load(results: dict[str, Any]) -> Rows:
    """Loading and memory."""
    yield [
        *("network", "", "load, ms", "/ onnxruntime"),
        *("anonymous memory, MiB", "/ onnxruntime"),
    ]
    for name in BACKBONES:
        for what, row in results[name]["load"].items():
            cells = [
                cell
                for key, digits in (("load_ms", 1), ("anonymous_mib", 1))
                for cell in (two(row[key], digits), number(row[key]["over_onnxruntime"], 3))
            ]
            yield [SHORT[name], what, *cells]


def process(results: dict[str, Any]) -> Rows:
    """Fresh processes."""
    yield ["network", "smallest script, ms", "`cvo-edge run`, ms", "/ script"]
    for name in BACKBONES:
        row = results[name]["process"]
        cells = [two(row["script_ms"], 0), two(row["cvo_edge_ms"], 0)]
        yield [SHORT[name], *cells, two(row["over_script"], 3)]


def peers(results: dict[str, Any]) -> Rows:
    """Other engines."""
    yield ["network", "engine", "", "ms", "/ ours", "/ OpenVINO int8", "largest difference"]
    for name in BACKBONES:
        for engine, row in results[name].items():
            difference = row.get("largest_difference")
            cells = [two(row["ms"]), two(row["over_ours"])] if "ms" in row else ["not timed", "-"]
            off = "-" if difference is None else f"{difference:.1e}"
            beside = two(row["over_openvino"]) if "over_openvino" in row else "-"
            yield [SHORT[name], engine, row["precision"], *cells, beside, off]


def uncertainty(results: dict[str, Any]) -> Rows:
    """MC-dropout and ensembles."""
    yield ["network", "", "form", "ms", "/ ours"]
    for name in BACKBONES:
        yield [SHORT[name], "ours", "", two(results[name]["ours"]["ms"]), "1"]
        for kind in ("mc-dropout", "ensemble"):
            for form, row in results[name][kind]["forms"].items():
                mark = ", fastest" if form == results[name][kind]["fastest"] else ""
                yield [SHORT[name], kind, form + mark, two(row["ms"]), two(row["over_ours"])]


def scaling(results: dict[str, Any]) -> Rows:
    """Cost against settings."""
    yield [
        *("setting", "value", "raw call, ms", "array to interval / raw call", "uncertainty, ms"),
        "after the network, ms",
    ]
    labels = {
        "size": "input",
        "rays": "J of MCQR",
        "trees": "trees of CQR",
        "classes": "K of CSP",
    }
    for key, label in labels.items():
        for value, row in results[key].items():
            shown = row["outputs"]["codebook"][1] if key == "rays" else value
            yield [label, str(shown), *_scaling_cells(row)]
            if "joint" in row:
                yield [f"{label}, joint", str(shown), *_scaling_cells(row["joint"])]


def _scaling_cells(row: dict[str, Any]) -> list[str]:
    return [
        two(row["ms"]["raw"]),
        two(row["step_over_raw"], 3),
        number(row["uncertainty_ms"]["median"], 3),
        two(row["after_network_ms"], 3),
    ]


def confidences(results: dict[str, Any]) -> Rows:
    """Cost of confidences."""
    yield ["confidences stored", "reading `calibration.json`, ms", "all their sets, ms"]
    for count, row in results["confidences"].items():
        yield [count, two(row["read_calibration_ms"]), two(row["sets_ms"], 3)]


def memory(results: dict[str, Any]) -> Rows:
    """A long run."""
    yield ["frames", "resident MiB, first and last reading", "growth, MiB", "descriptors, threads"]
    first, last = results["first"], results["last"]
    growth = results["growth"]
    yield [
        f"{results['frames']:,}",
        f"{first['rss']:.1f}, {last['rss']:.1f}",
        number(results["growth_mib"]["rss"]),
        f"{growth['descriptors']:+.0f}, {growth['threads']:+.0f}",
    ]


def board(figures: dict[str, Any]) -> Rows:
    """Largest differences of each bundle on an emulated board, and what it covers there."""
    yield [
        *("bundle", "scope", "position um", "rotation urad", "bounds / mean width"),
        *("moved sets", "coverage on this machine", "on the board"),
    ]
    for report in figures["bundles"]:
        for scope, found in report["scopes"].items():
            off = found["difference"]
            key = "all_six" if scope == "joint" else "per_dof"
            covered = [f"{np.mean(row[key]):.3f}" for row in found["coverage"].values()]
            yield [
                *(report["name"], scope, f"{1e6 * off['position_m']:.3g}"),
                *(f"{1e6 * off['rotation_rad']:.3g}", f"{off['bound_share']:.2g}"),
                *(f"{off['moved']} of {6 * off['frames']}", *covered),
            ]


def instructions(counts: list[dict[str, Any]]) -> Rows:
    """Millions of instructions of the network by kind, and float32 over 8 bits."""
    kinds = list(counts[0]["network"])
    yield [
        *("processor", "bundle", *kinds, "network", "float32 / 8 bits", "step"),
        "float32 / 8 bits",
    ]
    for row in counts:
        (plain,) = [
            each
            for each in counts
            if (each["processor"], each["bundle"])
            == (row["processor"], row["bundle"].removesuffix("-int8"))
        ]
        totals = []
        for part in ("network", "step"):
            total = sum(row[part].values())
            share = sum(plain[part].values()) / total
            totals += [f"{total:.1f}", "-" if row is plain else f"{share:.2f}"]
        by_kind = (f"{row['network'][kind]:.1f}" for kind in kinds)
        yield [row["processor"], row["bundle"], *by_kind, *totals]


def against(results: dict[str, Any]) -> Rows:
    """Array to interval of two checkouts."""
    yield [
        *("network", "method", "", "/ raw call: before", "now", "- raw call, ms: before", "now"),
        *("p10 now", "one core: before", "now", "frame now / before"),
    ]
    for name in BACKBONES:
        for method, rows in results[name].items():
            for kind, found in rows.items():
                before, now = found["2"]["before"], found["2"]["now"]
                cells = [
                    *(number(row["step_over_raw"]["median"], 3) for row in (before, now)),
                    *(number(row["step_minus_raw_ms"]["median"]) for row in (before, now)),
                    number(now["step_minus_raw_ms"]["p10"]),
                    *(
                        number(found["1"][each]["step_minus_raw_ms"]["median"])
                        for each in ("before", "now")
                    ),
                    number(found["2"]["step_now_over_before"]["median"], 3),
                ]
                yield [SHORT[name], method, kind, *cells]


def stages(results: dict[str, Any]) -> Rows:
    """Where the time of a frame goes; a stage's parts follow it."""
    yield ["us", *results]
    for stage in dict.fromkeys(stage for found in results.values() for stage in found):
        *outer, name = stage.split("/")
        found = [rows.get(stage) for rows in results.values()]
        indent = "&nbsp;&nbsp;" * len(outer)
        yield [indent + name, *("-" if us is None else number(us, 0) for us in found)]


# Program -> the tables of its results.
_TABLES: dict[str, tuple[Callable[[dict[str, Any]], Rows], ...]] = {
    "frame": (frame, precision),
    "files": (files,),
    "stream": (camera, neighbour),
    "start": (load, process, first_record),
    "peers": (peers,),
    "uncertainty_peers": (uncertainty,),
    "scaling": (scaling, confidences),
    "soak": (memory,),
    "against": (against,),
    "stages": (stages,),
}


def speed_table(program: str, rows: Callable[[dict[str, Any]], Rows]) -> str:
    """Return one table of a program's results."""
    head, *body = rows(read_result("speed", program)["results"])
    return table(head, body)


def board_table(name: str) -> str:
    """Return the table of one emulated board."""
    head, *body = board(read_result("boards", name))
    return table(head, body)


def instructions_table() -> str:
    """Return the table of instructions on emulated ARM processors."""
    head, *body = instructions(read_result("boards", "instructions")["counts"])
    return table(head, body)


# Name of a table -> what makes it.
TABLES: dict[str, Callable[[], str]] = {
    **{
        rows.__name__: partial(speed_table, program, rows)
        for program, several in _TABLES.items()
        for rows in several
    },
    "board-arm64": partial(board_table, "arm64"),
    "board-avx2": partial(board_table, "avx2"),
    "instructions": instructions_table,
}
