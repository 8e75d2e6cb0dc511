"""Tables of ``results/localiser`` for ``bench/tables.py``: medians over seeds, sets of 0.9."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import cache
from typing import Any, get_args

import numpy as np
from markdown_table import table
from provenance import read_result, result_files

from cvo_edge.vocabulary import Rule

Report = dict[str, Any]

FOLDER = "localiser"
# Grid of the study -> recording and split, as results of SIFT maps name them.
GRIDS = {
    "new flights": ("kitchen_flights", "sequence"),
    "redkitchen, between known frames": ("redkitchen", "random"),
    "redkitchen, new parts of the recording": ("redkitchen", "block"),
    "EuRoC MH_05, between known frames": ("euroc_mh05", "random"),
    "EuRoC MH_05, new parts of the recording": ("euroc_mh05", "block"),
}
METHODS = ("scr", "fused", "cjp", "cqr", "csp", "mcqr")


@cache
def results() -> Report:
    """Return the study's results."""
    return read_result(FOLDER, "results")


def cells(grid: str, method: str) -> list[Report]:
    """Return the cells of a grid and method, one per seed."""
    return [
        results()["cells"][place["cell"]]
        for place in results()["places"]
        if place["grid"] == grid and place["method"] == method
    ]


def median(found: list[Report], figure: Callable[[Report], float]) -> float:
    """Return the median of a figure over seeds."""
    return float(np.median([figure(each) for each in found]))


def accuracy() -> str:
    """Return all methods and the map of SIFT points, a block of rows for each recording."""
    head = [
        *("recording", "method", "error: median", "90 %", "99 %", "frames left out"),
        *("coverage per DoF", "joint scope", "mean width", "score", "volume, over CJP's"),
    ]
    rows = []
    for grid, (recording, split) in GRIDS.items():
        reference = cells(grid, "cjp")
        rows += [[grid, method, *_row(cells(grid, method), reference)] for method in METHODS]
        rows.append([grid, "SIFT map", *_sift_row(recording, split)])
    return table(head, rows)


def _row(found: list[Report], reference: list[Report]) -> list[str]:
    def volume(cell: Report) -> float:
        return float(cell["joint_volume"]["geometric_mean"])

    def error(name: str) -> str:
        metres = median(found, lambda c: c["point_error"][f"{name}_m"])
        degrees = median(found, lambda c: c["point_error"][f"{name}_deg"])
        return _pose(metres, degrees)

    total = sum(cell["frames"]["total"] for cell in found)
    left_out = sum(cell["frames"]["invalid"] for cell in found)
    width = found[0]["marginal"]["mean_width"].keys()
    metres, degrees = (median(found, lambda c, u=u: c["marginal"]["mean_width"][u]) for u in width)
    return [
        *map(error, ("median", "p90", "p99")),
        f"{100 * left_out / total:.1f} %",
        f"{median(found, lambda c: c['marginal']['mean_coverage']):.3f}",
        f"{median(found, lambda c: c['joint']['joint_coverage']):.3f}",
        _pose(metres, degrees),
        f"{median(found, lambda c: c['marginal']['normalised_interval_score']):.3f}",
        f"{median(found, volume) / median(reference, volume):.2g}",
    ]


def _sift_row(recording: str, split: str) -> list[str]:
    found = _sift(recording, split)

    def error(name: str) -> str:
        metres = median(found, lambda r: r["point_error"][f"{name}_m"])
        if f"{name}_deg" not in found[0]["point_error"]:
            return f"{100 * metres:.2f} cm"
        return _pose(metres, median(found, lambda r: r["point_error"][f"{name}_deg"]))

    pooled = [report["pooled"] for report in found]
    lost = sum(report["lost"] for report in found) / sum(report["frames"] for report in found)
    return [
        *map(error, ("median", "p90", "p99")),
        f"{100 * lost:.1f} %",
        f"{median(pooled, lambda r: float(np.mean(r['coverage']))):.3f}",
        "-",
        _pose(
            median(pooled, lambda r: float(np.mean(r["mean_width"][:3]))),
            median(pooled, lambda r: float(np.rad2deg(np.mean(r["mean_width"][3:])))),
        ),
        f"{median(pooled, lambda r: r['normalised_interval_score']):.3f}",
        "-",
    ]


def _sift(recording: str, split: str) -> list[Report]:
    """Return the results of a map of SIFT points, one per seed."""
    names = [path.stem for path in result_files(FOLDER)]
    prefix = f"sift-{recording}-{split}-"
    return [read_result(FOLDER, name) for name in names if name.startswith(prefix)]


def _pose(metres: float, degrees: float) -> str:
    return f"{100 * metres:.2f} cm {degrees:.2f} deg"


def predictors() -> str:
    """Return coverage, error and width of four kinds of predictors under the pooled rule."""
    kinds = {"scr": "scene coordinates, solver (SCR)", "cjp": "regression (CJP)", "fused": "both"}
    rows = [
        [name, *(_coverage(cells(grid, method)) for grid in GRIDS)]
        for method, name in kinds.items()
    ]
    rows.append(["SIFT points, PnP", *(_sift_coverage(*place) for place in GRIDS.values())])
    return table(["predictor", *GRIDS], rows)


def _coverage(found: list[Report]) -> str:
    return _covered(
        median(found, lambda c: c["marginal"]["mean_coverage"]),
        median(found, lambda c: c["point_error"]["median_m"]),
        median(found, lambda c: c["marginal"]["mean_width"]["m"]),
    )


def _sift_coverage(recording: str, split: str) -> str:
    found = _sift(recording, split)
    return _covered(
        median(found, lambda r: float(np.mean(r["pooled"]["coverage"]))),
        median(found, lambda r: r["point_error"]["median_m"]),
        median(found, lambda r: float(np.mean(r["pooled"]["mean_width"][:3]))),
    )


def _covered(coverage: float, error_m: float, width_m: float) -> str:
    return f"{coverage:.3f}: {100 * error_m:.2f}, {100 * width_m:.2f} cm"


def strangers() -> str:
    """Return the shares of frames of each kind with an interval, and with a wrong one."""
    found = {
        path.stem.removeprefix("strangers-"): read_result(FOLDER, path.stem)
        for path in result_files(FOLDER)
        if path.stem.startswith("strangers-")
    }
    groups: dict[str, dict[str, dict[str, Report]]] = defaultdict(lambda: defaultdict(dict))
    for name, report in found.items():
        for group in ("altered", "not_stated", "misstated", "places"):
            for kind, figures in report[group].items():
                groups[group][kind][name] = figures
    titles = {
        "altered": "image",
        "not_stated": "another camera, not stated",
        "misstated": "the same camera, misstated",
        "places": "another place",
    }
    rows = []
    for group, kinds in groups.items():
        for kind, by_bundle in kinds.items():
            shown = [_shares(by_bundle[name]) if name in by_bundle else "-" for name in found]
            rows.append([f"{titles[group]}: {kind}", *shown])
    return table(["frames with an interval, with a wrong one (all six at 0.9)", *found], rows)


def _shares(figures: Report) -> str:
    text = f"{figures['finite']:.3f}, {figures['wrong']:.3f}"
    noticed = [number for number in figures["noticed_after"] if number]
    if noticed:
        text += f"; from frame {np.median(noticed):g} in {len(noticed)} of "
        text += f"{len(figures['noticed_after'])}"
    return text


def other_cameras() -> str:
    """Return errors and coverage of other cameras whose intrinsics were given."""
    rows = []
    for path in result_files(FOLDER):
        if path.stem.startswith("strangers-"):
            report = read_result(FOLDER, path.stem)
            rows += [
                [path.stem.removeprefix("strangers-"), name, *_accuracy(figures)]
                for name, figures in report["stated"].items()
            ]
    head = ["bundle", "images", "with an interval", "error: median", "90 %"]
    return table([*head, "coverage per DoF", "joint scope", "mean width"], rows)


def _accuracy(figures: Report) -> list[str]:
    if not figures["finite"]:
        return ["0 %", *["-"] * 5]
    return [
        f"{100 * figures['finite']:.0f} %",
        f"{100 * figures['median_m']:.2f} cm",
        f"{100 * figures['p90_m']:.2f} cm",
        f"{figures['coverage']:.3f}",
        f"{figures['joint_coverage']:.3f}",
        f"{100 * figures['mean_width_m']:.2f} cm",
    ]


def redraws() -> str:
    """Return each rule's coverage and width over redrawn calibration recordings."""
    rows = []
    for path in result_files(FOLDER):
        if path.stem.startswith("redraw-"):
            report = read_result(FOLDER, path.stem)
            for rule in (rule for rule in get_args(Rule) if rule in report):
                for scope, figures in report[rule].items():
                    width, over = figures["mean_width"], figures.get("over_pooled")
                    rows.append(
                        [
                            *(report["bundle"], rule, scope),
                            f"{np.mean(figures['coverage']):.3f}",
                            f"{figures['joint_coverage']:.3f}",
                            _pose(np.mean(width[:3]), np.rad2deg(np.mean(width[3:]))),
                            "-" if over is None else f"{over:.2f} x",
                            f"{figures['normalised_interval_score']:.3f}",
                        ]
                    )
    head = ["bundle", "rule", "scope", "coverage per DoF", "all six", "mean width"]
    head += ["median width over pooled", "score"]
    return table(head, rows)


def cost() -> str:
    """Return time, memory and file of CJP and SCR in both precisions, and how long they train."""
    found = read_result(FOLDER, "cost")["bundles"]
    rows = []
    for name, figures in found.items():
        method = name.split()[0]
        frames = (
            f"{figures['frame'][threads]['ms']['median']:.2f} ms, "
            f"{figures['frame'][threads]['over_reference']['median']:.2f} x"
            for threads in ("1", "2")
        )
        timed = [cell for cell in cells("new flights", method) if cell["training"]]
        seconds = median(timed, lambda c: c["training"]["processor"])
        rows.append(
            [
                name,
                *frames,
                f"{figures['peak_mib']:.0f} MiB",
                f"{figures['model_bytes'] / 1e6:.2f} MB",
                f"{seconds / 60:.0f} min" if name.endswith("fp32") else "the same",
            ]
        )
    head = ["", "frame, one thread", "two threads", "peak memory", "`model.onnx`"]
    return table([*head, "training, processor"], rows)


TABLES: dict[str, Callable[[], str]] = {
    "localiser": accuracy,
    "localiser-predictors": predictors,
    "localiser-strangers": strangers,
    "localiser-cameras": other_cameras,
    "localiser-redraws": redraws,
    "localiser-cost": cost,
}
