"""Tables of coverage, width and error for ``bench/tables.py``.

They come from ``results/paper-methods`` and its variants, ``precision``, ``shapes`` and
``demonstrations``. Figures are medians over seeds, sets of 0.9.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from markdown_table import table
from networks import DEMONSTRATED, METHODS, demonstration
from provenance import read_result, result_files

RECORDINGS = ("redkitchen", "kitchen_flights")
Report = dict[str, Any]


def level(report: Report, scope: str) -> Report:
    """Return the report's level at 0.9 of this scope."""
    found: Report = next(
        entry
        for entry in report["levels"]
        if entry["confidence"] == 0.9 and entry["scope"] == scope
    )
    return found


def reports(folder: str, name: str, recording: str) -> list[Report]:
    """Return the evaluations of all seeds of a method or variant on a recording."""
    prefix = f"{name}-{recording}-"
    stems = [path.stem for path in result_files(folder) if path.stem.startswith(prefix)]
    return [read_result(folder, stem) for stem in stems]


def each_seed(values: list[float], form: str) -> str:
    """Return the median in bold, then every seed's value."""
    each = ", ".join(form.format(value) for value in values)
    return f"**{form.format(float(np.median(values)))}** ({each})"


def score(report: Report) -> float:
    """Return the interval score over the poses' deviations."""
    return float(level(report, "marginal")["normalised_interval_score"])


def joint_edge(report: Report) -> float:
    """Return the edge of a box of the joint sets' volume, in deviations."""
    return float(level(report, "joint")["joint_volume"]["geometric_mean"] ** (1 / 6))


def evaluations(*runs: tuple[str, str]) -> str:
    """Return a table of runs, each a folder and a method or variant, on both recordings."""
    head = [
        *("recording, split", "method", "median error", "score", "coverage at 0.9, per DoF"),
        *("joint scope: all six", "its volume^(1/6)", "median width"),
    ]
    rows = [
        _evaluation_row(recording, name, found)
        for recording in RECORDINGS
        for folder, name in runs
        if (found := reports(folder, name, recording))
    ]
    return table(head, rows)


def _evaluation_row(recording: str, name: str, found: list[Report]) -> list[str]:
    marginal = [level(report, "marginal") for report in found]
    widths = np.array([entry["median_width"] for entry in marginal])
    errors = [report["point_error"] for report in found]
    singles = [value for entry in marginal for value in entry["coverage"]]
    return [
        f"{recording.replace('_', ' ')}, {found[0]['split']}",
        name,
        each_seed([100 * error["median_m"] for error in errors], "{:.2f}")
        + " cm, "
        + each_seed([error["median_deg"] for error in errors], "{:.2f}")
        + " deg",
        each_seed([score(report) for report in found], "{:.3f}"),
        each_seed([float(np.mean(entry["coverage"])) for entry in marginal], "{:.3f}")
        + f"; single DoF {min(singles):.3f} to {max(singles):.3f}",
        each_seed([level(report, "joint")["joint_coverage"] for report in found], "{:.3f}"),
        each_seed([joint_edge(report) for report in found], "{:.3f}"),
        f"{100 * np.median(widths[:, :3]):.1f} cm, {np.rad2deg(np.median(widths[:, 3:])):.2f} deg",
    ]


def choice() -> str:
    """Return the figures that a choice between the methods rests on, a column each."""
    pairs = {
        method: [reports("paper-methods", method, r) for r in RECORDINGS] for method in METHODS
    }

    def two(figure: Callable[[list[Report]], float], form: str) -> list[str]:
        return [", ".join(form.format(figure(seeds)) for seeds in pair) for pair in pairs.values()]

    def volumes(pair: list[list[Report]]) -> list[float]:
        return [float(np.median([joint_edge(report) for report in seeds])) ** 6 for seeds in pair]

    def over_cqr(method: str) -> str:
        ratios = [a / b for a, b in zip(volumes(pairs[method]), volumes(pairs["cqr"]), strict=True)]
        # One decimal above 1, two below.
        return ", ".join(f"{r:.0f}" if r == 1 else f"{r:.{1 if r > 1 else 2}f}" for r in ratios)

    comparison = read_result("compare", "redkitchen")
    timing = comparison["timing"]["ms"]
    latency = {method: read_result("latency", f"{method}-redkitchen") for method in METHODS}
    sizes = {
        cell["method"]: cell["model_bytes"] for cell in comparison["cells"] if not cell["seed"]
    }
    return table(
        ["", *(method.upper() for method in METHODS)],
        [
            [
                "the set of a degree of freedom",
                "one interval, by the pose network itself",
                "one interval, by a forest on the point's residuals",
                "a union of classes",
                "one interval about a region",
            ],
            [
                "the set of all six at once",
                "a box",
                "a box",
                "a product of unions",
                "an ellipsoid, or a union of them where val needs it",
            ],
            [
                "bands in pieces",
                *("no", "no"),
                "yes: " + ", ".join(f"{100 * x:.1f} %" for x in _pieces(pairs["csp"])) + " of sets",
                "no",
            ],
            ["score", *two(lambda seeds: float(np.median([score(r) for r in seeds])), "{:.3f}")],
            ["volume of the joint set, over CQR's", *map(over_cqr, METHODS)],
            [
                "time per frame, 640x480 array to interval, in turns",
                *(
                    f"{timing[method]['p50']:.1f} ms, of it "
                    f"{latency[method]['latency_ms']['conformal']['p50']:.2f} after the network"
                    for method in METHODS
                ),
            ],
            [
                "`model.onnx` (redkitchen)",
                *(f"{sizes[method] / 2**20:.1f} MiB" for method in METHODS),
            ],
            [
                *("networks trained", "1", "4, and the forest", "3, val keeps one"),
                "4, and the region's",
            ],
        ],
    )


def _pieces(pair: list[list[Report]]) -> list[float]:
    """Median share of CSP's sets that are in pieces, by recording."""
    return [
        float(np.median([np.mean(level(r, "marginal")["disjoint_share"]) for r in seeds]))
        for seeds in pair
    ]


PRECISION_COLUMNS: dict[str, Callable[[Report], float]] = {
    "MB": lambda row: row["model_bytes"] / 1e6,
    "error cm": lambda row: 100 * row["point_error"]["median_m"],
    "coverage": lambda row: row["mean_coverage"],
    "joint": lambda row: row["joint_coverage"],
    "width cm": lambda row: 100 * float(np.mean(row["mean_width"][:3])),
    "width deg": lambda row: float(np.rad2deg(np.mean(row["mean_width"][3:]))),
    "score": lambda row: row["normalised_interval_score"],
}
DIGITS = {"coverage": 3, "joint": 3, "score": 3, "MB": 1}


def precisions() -> str:
    """Return float32 beside 8 bits, one line per data set, network, method and precision."""
    cells: dict[tuple[str, ...], list[Report]] = defaultdict(list)
    for path in result_files("precision"):
        found = read_result("precision", path.stem)
        cells[found["dataset"], found["split"], found["backbone"], found["method"]].append(found)
    rows = []
    for (dataset, split, backbone, method), runs in cells.items():
        for precision in ("fp32", "int8"):
            figures = [
                f"{np.median([read(run[precision]) for run in runs]):.{DIGITS.get(name, 2)}f}"
                for name, read in PRECISION_COLUMNS.items()
            ]
            ratios = [run["width_ratio"] for run in runs]
            shown = f"{np.median(ratios):.3f}" if precision == "int8" else ""
            if precision == "int8" and len(ratios) > 1:
                shown += f" ({', '.join(f'{ratio:.3f}' for ratio in ratios)})"
            rows.append([f"{dataset}, {split}", backbone, method, precision, *figures, shown])
    head = ["data, split", "network", "method", "", *PRECISION_COLUMNS, "width int8 / fp32"]
    return table(head, rows)


def shapes() -> str:
    """Return coverage and mean area of MCQR's region, the latent grid and the box, by shape."""
    kinds = ("region", "grid", "box")
    head = ["shape", "dimensions", "seed", *(f"{kind}: coverage, mean area" for kind in kinds)]
    rows = [
        [
            *(found["shape"], str(found["dimensions"]), str(found["seed"])),
            *(f"{found[kind]['coverage']:.3f}, {found[kind]['mean_area']:.3f}" for kind in kinds),
            *(f"{found['area_ratio']:.2f}", f"{found['kappa']:g}", str(found["points"])),
        ]
        for found in read_result("shapes", "shapes")["results"]
    ]
    return table([*head, "box over region", "kappa", "points"], rows)


def demonstrations(precision: str) -> str:
    """Return the demonstration bundles of one precision on their test flights."""
    head = [
        *("bundle", "median error", "rule", "scope", "coverage: tx ty tz, three rotations"),
        *(
            "all six",
            "99 % band",
            "median width",
            "score",
            "volume^(1/6)",
            "classes; sets, frames in pieces",
        ),
    ]
    rows: list[list[str]] = []
    for method in DEMONSTRATED:
        report = read_result("demonstrations", demonstration(method, precision).name)
        error = report["point_error"]
        point = f"{100 * error['median_m']:.2f} cm {error['median_deg']:.2f} deg"
        rows += [
            [report["bundle"], point, part["rule"], scope, *_cells(level(part, scope))]
            for part in (report, report["other_rule"])
            for scope in ("marginal", "joint")
        ]
    return table(head, rows)


def _cells(entry: Report) -> list[str]:
    width, band = np.array(entry["median_width"]), entry["coverage_band"]
    volume = entry.get("joint_volume")
    pieces = "-"
    if "set_size" in entry:
        pieces = (
            f"{np.mean(entry['set_size']):.1f}; {100 * np.mean(entry['disjoint_share']):.1f} %, "
            f"{100 * entry['disjoint_frames']:.0f} %"
        )
    return [
        " ".join(f"{value:.3f}" for value in entry["coverage"]),
        f"{entry['joint_coverage']:.3f}",
        "-" if band is None else f"{band[0]:.3f} to {band[1]:.3f}",
        f"{100 * width[:3].mean():.2f} cm {np.rad2deg(width[3:].mean()):.2f} deg",
        f"{entry['normalised_interval_score']:.3f}",
        "-" if volume is None else f"{volume['geometric_mean'] ** (1 / 6):.3f}",
        pieces,
    ]


def evaluation(name: str) -> str:
    """Return one evaluation, FOLDER/NAME, as ``cvo-export evaluate`` prints it."""
    # Only here: it takes torch's start.
    from cvo_export.evaluate import table as printed

    folder, _, stem = name.partition("/")
    return "\n".join(printed({"noise": None, **read_result(folder, stem)}))


TABLES: dict[str, Callable[[], str]] = {
    "choice": choice,
    "paper-methods": partial(evaluations, *(("paper-methods", method) for method in METHODS)),
    "augmentation": partial(
        evaluations,
        ("paper-methods", "mcqr"),
        ("augmentation", "mcqr-passes"),
        ("augmentation", "mcqr-dropout"),
    ),
    "members": partial(evaluations, ("paper-methods", "cjp"), ("members", "cjp-members")),
    "demonstrations": partial(demonstrations, "fp32"),
    "demonstrations-int8": partial(demonstrations, "int8"),
    "precisions": precisions,
    "shapes": shapes,
}
