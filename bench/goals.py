"""The goals for two cores beside what was measured.

    python bench/goals.py

Reads the results of the other programs of this folder and prints the table ``goals`` of
``bench/tables.py``. A missed goal is marked; a dash stands for what was not measured. ``first`` is
what the first release reached.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from markdown_table import table
from networks import DEMONSTRATED
from provenance import RESULTS, read_result, result_files

MOBILENET, RESNET = "mobilenetv2_100", "resnet34"


@dataclass(frozen=True)
class Goal:
    """One line: a figure for each backbone and its bound; rounded figures are compared.

    Without a bound the figure is to be stated.
    """

    what: str
    figure: Callable[[str], float | None]
    bounds: Mapping[str, float | None]
    first: str
    at_least: bool = False
    form: str = "{:.2f}"

    def cells(self) -> list[str]:
        """Return goal and figures as text."""
        sign = ">=" if self.at_least else "<="
        bounds = [self.form.format(bound) for bound in self.bounds.values() if bound is not None]
        goal = f"{sign} {' / '.join(dict.fromkeys(bounds))}" if bounds else "stated"
        row = [self.what, self.first, goal]
        for backbone in (MOBILENET, RESNET):
            found = self.figure(backbone) if backbone in self.bounds else None
            if found is None:
                row.append("-")
                continue
            bound = self.bounds[backbone]
            shown = self.form.format(found)
            missed = bound is not None and (
                float(shown) < bound if self.at_least else float(shown) > bound
            )
            row.append(shown + " (missed)" * missed)
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


def both(low: float | None, high: float | None) -> dict[str, float | None]:
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


def calibrated_on_openvino(backbone: str) -> float | None:
    """Return the time of our frame on OpenVINO in 8 bits over that of OpenVINO alone."""
    found = (report("peers") or {}).get(backbone, {})
    ours, alone = (
        found.get(name, {}).get("ms", {}).get("median")
        for name in ("ours int8, calibrated on openvino", "openvino int8")
    )
    return ours / alone if ours and alone else None


def localiser(threads: str) -> Callable[[str], float | None]:
    """Return a reader of the frame of SCR in 8 bits over that of CJP in float32."""

    def read(_: str) -> float | None:
        frame = read_result("localiser", "cost")["bundles"]["scr int8"]["frame"]
        return float(frame[threads]["over_reference"]["median"])

    return read


def files() -> Iterator[Goal]:
    """Files to records."""
    first = {"fp32": "1.17", "int8": "1.02"}
    for precision, bound in (("fp32", 0.85), ("int8", 0.55)):
        yield Goal(
            f"`run` over JPEG files, default mode, over the script: cjp, {precision}",
            at("files", "{}", "cjp", precision, "jpg, 2", "default", "over_script", "median"),
            {MOBILENET: bound},
            first[precision],
        )
        yield Goal(
            f"the same, with `decode: half`, {precision}",
            at("files", "{}", "cjp, half", precision, "jpg, 2", "default", "over_script", "median"),
            {MOBILENET: bound},
            "-",
        )


def frames() -> Iterator[Goal]:
    """One frame: around the network, uncertainty, 8 bits."""
    for method in DEMONSTRATED:
        yield Goal(
            f"array to interval less the raw call, {method} fp32, ms",
            at("frame", "{}", method, "fp32", "step_minus_raw_ms", "median"),
            {MOBILENET: 0.9 if method == "scr" else 0.3},
            "-" if method == "scr" else ".54 to .67",
        )
    for method in DEMONSTRATED:
        yield Goal(
            f"cost of uncertainty with the alarm, {method} fp32",
            at("frame", "{}", method, "fp32", "cost_of_uncertainty", "median"),
            both(0.06, 0.03),
            "-" if method == "scr" else ".064 to .106; .025 to .032 (no alarm)",
            form="{:.3f}",
        )
    for threads in ("2", "1"):
        yield Goal(
            f"demonstration bundles: frame of scr int8 / cjp fp32, threads {threads}",
            localiser(threads),
            {MOBILENET: 1.0},
            "-",
        )
    yield Goal(
        "raw call: float32 / 8 bits, cjp",
        at("frame", "{}", "cjp", "fp32_over_int8", "median"),
        both(1.6, 2.8),
        "1.55; 2.63",
        at_least=True,
    )
    yield Goal(
        "mean width: 8 bits / float32, worst method", worst_width, both(1.1, 1.1), "1.02; 1.04"
    )
    yield Goal(
        "frame calibrated on OpenVINO int8 / OpenVINO int8 alone",
        calibrated_on_openvino,
        both(1.15, 1.15),
        "-",
    )


def peers() -> Iterator[Goal]:
    """MC-dropout and five networks."""
    dropout, ensemble = "30 passes of MC-dropout", "five networks"
    for kind, label, form, bound, first in (
        ("mc-dropout", dropout, "fastest", 22, "19.6; 26.1"),
        ("mc-dropout", dropout, "naive", 20, "23.2; 30.1"),
        ("ensemble", ensemble, "naive", 5, "19.0; 9.8"),
        ("ensemble", ensemble, "fastest", None, "4.0; 4.8"),
    ):
        naive = ("forms", "naive", "over_ours", "median")
        keys = naive if form == "naive" else ("fastest_over_ours",)
        yield Goal(
            f"{label}, {form} form / one frame of cjp fp32",
            at("uncertainty_peers", "{}", kind, *keys),
            both(bound, bound),
            first,
            at_least=True,
            form="{:.1f}",
        )
    for kind, first in (("mc-dropout", ".762"), ("ensemble", "1.099")):
        yield Goal(
            f"interval score of cjp / {kind}, truncated networks, worse recording",
            worst_score(kind),
            {MOBILENET: 1.0},
            first,
            form="{:.3f}",
        )


def resources() -> Iterator[Goal]:
    """Processor time, start and memory."""
    for label, name, bound, first in (
        ("fp32, 2 threads", "live fp32, 2", 0.25, ".275"),
        ("int8, 1 thread", "live int8, 1", 0.14, ".163"),
    ):
        yield Goal(
            f"processor time at 30 frames per second / onnxruntime's defaults: {label}",
            at("stream", "{}", "camera", name, "over_onnxruntime", "median"),
            {MOBILENET: bound},
            first,
            form="{:.3f}",
        )
    yield Goal(
        "load with a warm model cache / onnxruntime, float32",
        at("start", "{}", "load", "cvo-edge fp32", "load_ms", "over_onnxruntime"),
        {MOBILENET: 0.29},
        ".29",
    )
    yield Goal(
        "anonymous memory: 8 bits / onnxruntime in float32",
        at("start", "{}", "load", "cvo-edge int8", "anonymous_mib", "over_onnxruntime"),
        {MOBILENET: 0.64},
        ".64",
    )
    yield Goal(
        "fresh process to first interval / smallest script",
        at("start", "{}", "process", "over_script", "median"),
        {MOBILENET: 1.07},
        "1.07",
    )
    yield Goal(
        "growth of memory, second to last tenth of a million frames, MiB",
        at("soak", "growth_mib", "rss"),
        {MOBILENET: 0.4},
        ".4",
        form="{:.1f}",
    )


def goals() -> list[Goal]:
    """Return the goals, in the order of the design."""
    return [*files(), *frames(), *peers(), *resources()]


def goals_table() -> str:
    """Return all goals as a Markdown table."""
    head = ["what", "first release", "goal", "MobileNetV2", "ResNet34"]
    return table(head, [goal.cells() for goal in goals()])


if __name__ == "__main__":
    print(goals_table())
