"""The report of a study: one self-contained HTML page, and its figures as files."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cvo_edge.errors import UsageError
from cvo_edge.files import write_whole
from cvo_export.data.noise import noisy, parse_noise
from cvo_export.data.splits import make_split
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.datasets.describe import summary
from cvo_export.study.cells import CellFolder
from cvo_export.study.grid import Grid, Place, Results, Value, expanded
from cvo_export.study.summaries import median
from cvo_export.study.tables import Table, Tables, grouped, noise_names

if TYPE_CHECKING:
    from jinja2 import Template
    from matplotlib.figure import Figure

    from cvo_export.plot import Track

REPORT_FILE, PICTURES_FOLDER = "report.html", "pictures"

_DPI = 110


class Picture(NamedTuple):
    """A picture of the report and its caption; ``source`` is the file as a data URL."""

    caption: str
    source: str


class Section(NamedTuple):
    """The report's section on one grid."""

    title: str
    text: str
    tables: Sequence[Table]
    pictures: Sequence[Picture]


def page_template() -> Template:
    """Return the template of the page; raises UsageError if a required package is missing."""
    try:
        import matplotlib  # noqa: F401
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError as error:
        raise UsageError(
            f'study: {error.name} is not installed; pip install "cvo-export[plot]"'
        ) from None
    environment = Environment(
        loader=PackageLoader("cvo_export"), autoescape=True, undefined=StrictUndefined
    )
    return environment.get_template(REPORT_FILE)


def write_report(results: Results, folder: CellFolder, template: Template) -> Path:
    """Write ``report.html`` and the pictures; returns the path of the page.

    Raises SinkError if a file cannot be written.
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
        first=[report.tables.table_one(grid) for grid in results.study.grids if not grid.vary],
        sections=[report.section(grid) for grid in results.study.grids],
    )
    path = folder.out / REPORT_FILE
    write_whole(path, page)
    return path


class _Report:
    """Sections and pictures of a study's grids."""

    def __init__(self, results: Results, folder: CellFolder) -> None:
        self.results = results
        self.folder = folder
        self.tables = Tables(results, folder)
        self._opened: dict[str, PoseDataset] = {}

    def section(self, grid: Grid) -> Section:
        """Return all tables and pictures of one grid."""
        tables, pictures = [], []
        for _, places in grouped(self.tables.places(grid), lambda place: (place.data,)):
            title = f"{places[0].data}, {places[0].split} split"
            tables.append(self.tables.figures_table(title, places, tuple(grid.vary)))
            if grid.vary:
                pictures.append(self.curves(grid, title, places))
            else:
                tables.append(self.tables.coverage_table(title, places))
            if grid.noises:
                tables.append(self.tables.noise_table(title, places, grid))
        if not grid.vary:
            pictures += self.sets(grid)
        seeds = "one seed"
        if grid.seeds > 1:
            seeds = f"{grid.seeds} seeds: medians, each seed's score in brackets"
        return Section(grid.name, f"{seeds}; weights {_source(grid.weights)}", tables, pictures)

    def sets(self, grid: Grid) -> list[Picture]:
        """Return pictures of all methods' sets, and of a method's tube under each noise, seed 0."""
        from cvo_export.plot import track
        from cvo_export.study.figures import comparison, tube

        places = [place for place in self.tables.places(grid) if place.seed == 0]
        pictures = []
        for (data, backbone), of_key in grouped(places, lambda p: (p.data, p.backbone)):
            dataset = self.dataset(str(data))
            bundles = {place.method: self.folder.bundle(place.cell) for place in of_key}
            shown = _sequence_shown(of_key[0], dataset)
            drawn = {m: track(bundle, dataset, sequence=shown) for m, bundle in bundles.items()}
            pictures.append(
                self.picture(
                    f"sets-{grid.name}-{data}-{backbone}",
                    comparison(drawn),
                    f"{data}, {backbone}: 0.9 sets of x over the test frames and of x and y from "
                    "above, absolute and relative to the truth; crosses are frames that a set "
                    "missed",
                )
            )
            if not grid.noises:
                continue
            method = tube_method(drawn)
            tracks = {"none": drawn[method]}
            for name in noise_names(grid):
                worse = noisy(dataset, parse_noise(name), of_key[0].seed)
                tracks[name] = track(bundles[method], worse, sequence=shown)
            pictures.append(
                self.picture(
                    f"tube-{grid.name}-{data}-{backbone}",
                    tube(tracks),
                    f"{data}, {backbone}, {method}: boxes of x, y, z under noise, thresholds of "
                    "clean frames",
                )
            )
        return pictures

    def curves(self, grid: Grid, title: str, places: Sequence[Place]) -> Picture:
        """Return a picture with the first varied option along x and a line per other setting."""
        from cvo_export.study.figures import curves

        option = next(iter(grid.vary))
        drawn = curves(option, grid.vary[option], self.panels(option, grid.vary[option], places))
        return self.picture(f"curves-{grid.name}-{places[0].data}", drawn, f"{title}: {option}")

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
        for key, of_key in grouped(
            places,
            lambda p: (
                *((p.backbone,) if len(backbones) > 1 else ()),
                p.method,
                *(f"{k} {v}" for k, v in p.varied.items() if k != option),
            ),
        ):
            label = ", ".join(key)
            for value in values:
                cells = [self.tables.cell(p) for p in of_key if p.varied[option] == value]
                own = [cell.own for cell in cells if cell.own is not None]
                found = (
                    median(figures.mean_coverage for figures in own),
                    median(cell.marginal.mean_coverage for cell in cells),
                    100 * median(figures.mean_width.m for figures in own),
                    100 * median(cell.marginal.mean_width.m for cell in cells),
                    median(cell.marginal.normalised_interval_score for cell in cells),
                )
                for panel, figure in zip(panels.values(), found, strict=True):
                    panel.setdefault(label, []).append(figure)
        return {
            name: lines for name, lines in panels.items() if np.isfinite([*lines.values()]).any()
        }

    def picture(self, name: str, figure: Figure, caption: str) -> Picture:
        """Write a picture to a file, and return it for the page."""
        stream = BytesIO()
        figure.savefig(stream, format="png", dpi=_DPI)
        content = stream.getvalue()
        file = re.sub(r"[^\w.]+", "-", name).lower() + ".png"
        write_whole(self.folder.out / PICTURES_FOLDER / file, content, make_folder=True)
        return Picture(caption, "data:image/png;base64," + base64.b64encode(content).decode())

    def dataset(self, label: str) -> PoseDataset:
        """Return the data set with this label; opens it once."""
        if label not in self._opened:
            self._opened[label] = open_dataset(expanded(self.results.data[label]))
        return self._opened[label]


def tube_method(tracks: Mapping[str, Track]) -> str:
    """Return the method whose tube is drawn: the first with bounded sets in every frame."""

    def bounded(track: Track) -> bool:
        estimates = [track.estimates[row] for row in track.rows]
        return bool(np.isfinite([(each.lower[:3], each.upper[:3]) for each in estimates]).all())

    return next((name for name, track in tracks.items() if bounded(track)), next(iter(tracks)))


def _sequence_shown(place: Place, dataset: PoseDataset) -> str:
    """Return the name of the sequence with the most test frames."""
    test = make_split(dataset, place.split, place.seed).roles["test"]
    name: str = dataset.sequence_names[int(np.bincount(dataset.sequence[test]).argmax())]
    return name


def _source(weights: str) -> str:
    """Describe the weights without their path."""
    return weights if weights in ("timm", "none") else "from a file"
