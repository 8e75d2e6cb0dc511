"""The goals for two cores beside what was measured.

    python bench/goals.py

Reads the results of the other programs of this folder and prints the table ``goals`` of
``bench/tables.py``. A missed goal is marked; a dash stands for what was not measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from markdown_table import table
from networks import METHODS
from provenance import RESULTS, read_result, result_files

MOBILENET, RESNET = "mobilenetv2_100", "resnet34"


@dataclass(frozen=True)
class Goal:
    """One line: a figure for each backbone and its bound."""

    what: str
    figure: Callable[[str], float | None]
    bounds: dict[str, float]
    at_least: bool = False
    form: str = "{:.3f}"

    def cells(self) -> list[str]:
        """Return goal and figures as text."""
        sign = ">=" if self.at_least else "<="
        bounds = list(dict.fromkeys(self.form.format(bound) for bound in self.bounds.values()))
        row = [self.what, f"{sign} {' / '.join(bounds)}"]
        for backbone in (MOBILENET, RESNET):
            found = self.figure(backbone) if backbone in self.bounds else None
            if found is None:
                row.append("-")
                continue
            bound = self.bounds[backbone]
            reached = found >= bound if self.at_least else found <= bound
            row.append(self.form.format(found) + ("" if reached else " (missed)"))
        return row


def report(name: str) -> dict[str, Any] | None:
    """Return the results of one program, None if it has not been run."""
    if not (RESULTS / "speed" / f"{name}.json").exists():
        return None
    results: dict[str, Any] = read_result("speed", name)["results"]
    return results


def at(name: str, *keys: str) -> Callable[[str], float | None]:
    """Return a reader of one figure; ``{}`` among the keys stands for the backbone."""

    def read(backbone: str) -> float | None:
        found: Any = report(name)
        for key in keys:
            if found is None:
                return None
            found = found.get(key.format(backbone))
        return None if found is None else float(found)

    return read


def both(low: float, high: float) -> dict[str, float]:
    """One bound for MobileNetV2, one for ResNet34."""
    return {MOBILENET: low, RESNET: high}


def worst_width(backbone: str) -> float | None:
    """Return the largest ratio of mean widths, int8 over fp32, of the methods' medians."""
    ratios: dict[tuple[str, str], list[float]] = {}
    for path in result_files("precision"):
        found = read_result("precision", path.stem)
        if found["backbone"] == backbone:
            ratios.setdefault((found["dataset"], found["method"]), []).append(found["width_ratio"])
    return max((float(np.median(values)) for values in ratios.values()), default=None)


def worst_score(kind: str) -> Callable[[str], float | None]:
    """Return a reader of CJP's interval score over a calibrated baseline's, on the worse data."""

    def read(_: str) -> float | None:
        found = report("uncertainty_peers")
        if found is None:
            return None
        return max(float(row["cjp"] / row[kind]) for row in found["interval_scores"].values())

    return read


def goals() -> list[Goal]:
    """Return the goals, in the order of the design."""
    rows = [
        Goal(
            f"array to interval / raw call, {method}",
            at("frame", "{}", method, "fp32", "step_over_raw", "median"),
            both(1.05, 1.05),
        )
        for method in METHODS
    ]
    rows.append(
        Goal(
            "JPEG file to JSON record / raw call, cjp",
            at("frame", "{}", "cjp", "fp32", "record_over_raw", "median"),
            both(1.5, 1.1),
        )
    )
    for method in METHODS:
        rows += [
            Goal(
                f"demonstration network, {method}: array to interval - raw call, ms",
                at("frame", "demonstration", method, "fp32", "step_minus_raw_ms", "median"),
                {MOBILENET: 0.25},
            ),
            Goal(
                f"demonstration network, {method}: JPEG file to JSON record / raw call",
                at("frame", "demonstration", method, "fp32", "record_over_raw", "median"),
                {MOBILENET: 1.6},
            ),
        ]
    for method, bound in zip(METHODS, (0.04, 0.25, 0.06, 0.10), strict=True):
        rows.append(
            Goal(
                f"cost of uncertainty, {method}",
                at("frame", "{}", method, "fp32", "cost_of_uncertainty", "median"),
                both(bound, bound),
            )
        )
    return [
        *rows,
        Goal(
            "raw call: float32 / 8 bits",
            at("frame", "{}", "cjp", "fp32_over_int8", "median"),
            both(1.4, 2.5),
            at_least=True,
            form="{:.2f}",
        ),
        Goal(
            "mean width: 8 bits / float32, worst method",
            worst_width,
            both(1.1, 1.1),
        ),
        Goal(
            "files per second: mode throughput in 8 bits / naive script in float32",
            at("stream", "{}", "throughput", "throughput int8", "naive_over_this", "median"),
            {MOBILENET: 2.5},
            at_least=True,
            form="{:.2f}",
        ),
        Goal(
            "30 passes of MC-dropout (fastest form) / one frame",
            at("uncertainty_peers", "{}", "mc-dropout", "fastest_over_ours"),
            both(20, 20),
            at_least=True,
            form="{:.1f}",
        ),
        Goal(
            "five networks (fastest form) / one frame",
            at("uncertainty_peers", "{}", "ensemble", "fastest_over_ours"),
            both(5, 5),
            at_least=True,
            form="{:.1f}",
        ),
        Goal(
            "interval score / MC-dropout, truncated networks, worse recording",
            worst_score("mc-dropout"),
            {MOBILENET: 1.0},
        ),
        Goal(
            "interval score / five networks, truncated networks, worse recording",
            worst_score("ensemble"),
            {MOBILENET: 1.0},
        ),
        Goal(
            "processor time at 30 frames per second / onnxruntime: float32, 2 threads",
            at("stream", "{}", "camera", "live fp32, 2", "over_onnxruntime", "median"),
            both(0.3, 0.3),
        ),
        Goal(
            "processor time at 30 frames per second / onnxruntime: 8 bits, 1 thread",
            at("stream", "{}", "camera", "live int8, 1", "over_onnxruntime", "median"),
            both(0.15, 0.15),
        ),
        Goal(
            "load with a warm model cache / onnxruntime, float32",
            at("start", "{}", "load", "cvo-edge fp32", "load_ms", "over_onnxruntime"),
            both(0.45, 0.15),
        ),
        Goal(
            "anonymous memory: 8 bits / onnxruntime in float32",
            at("start", "{}", "load", "cvo-edge int8", "anonymous_mib", "over_onnxruntime"),
            {MOBILENET: 0.6},
        ),
        Goal(
            "anonymous memory / onnxruntime, float32",
            at("start", "{}", "load", "cvo-edge fp32", "anonymous_mib", "over_onnxruntime"),
            {RESNET: 0.2},
        ),
        Goal(
            "fresh process to first interval / smallest script",
            at("start", "{}", "process", "over_script", "median"),
            both(1.15, 1.15),
        ),
        Goal(
            "growth of memory, second to last tenth of a million frames, MiB",
            at("soak", "growth_mib", "rss"),
            {MOBILENET: 10},
            form="{:.1f}",
        ),
    ]


def goals_table() -> str:
    """Return all goals as a Markdown table."""
    return table(["what", "goal", "MobileNetV2", "ResNet34"], [goal.cells() for goal in goals()])


if __name__ == "__main__":
    print(goals_table())
