"""The tables of a study's report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from cvo_edge.bundle.reading import read_calibration
from cvo_edge.heads import HEADS
from cvo_export.bundles.figures import coverage_band
from cvo_export.data.noise import parse_noise
from cvo_export.networks.methods import TRAINABLE
from cvo_export.study.cell import CONFIDENCE, Cell
from cvo_export.study.cells import CellFolder
from cvo_export.study.grid import Grid, Place, Results, Value
from cvo_export.study.summaries import (
    BLANK,
    adaptiveness_shown,
    error_shown,
    joint_shown,
    median,
    own_shown,
    pieces_shown,
    seconds_shown,
    sets_shown,
)


class Table(NamedTuple):
    """A table of the report, as text."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


class Tables:
    """Makes the tables of a study's grids."""

    def __init__(self, results: Results, folder: CellFolder) -> None:
        self.results = results
        self.folder = folder

    def places(self, grid: Grid) -> list[Place]:
        """Return the places of a grid."""
        return [place for place in self.results.places if place.grid == grid.name]

    def cell(self, place: Place) -> Cell:
        """Return the figures at a place."""
        return self.results.cells[place.cell]

    def figures_table(self, title: str, places: Sequence[Place], varied: Sequence[str]) -> Table:
        """Return a row for each backbone, method and value of the varied options."""
        head = [
            *("backbone", "method", *varied),
            *("coverage", "all six", "mean width", "score", "joint scope: all six", "volume^1/6"),
            *("own coverage", "own: all six", "own mean width", "own score", "point error"),
            *("width ratio", "rank corr.", "train s", "M param.", "MiB", "ms"),
        ]
        rows = []
        for key, of_key in grouped(places, _setting_of):
            cells = [self.cell(place) for place in of_key]
            rows.append(
                [
                    *map(str, key),
                    *sets_shown([cell.marginal for cell in cells]),
                    *joint_shown(cells),
                    *(own_shown(cells) or (BLANK,) * 4),
                    error_shown(cell.point_error for cell in cells),
                    adaptiveness_shown(cells, "width_ratio"),
                    adaptiveness_shown(cells, "rank_correlation"),
                    seconds_shown(cells),
                    _millions(cells),
                    _mebibytes(cells),
                    self.milliseconds(of_key),
                ]
            )
        return Table(title, head, rows)

    def coverage_table(self, title: str, places: Sequence[Place]) -> Table:
        """Return a row for each run: coverage of each degree of freedom, and its 99 % band.

        Only the frames of a random split are exchangeable; other splits have no band.
        """
        head = [
            *("backbone", "method", "seed", "coverage: tx", "ty", "tz", "rx", "ry", "rz"),
            *("joint scope: all six", "99 % band", "calibration, test frames"),
        ]
        rows = []
        for place in places:
            cell = self.cell(place)
            frames = cell.frames["total"] - cell.frames["invalid"]
            n = read_calibration(self.folder.bundle(place.cell)).calibration.n
            band = coverage_band(n, frames, CONFIDENCE) if place.split == "random" else None
            rows.append(
                [
                    *(place.backbone, place.method, str(place.seed)),
                    *(f"{value:.3f}" for value in cell.marginal.coverage),
                    f"{cell.joint.joint_coverage:.3f}",
                    "none" if band is None else f"{band[0]:.3f} to {band[1]:.3f}",
                    f"{n}, {frames}",
                ]
            )
        return Table(f"{title}: each run", head, rows)

    def noise_table(self, title: str, places: Sequence[Place], grid: Grid) -> Table:
        """Return a row for each backbone, method, varied value and noise, with both thresholds."""
        head = [
            *("backbone", "method", *grid.vary, "noise", "invalid", "point error"),
            *("thresholds of clean frames: coverage", "all six", "mean width", "score"),
            *("recalibrated: coverage", "all six", "mean width", "score"),
        ]
        rows = []
        for key, of_key in grouped(places, _setting_of):
            cells, named = [self.cell(place) for place in of_key], [str(value) for value in key]
            clean = sets_shown([cell.marginal for cell in cells])
            error = error_shown(cell.point_error for cell in cells)
            invalid = _share_invalid(cells, [cell.frames["invalid"] for cell in cells])
            rows.append([*named, "none", invalid, error, *clean, *clean])
            for name in noise_names(grid):
                found = [cell.noise[name] for cell in cells]
                noise = [figures for figures in found if figures is not None]
                if len(noise) < len(found):
                    rows.append([*named, name, "all frames of a seed", *([BLANK] * 9)])
                    continue
                rows.append(
                    [
                        *(*named, name, _share_invalid(cells, [n.invalid for n in noise])),
                        error_shown(figures.point_error for figures in noise),
                        *sets_shown([figures.clean for figures in noise]),
                        *sets_shown([figures.recalibrated for figures in noise]),
                    ]
                )
        return Table(f"{title}, with noise", head, rows)

    def table_one(self, grid: Grid) -> Table:
        """Return the paper's Table I as numbers, for a grid's first data set and backbone."""
        first = self.places(grid)[0]
        places = [
            place
            for place in self.places(grid)
            if (place.data, place.backbone) == (first.data, first.backbone)
        ]
        columns = {key[0]: found for key, found in grouped(places, lambda p: (p.method,))}

        def row(name: str, figure: Callable[[list[Cell]], str]) -> list[str]:
            cells = ([self.cell(place) for place in found] for found in columns.values())
            return [name, *map(figure, cells)]

        def rows_of(
            option: str, name: str, figure: Callable[[Cell], float | None]
        ) -> list[list[str]]:
            found = self.by_option(grid, first, option, figure)
            return [
                [name.format(value), *(of_value.get(method, BLANK) for method in columns)]
                for value, of_value in found.items()
            ]

        return Table(
            f"Table I with numbers: {first.data}, {first.split} split, {first.backbone}",
            ["", *columns],
            [
                [
                    "uncertainty bands: the network's sets",
                    *(self.joint_sets(found[0]) for found in columns.values()),
                ],
                row("disjoint bands: share of sets in pieces", pieces_shown),
                ["complexity: ms per frame", *map(self.milliseconds, columns.values())],
                row("complexity: millions of parameters", _millions),
                row("complexity: MiB of the model", _mebibytes),
                *rows_of(
                    "sharpness",
                    "interval calibration: own coverage at lambda {:g}",
                    lambda cell: None if cell.own is None else cell.own.mean_coverage,
                ),
                row(
                    "interval adaptiveness: width on frames of large over small errors",
                    lambda cells: adaptiveness_shown(cells, "width_ratio"),
                ),
                row(
                    "uncertainty accuracy: rank correlation of width and error",
                    lambda cells: adaptiveness_shown(cells, "rank_correlation"),
                ),
                row(
                    "uncertainty accuracy: interval score",
                    lambda cells: sets_shown([cell.marginal for cell in cells])[3],
                ),
                row("training time: processor seconds", seconds_shown),
                *rows_of(
                    "share",
                    "data dependency: score with a share of {:g} of the frames",
                    lambda cell: cell.marginal.normalised_interval_score,
                ),
            ],
        )

    def joint_sets(self, place: Place) -> str:
        """Describe the joint sets of a place's bundle."""
        return HEADS[read_calibration(self.folder.bundle(place.cell)).method].set_kind

    def by_option(
        self, grid: Grid, first: Place, option: str, figure: Callable[[Cell], float | None]
    ) -> dict[float, dict[str, str]]:
        """Map value of an option -> method -> a figure, median over seeds.

        Everything else is as in a grid's first place. Options that vary together with this one have
        the method's default.
        """
        groups: dict[tuple[str, Value], list[Place]] = {}
        for other in self.results.study.grids:
            if option not in other.vary or _setting(other) != _setting(grid):
                continue
            for place in self.places(other):
                kin = (place.data, place.split, place.backbone)
                if kin == (first.data, first.split, first.backbone) and _by_default(place, option):
                    groups.setdefault((place.method, place.varied[option]), []).append(place)
        found: dict[float, dict[str, str]] = {}
        for (method, value), places in groups.items():
            figures = [x for place in places if (x := figure(self.cell(place))) is not None]
            if figures:
                seeds = " (one seed)" if len(places) == 1 else ""
                found.setdefault(float(value), {})[method] = f"{median(figures):.3f}{seeds}"
        return dict(sorted(found.items()))

    def milliseconds(self, places: Sequence[Place]) -> str:
        """Median time per frame of the timed cell."""
        timings = [timing.ms for timing in self.results.timing.values()]
        found = [ms[place.cell]["p50"] for place in places for ms in timings if place.cell in ms]
        return f"{found[0]:.2f}" if found else BLANK


def grouped(
    places: Iterable[Place], key: Callable[[Place], tuple[Any, ...]]
) -> list[tuple[tuple[Any, ...], list[Place]]]:
    """Group places by key, in the order of first occurrence."""
    groups: dict[tuple[Any, ...], list[Place]] = {}
    for place in places:
        groups.setdefault(key(place), []).append(place)
    return list(groups.items())


def noise_names(grid: Grid) -> list[str]:
    """Return a grid's noises under the names that cells use."""
    return list(dict.fromkeys(str(parse_noise(text)) for text in grid.noises))


def _setting_of(place: Place) -> tuple[Any, ...]:
    return (place.backbone, place.method, *place.varied.values())


def _setting(grid: Grid) -> tuple[str, ...]:
    """Return what two grids must share for their cells to differ only in the varied options."""
    training = (grid.size, grid.copies, grid.steps, grid.fine_tune)
    return (grid.weights, grid.stages, grid.grid, *map(str, training))


def _by_default(place: Place, option: str) -> bool:
    """Whether every varied option but this one has the method's default."""
    known = TRAINABLE[place.method].config()
    return all(
        getattr(known, name, None) == value
        for name, value in place.varied.items()
        if name != option
    )


def _millions(cells: Sequence[Cell]) -> str:
    return f"{cells[0].graph_parameters / 1e6:.2f}"


def _mebibytes(cells: Sequence[Cell]) -> str:
    return f"{cells[0].model_bytes / 2**20:.1f}"


def _share_invalid(cells: Sequence[Cell], invalid: Sequence[int]) -> str:
    """Median share of test frames that did not pass the checks."""
    totals = [cell.frames["total"] for cell in cells]
    return f"{100 * median(np.divide(invalid, totals).tolist()):.1f} %"
