"""A comparison of methods and baselines: a study of one grid, and its table as text."""

from __future__ import annotations

from msgspec.structs import replace

from cvo_edge.errors import UsageError
from cvo_edge.files import write_whole
from cvo_export.networks.baselines import BASELINES
from cvo_export.networks.methods import TRAINABLE
from cvo_export.progress import Progress
from cvo_export.study.cell import Cell
from cvo_export.study.cells import CellFolder, Say
from cvo_export.study.grid import Grid, Results, Study, plan_study, run_study
from cvo_export.study.summaries import (
    BLANK,
    error_shown,
    joint_shown,
    own_shown,
    seconds_shown,
    sets_shown,
)
from cvo_export.study.workers import Engine

TABLE_FILE = "compare.txt"


def compare(
    grid: Grid, folder: CellFolder, engine: Engine, progress: Progress, say: Say
) -> list[str]:
    """Run a study of one grid, write ``results.json`` and ``compare.txt``, and return its lines.

    Raises UsageError if the folder has cells of other options, which the table would omit; for
    other errors see ``run_study``.
    """
    _check_folder(grid, folder)
    lines = table(run_study(_study(grid), folder, engine, progress, say))
    write_whole(folder.out / TABLE_FILE, "\n".join(lines) + "\n")
    return lines


def _study(grid: Grid) -> Study:
    return Study(title="Methods and baselines compared", grids=[grid])


def _check_folder(grid: Grid, folder: CellFolder) -> None:
    """Raise UsageError for cells that belong to this grid under no choice of methods and seeds."""
    names = folder.names()
    earlier = [name for name in names if name.rpartition("-")[0] in TRAINABLE]
    if earlier:
        raise UsageError(
            f"{folder.out}: cells of an earlier version ({', '.join(earlier)}); name a new folder"
        )
    if not names:
        return
    seeds = 1 + max(folder.read(name).seed for name in names)
    every = replace(grid, methods=list(TRAINABLE), seeds=max(seeds, grid.seeds))
    known = plan_study(_study(every)).configs
    others = [name for name in names if name not in known]
    if others:
        raise UsageError(
            f"{folder.out}: cells of other options ({', '.join(others)}); name a new folder"
        )


_HEADER = (
    "method",
    "coverage",
    "all six",
    "mean width",
    "score",
    "joint scope",
    "volume^1/6",
    "point error",
    "train s",
    "M param.",
    "frame ms",
)


def table(results: Results) -> list[str]:
    """Return the table of a study of one grid as lines of text."""
    by_method: dict[str, list[Cell]] = {}
    for place in results.places:
        by_method.setdefault(place.method, []).append(results.cells[place.cell])
    (timing,) = results.timing.values()
    first = results.places[0]
    seeds = sorted({place.seed for place in results.places})
    # Show own bounds for baselines only: a method's own bounds are an intermediate result.
    rows: list[tuple[str, ...]] = [_HEADER]
    for method, cells in by_method.items():
        own = own_shown(cells) if method in BASELINES else None
        if own is not None:
            rows.append((f"{method}, own", *own, *[BLANK] * (len(_HEADER) - 1 - len(own))))
        ms = next(timing.ms[p.cell] for p in results.places if p.method == method and not p.seed)
        rows.append(
            (
                f"{method}, conformal" if method in BASELINES else method,
                *sets_shown([cell.marginal for cell in cells]),
                *joint_shown(cells),
                error_shown(cell.point_error for cell in cells),
                seconds_shown(cells),
                f"{cells[0].head_parameters / 1e6:.2f}",
                f"{ms['p50']:.2f} ({ms['p95']:.2f})",
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADER))]
    return [
        f"{first.data}, {first.split} split, seeds {', '.join(map(str, seeds))}: medians over "
        f"seeds, sets of {results.confidence:g}, test frames",
        "",
        *("  ".join(v.ljust(w) for v, w in zip(row, widths, strict=True)).rstrip() for row in rows),
        "",
        "own: the network's own bounds; conformal: the same bounds calibrated, pooled rule",
        "coverage: mean over the six degrees of freedom; all six: of these sets at once",
        "score: interval score over each degree of freedom's deviation, each seed in brackets",
        "joint scope: coverage of all six by the joint sets; volume: of these sets in deviations, "
        "geometric mean",
        "train s: processor seconds without features; M param.: millions behind the backbone, "
        "without a forest's trees",
        f"frame ms: array to interval, median and 95 %, {timing.threads} threads",
    ]
