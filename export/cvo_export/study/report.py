"""The report of a study: one page of HTML with everything in it, and its pictures as files."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cvo_edge.bundle.reading import read_calibration
from cvo_edge.errors import UsageError
from cvo_export.bundles.figures import coverage_band
from cvo_export.data.noise import noisy, parse_noise
from cvo_export.data.splits import make_split
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.datasets.describe import summary
from cvo_export.files import write_whole
from cvo_export.networks.methods import TRAINABLE
from cvo_export.study.cells import CONFIDENCE, Cell, CellFolder, Figures
from cvo_export.study.grid import Grid, Place, Results, Value, expanded

if TYPE_CHECKING:
    from jinja2 import Template
    from matplotlib.figure import Figure

REPORT_FILE, PICTURES_FOLDER = "report.html", "pictures"

# Of the tube, which is drawn for one method.
_TUBE_METHOD = "cjp"
_DPI = 110


class Table(NamedTuple):
    """A table of the report: text alone."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


class Picture(NamedTuple):
    """A picture of the report, and what it shows; ``source`` is the file as a data URL."""

    caption: str
    source: str


class Section(NamedTuple):
    """A grid of the report."""

    title: str
    text: str
    tables: Sequence[Table]
    pictures: Sequence[Picture]


def page_template() -> Template:
    """What the page is made with; raises UsageError where the packages for it are missing."""
    try:
        import matplotlib  # noqa: F401
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError as error:
        raise UsageError(
            f'study: expected {error.name}, found none; pip install "cvo-export[plot]"'
        ) from None
    environment = Environment(
        loader=PackageLoader("cvo_export"), autoescape=True, undefined=StrictUndefined
    )
    return environment.get_template(REPORT_FILE)


def write_report(results: Results, folder: CellFolder, template: Template) -> Path:
    """Write ``report.html`` and the pictures; returns the page.

    Raises SinkError where nothing can be written.
    """
    report = _Report(results, folder)
    page = template.render(
        title=results.title,
        confidence=results.confidence,
        versions=results.versions,
        cells=len(results.cells),
        data=[summary(report.dataset(label)) for label in results.data],
        machines=sorted(
            {
                f"{timing.environment['cpu']}, {timing.threads} threads"
                for timing in results.timing.values()
            }
        ),
        first=[report.table_one(grid) for grid in results.study.grids if not grid.vary],
        sections=[report.section(grid) for grid in results.study.grids],
    )
    path = folder.out / REPORT_FILE
    write_whole(path, page)
    return path


class _Report:
    """Tables and pictures of the grids of a study."""

    def __init__(self, results: Results, folder: CellFolder) -> None:
        self.results = results
        self.folder = folder
        self._opened: dict[str, PoseDataset] = {}

    def section(self, grid: Grid) -> Section:
        """Return all that one grid has to show."""
        tables, pictures = [], []
        for data in dict.fromkeys(place.data for place in self.places(grid)):
            places = [place for place in self.places(grid) if place.data == data]
            split = places[0].split
            title = f"{data}, {split} split"
            if grid.vary:
                tables.append(self.figures_table(title, places, tuple(grid.vary)))
                pictures += self.curves(grid, title, places)
            else:
                tables.append(self.figures_table(title, places, ()))
                tables.append(self.coverage_table(title, places))
            if grid.noises:
                tables.append(self.noise_table(title, places, grid))
        if not grid.vary:
            pictures += self.sets(grid)
        seeds = "one seed"
        if grid.seeds > 1:
            seeds = f"{grid.seeds} seeds: medians, each seed's score in brackets"
        return Section(grid.name, f"{seeds}; weights {_source(grid.weights)}", tables, pictures)

    def places(self, grid: Grid) -> list[Place]:
        """Return the cells' places in a grid."""
        return [place for place in self.results.places if place.grid == grid.name]

    def cell(self, place: Place) -> Cell:
        """Return the figures of a place."""
        return self.results.cells[place.cell]

    # -- tables -----------------------------------------------------------------------------------

    def figures_table(self, title: str, places: Sequence[Place], varied: Sequence[str]) -> Table:
        """Return a line for each backbone, method and value of the options that vary."""
        head = [
            *("backbone", "method", *varied),
            *("coverage", "all six", "mean width", "score", "joint scope: all six", "volume^1/6"),
            *("own coverage", "own mean width", "own score", "point error"),
            *("width ratio", "rank corr.", "train s", "M param.", "MiB", "ms"),
        ]
        rows = []
        for key, of_key in _grouped(places, lambda p: (p.backbone, p.method, *p.varied.values())):
            cells = [self.cell(place) for place in of_key]
            own = [cell.own for cell in cells if cell.own is not None]
            rows.append(
                [
                    *map(str, key),
                    *_shown([cell.marginal for cell in cells]),
                    f"{_median(cell.joint.joint_coverage for cell in cells):.3f}",
                    f"{_median(_side(cell) for cell in cells):.3f}",
                    *_own(own),
                    _error([cell.point_error for cell in cells]),
                    _adaptiveness(cells, "width_ratio"),
                    _adaptiveness(cells, "rank_correlation"),
                    _seconds(cells),
                    f"{cells[0].graph_parameters / 1e6:.2f}",
                    f"{cells[0].model_bytes / 2**20:.1f}",
                    self.milliseconds(of_key),
                ]
            )
        return Table(title, head, rows)

    def coverage_table(self, title: str, places: Sequence[Place]) -> Table:
        """Return a line a run: coverage of each degree of freedom, and the band it has to be in.

        Frames of a random split are exchangeable; of other splits no band holds, and none is shown.
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
        return Table(f"{title}: run by run", head, rows)

    def noise_table(self, title: str, places: Sequence[Place], grid: Grid) -> Table:
        """Return a line for each backbone, method, value that varies and noise: both policies."""
        head = [
            *("backbone", "method", *grid.vary, "noise", "invalid", "point error"),
            *("thresholds of clean frames: coverage", "all six", "mean width", "score"),
            *("recalibrated: coverage", "all six", "mean width", "score"),
        ]
        rows = []
        for key, of_key in _grouped(places, lambda p: (p.backbone, p.method, *p.varied.values())):
            cells, named = [self.cell(place) for place in of_key], [str(value) for value in key]
            clean = _shown([cell.marginal for cell in cells])
            error = _error([cell.point_error for cell in cells])
            invalid = _share_invalid(cells, [cell.frames["invalid"] for cell in cells])
            rows.append([*named, "none", invalid, error, *clean, *clean])
            for name in _noises(grid):
                found = [cell.noise[name] for cell in cells]
                noise = [figures for figures in found if figures is not None]
                if len(noise) < len(found):
                    rows.append([*named, name, "all of a seed's frames", *(["-"] * 9)])
                    continue
                rows.append(
                    [
                        *(*named, name, _share_invalid(cells, [n.invalid for n in noise])),
                        _error([figures.point_error for figures in noise]),
                        *_shown([figures.clean for figures in noise]),
                        *_shown([figures.recalibrated for figures in noise]),
                    ]
                )
        return Table(f"{title}, with noise", head, rows)

    def table_one(self, grid: Grid) -> Table:
        """Return the paper's Table I with numbers, of a grid's first data set and backbone."""
        first = self.places(grid)[0]
        places = [
            place
            for place in self.places(grid)
            if (place.data, place.backbone) == (first.data, first.backbone)
        ]
        columns = _grouped(places, lambda place: (place.method,))
        cells = {key[0]: [self.cell(place) for place in found] for key, found in columns}
        shares = self.by_share(grid, first)
        sharpness = self.sharpness(grid, first)
        joint_sets = {"mcqr": "six at once, a region"}

        def row(name: str, figure: Callable[[str], str | None]) -> list[str]:
            return [name, *(figure(method) or "-" for method in cells)]

        ms = {method: self.milliseconds(found) for (method,), found in columns}
        return Table(
            f"Table I with numbers: {first.data}, {first.split} split, {first.backbone}",
            ["", *cells],
            [
                row(
                    "uncertainty bands: the network's sets",
                    lambda m: joint_sets.get(m, "each degree of freedom"),
                ),
                row("disjoint bands: share of sets in pieces", lambda m: _pieces(cells[m])),
                row("complexity: ms a frame", lambda m: ms[m]),
                row(
                    "complexity: millions of parameters",
                    lambda m: f"{cells[m][0].graph_parameters / 1e6:.2f}",
                ),
                row(
                    "complexity: MiB of the model",
                    lambda m: f"{cells[m][0].model_bytes / 2**20:.1f}",
                ),
                *(
                    row(f"interval calibration: own coverage at lambda {value:g}", found.get)
                    for value, found in sharpness.items()
                ),
                row(
                    "interval adaptiveness: width on frames of large over small errors",
                    lambda m: _adaptiveness(cells[m], "width_ratio"),
                ),
                row(
                    "uncertainty accuracy: rank correlation of width and error",
                    lambda m: _adaptiveness(cells[m], "rank_correlation"),
                ),
                row(
                    "uncertainty accuracy: interval score",
                    lambda m: _shown([cell.marginal for cell in cells[m]])[3],
                ),
                row("training time: processor seconds", lambda m: _seconds(cells[m])),
                *(
                    row(f"data dependency: score at {100 * share:g} % of the frames", found.get)
                    for share, found in shares.items()
                ),
            ],
        )

    def by_share(self, grid: Grid, first: Place) -> dict[float, dict[str, str]]:
        """Share of the training frames -> method -> score, median over seeds."""
        found: dict[float, dict[str, str]] = {}
        for place, cells in self.varied(grid, first, "share"):
            scores = [cell.marginal.normalised_interval_score for cell in cells]
            found.setdefault(float(place.varied["share"]), {})[place.method] = (
                f"{_median(scores):.3f}{_seeds(cells)}"
            )
        return dict(sorted(found.items()))

    def sharpness(self, grid: Grid, first: Place) -> dict[float, dict[str, str]]:
        """Lambda -> method -> coverage of the own bounds, all else at its default."""
        found: dict[float, dict[str, str]] = {}
        for place, cells in self.varied(grid, first, "sharpness"):
            own = [cell.own.mean_coverage for cell in cells if cell.own is not None]
            if own:
                found.setdefault(float(place.varied["sharpness"]), {})[place.method] = (
                    f"{_median(own):.3f}{_seeds(cells)}"
                )
        return dict(sorted(found.items()))

    def varied(self, grid: Grid, first: Place, option: str) -> list[tuple[Place, list[Cell]]]:
        """Cells in which one option varies and all else is as in a grid's first place.

        A place of each value and method, and its cells of all seeds. Other options that vary with
        it are at the value that the method has by itself.
        """
        groups: dict[tuple[str, Value], list[Place]] = {}
        for other in self.results.study.grids:
            if option not in other.vary or _setting(other) != _setting(grid):
                continue
            for place in self.places(other):
                kin = (place.data, place.split, place.backbone)
                if kin == (first.data, first.split, first.backbone) and _by_itself(place, option):
                    groups.setdefault((place.method, place.varied[option]), []).append(place)
        return [(places[0], [self.cell(p) for p in places]) for places in groups.values()]

    def milliseconds(self, places: Sequence[Place]) -> str:
        """Median of a frame, of the cell that was timed."""
        timings = [timing.ms for timing in self.results.timing.values()]
        found = [ms[place.cell]["p50"] for place in places for ms in timings if place.cell in ms]
        return f"{found[0]:.2f}" if found else "-"

    # -- pictures ---------------------------------------------------------------------------------

    def sets(self, grid: Grid) -> list[Picture]:
        """Return the sets of all methods, and the tube under each noise, seed 0."""
        from cvo_export.plot import track
        from cvo_export.study.figures import comparison, tube

        places = [place for place in self.places(grid) if place.seed == 0]
        pictures = []
        for (data, backbone), of_key in _grouped(places, lambda p: (p.data, p.backbone)):
            dataset = self.dataset(str(data))
            bundles = {place.method: self.folder.bundle(place.cell) for place in of_key}
            shown = _sequence_shown(of_key[0], dataset)
            drawn = {m: track(bundle, dataset, sequence=shown) for m, bundle in bundles.items()}
            pictures.append(
                self.picture(
                    f"sets-{grid.name}-{data}-{backbone}",
                    comparison(drawn),
                    f"{data}, {backbone}: sets of 0.9, of x over the test frames and of x and y, "
                    "as they are and about the truth; crosses are frames that a set missed",
                )
            )
            if _TUBE_METHOD not in bundles or not grid.noises:
                continue
            tracks = {"none": drawn[_TUBE_METHOD]}
            for name in _noises(grid):
                worse = noisy(dataset, parse_noise(name), of_key[0].seed)
                tracks[name] = track(bundles[_TUBE_METHOD], worse, sequence=shown)
            pictures.append(
                self.picture(
                    f"tube-{grid.name}-{data}-{backbone}",
                    tube(tracks),
                    f"{data}, {backbone}, {_TUBE_METHOD}: boxes of x, y, z under noise, "
                    "thresholds of clean frames",
                )
            )
        return pictures

    def curves(self, grid: Grid, title: str, places: Sequence[Place]) -> list[Picture]:
        """Return one picture: the first option that varies along x, lines for the rest."""
        from cvo_export.study.figures import curves

        option = next(iter(grid.vary))
        drawn = curves(option, grid.vary[option], self.panels(option, grid.vary[option], places))
        name = f"curves-{grid.name}-{places[0].data}"
        return [self.picture(name, drawn, f"{title}: {option}")]

    def panels(
        self, option: str, values: Sequence[Value], places: Sequence[Place]
    ) -> dict[str, dict[str, list[float]]]:
        """Panel -> line -> a figure for each value of an option, median over seeds."""
        panels: dict[str, dict[str, list[float]]] = {
            "coverage, own bounds": {},
            "coverage, calibrated": {},
            "mean width, own bounds (cm)": {},
            "mean width, calibrated (cm)": {},
            "score, calibrated": {},
        }
        backbones = {place.backbone for place in places}
        for key, of_key in _grouped(
            places,
            lambda p: (
                *((p.backbone,) if len(backbones) > 1 else ()),
                p.method,
                *(f"{k} {v}" for k, v in p.varied.items() if k != option),
            ),
        ):
            label = ", ".join(key)
            for value in values:
                cells = [self.cell(p) for p in of_key if p.varied[option] == value]
                own = [cell.own for cell in cells if cell.own is not None]
                found = (
                    _median(figures.mean_coverage for figures in own),
                    _median(cell.marginal.mean_coverage for cell in cells),
                    100 * _median(figures.mean_width.m for figures in own),
                    100 * _median(cell.marginal.mean_width.m for cell in cells),
                    _median(cell.marginal.normalised_interval_score for cell in cells),
                )
                for panel, figure in zip(panels.values(), found, strict=True):
                    panel.setdefault(label, []).append(figure)
        return {
            name: lines for name, lines in panels.items() if np.isfinite([*lines.values()]).any()
        }

    def picture(self, name: str, figure: Figure, caption: str) -> Picture:
        """Write a picture as a file, and return it for the page."""
        stream = BytesIO()
        figure.savefig(stream, format="png", dpi=_DPI)
        content = stream.getvalue()
        file = re.sub(r"[^\w.]+", "-", name).lower() + ".png"
        write_whole(self.folder.out / PICTURES_FOLDER / file, content)
        return Picture(caption, "data:image/png;base64," + base64.b64encode(content).decode())

    def dataset(self, label: str) -> PoseDataset:
        """Return the data set of this label, opened once."""
        if label not in self._opened:
            self._opened[label] = open_dataset(expanded(self.results.data[label]))
        return self._opened[label]


def _setting(grid: Grid) -> tuple[str, ...]:
    """What two grids must share for their cells to differ in nothing but what varies."""
    training = (grid.copies, grid.steps, grid.fine_tune)
    return (grid.weights, grid.size, grid.stages, grid.grid, *map(str, training))


def _by_itself(place: Place, option: str) -> bool:
    """Whether all that varies in a place but this option is at the method's own value."""
    known = TRAINABLE[place.method].config()
    return all(
        getattr(known, name, None) == value
        for name, value in place.varied.items()
        if name != option
    )


def _side(cell: Cell) -> float:
    """Edge of a box of the joint sets' volume, in standard deviations."""
    return float(cell.joint_volume["geometric_mean"] ** (1 / 6))


def _seeds(cells: Sequence[Cell]) -> str:
    return " (one seed)" if len(cells) == 1 else ""


def _noises(grid: Grid) -> list[str]:
    """Noises of a grid by the names that cells have them under."""
    return list(dict.fromkeys(str(parse_noise(text)) for text in grid.noises))


def _share_invalid(cells: Sequence[Cell], invalid: Sequence[int]) -> str:
    """Median share of the test frames that did not pass the checks."""
    totals = [cell.frames["total"] for cell in cells]
    return f"{100 * _median(np.divide(invalid, totals).tolist()):.1f} %"


def _grouped(
    places: Iterable[Place], key: Callable[[Place], tuple[Any, ...]]
) -> list[tuple[tuple[Any, ...], list[Place]]]:
    groups: dict[tuple[Any, ...], list[Place]] = {}
    for place in places:
        groups.setdefault(key(place), []).append(place)
    return list(groups.items())


def _sequence_shown(place: Place, dataset: PoseDataset) -> str:
    """Name of the sequence that has the most test frames."""
    test = make_split(dataset, place.split, place.seed).roles["test"]
    name: str = dataset.sequence_names[int(np.bincount(dataset.sequence[test]).argmax())]
    return name


def _shown(figures: Sequence[Figures]) -> tuple[str, str, str, str]:
    """Coverage, coverage of all six, mean width and score with each seed's."""
    scores = [entry.normalised_interval_score for entry in figures]
    each = f" ({', '.join(f'{score:.3f}' for score in scores)})" if len(scores) > 1 else ""
    return (
        f"{_median(entry.mean_coverage for entry in figures):.3f}",
        f"{_median(entry.joint_coverage for entry in figures):.3f}",
        f"{100 * _median(entry.mean_width.m for entry in figures):.1f} cm "
        f"{_median(entry.mean_width.deg for entry in figures):.2f} deg",
        f"{_median(scores):.3f}{each}",
    )


def _own(figures: Sequence[Figures]) -> tuple[str, str, str]:
    """Coverage, mean width and score of the networks' own bounds, where they have some."""
    if not figures:
        return "-", "-", "-"
    coverage, _, width, _ = _shown(figures)
    return coverage, width, f"{_median(f.normalised_interval_score for f in figures):.3f}"


def _error(errors: Sequence[Mapping[str, float]]) -> str:
    return (
        f"{100 * _median(error['median_m'] for error in errors):.2f} cm "
        f"{_median(error['median_deg'] for error in errors):.2f} deg"
    )


def _adaptiveness(cells: Sequence[Cell], key: str) -> str:
    found = [value for cell in cells if (value := cell.adaptiveness[key]) is not None]
    return f"{_median(found):.2f}" if found else "-"


def _pieces(cells: Sequence[Cell]) -> str:
    found = [cell.pieces for cell in cells if cell.pieces is not None]
    return f"{100 * _median(found):.1f} %" if found else "none"


def _seconds(cells: Sequence[Cell]) -> str:
    found = [cell.training.processor for cell in cells if cell.training is not None]
    return f"{_median(found):.0f}" if found else "-"


def _median(values: Iterable[float]) -> float:
    """Median, NaN of nothing."""
    found = list(values)
    return float(np.median(found)) if found else float("nan")


def _source(weights: str) -> str:
    """What a reader may know of weights: never a path."""
    return weights if weights in ("timm", "none") else "of a file"
