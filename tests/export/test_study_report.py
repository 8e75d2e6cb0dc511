"""The page of a study: each figure is in its row and column."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cvo_edge.heads import HEADS
from cvo_export.bundles.figures import adaptiveness
from cvo_export.networks.methods import TRAINABLE
from cvo_export.study import tables
from cvo_export.study.cell import Cell, Figures, NoiseFigures, Seconds, Width
from cvo_export.study.cells import CellFolder
from cvo_export.study.grid import Grid, Place, Results, Study
from cvo_export.study.report import _Report, tube_method

DATA = "somewhere"


def figures(score: float, coverage: float = 0.9, width: float = 0.01) -> Figures:
    return Figures(
        coverage=[coverage] * 6,
        mean_coverage=coverage,
        joint_coverage=0.5,
        mean_width=Width(width, 1.0),
        median_width=Width(width, 1.0),
        normalised_interval_score=score,
        unbounded=0.0,
    )


def cell(method: str, seed: int, score: float, own: float | None = None, **noise) -> Cell:
    return Cell(
        method=method,
        seed=seed,
        options="",
        bundle="",
        score="normalised",
        frames={"total": 200, "invalid": 2},
        marginal=figures(score),
        joint=figures(score),
        own=None if own is None else figures(3.0, own, 0.02),
        joint_volume={"geometric_mean": 0.5**6},
        point_error={"median_m": 0.01, "median_deg": 0.5},
        training=Seconds(60.0, 70.0),
        head_parameters=1,
        graph_parameters=2_000_000,
        model_bytes=3 << 20,
        adaptiveness={"width_ratio": 1.5, "rank_correlation": 0.25},
        pieces=0.04 if method == "csp" else None,
        noise=noise,
    )


class Fabricated:
    """Study results with made-up cells: one score per place."""

    def __init__(self, methods=("cjp", "csp")) -> None:
        self.methods = methods
        self.grids: list[Grid] = []
        self.places: list[Place] = []
        self.cells: dict[str, Cell] = {}

    def add(self, name, made, *, split="random", backbones=("net",), vary=None, **options):
        """Add a grid; ``made`` returns the cell of a place."""
        vary = vary or {}
        grid = Grid(
            name=name,
            data=[DATA],
            split=split,
            methods=list(self.methods),
            backbones=list(backbones),
            vary=vary,
            **options,
        )
        self.grids.append(grid)
        for backbone, method, seed, values in product(
            backbones, grid.methods, range(grid.seeds), product(*vary.values())
        ):
            varied = dict(zip(vary, values, strict=True))
            key = f"cell {len(self.places)}"
            self.places.append(Place(name, key, DATA, split, backbone, method, seed, varied))
            self.cells[key] = made(self.places[-1])
        return grid

    def report(self) -> _Report:
        study = Study(title="", grids=self.grids)
        results = Results("", 0.9, study, {DATA: DATA}, self.places, self.cells, {}, {})
        return _Report(results, CellFolder(Path("nowhere"), Path("nowhere")))


def rows_of(table):
    return {tuple(row[:2]): dict(zip(table.head, row, strict=True)) for row in table.rows}


def test_a_table_shows_medians_under_their_heads():
    made = Fabricated()
    scores = {("cjp", 0): 0.1, ("cjp", 1): 0.4, ("cjp", 2): 0.2}
    grid = made.add(
        "methods", lambda p: cell(p.method, p.seed, scores.get((p.method, p.seed), 7.0), 0.3)
    )
    row = rows_of(made.report().tables.figures_table("", made.places, ()))["net", "cjp"]
    assert row["score"] == "0.200 (0.100, 0.400, 0.200)"
    assert row["coverage"] == "0.900"
    assert row["mean width"] == "1.00 cm 1.00 deg"
    assert row["volume^1/6"] == "0.500"
    assert (row["own coverage"], row["own mean width"], row["own score"]) == (
        "0.300",
        "2.00 cm 1.00 deg",
        "3.000 (3.000, 3.000, 3.000)",
    )
    assert (row["width ratio"], row["rank corr."]) == ("1.50", "0.25")
    assert (row["M param."], row["MiB"], row["train s"]) == ("2.00", "3.0", "60")
    assert grid.seeds == 3


def test_noise_of_another_grid_is_not_shown_and_refused_frames_are():
    made = Fabricated()
    noise = NoiseFigures(20, {"median_m": 0.02, "median_deg": 1.0}, figures(5.0), figures(6.0))
    seen = {"speckle:0.3": noise, "occlusion:0.1": noise}
    grid = made.add(
        "methods",
        lambda p: cell(
            p.method,
            p.seed,
            1.0,
            # This grid contains the cells of the other grid.
            **({"speckle:0.3": noise} if p.seed else seen),
            **{"exposure:-8.0": None},
        ),
        noises=["speckle:0.3", "exposure:-8"],
        seeds=2,
    )
    table = made.report().tables.noise_table("", made.places, grid)
    names = [row[2] for row in table.rows]
    assert names == ["none", "speckle:0.3", "exposure:-8.0"] * 2
    row = dict(zip(table.head, table.rows[1], strict=True))
    assert row["invalid"] == "10.0 %"
    # Both policies have a score column; the last one is the recalibrated policy's.
    assert [value for value in table.rows[1] if value.startswith(("5", "6"))] == [
        "5.000 (5.000, 5.000)",
        "6.000 (6.000, 6.000)",
    ]
    assert table.rows[2][3] == "all frames of a seed"
    assert {len(row) for row in table.rows} == {len(table.head)}


def test_table_one_compares_like_with_like(monkeypatch):
    monkeypatch.setattr(tables, "read_calibration", lambda _: SimpleNamespace(method="cqr"))
    made = Fabricated()
    main = made.add("methods", lambda p: cell(p.method, p.seed, 1.0), backbones=("net", "other"))
    share = {"share": [0.5, 1.0]}

    def by_share(value):
        return lambda p: cell(p.method, p.seed, value * p.varied["share"])

    made.add("less", by_share(1.0), vary=share, seeds=1)
    made.add("less, of new flights", by_share(50.0), vary=share, split="sequence", seeds=1)
    made.add("less, another network", by_share(60.0), vary=share, backbones=("else",), seeds=1)
    made.add("less, other weights", by_share(70.0), vary=share, weights="none", seeds=1)
    gates = {"sharpness": [0.0, 1.0], "gate": ["corrected", "literal"]}
    made.add(
        "lambda",
        lambda p: cell(
            p.method,
            0,
            1.0,
            p.varied["sharpness"] / 2 if p.varied["gate"] == "corrected" else 0.99,
        ),
        vary={**gates},
        seeds=1,
    )
    made.places = [p for p in made.places if p.grid != "lambda" or p.method == "cjp"]
    table = made.report().tables.table_one(main)
    rows = {row[0]: row[1:] for row in table.rows}
    assert table.head == ["", "cjp", "csp"]
    assert (
        rows["data dependency: score with a share of 0.5 of the frames"] == ["0.500 (one seed)"] * 2
    )
    assert (
        rows["data dependency: score with a share of 1 of the frames"] == ["1.000 (one seed)"] * 2
    )
    assert rows["interval calibration: own coverage at lambda 0"] == ["0.000 (one seed)", "-"]
    assert rows["interval calibration: own coverage at lambda 1"] == ["0.500 (one seed)", "-"]
    assert rows["disjoint bands: share of sets in pieces"] == ["none", "4.0 %"]
    assert rows["complexity: MiB of the model"] == ["3.0", "3.0"]


@pytest.mark.parametrize(
    ("jointly", "sets"), [(True, "six at once, a region"), (False, "each degree of freedom")]
)
def test_a_method_that_is_registered_elsewhere_needs_no_change_here(jointly, sets, monkeypatch):
    monkeypatch.setitem(TRAINABLE, "toy", SimpleNamespace(config=lambda: SimpleNamespace(knob=1)))
    monkeypatch.setitem(HEADS, "toy", SimpleNamespace(one_joint_score=jointly))
    monkeypatch.setattr(tables, "read_calibration", lambda _: SimpleNamespace(method="toy"))
    made = Fabricated(methods=["toy"])
    main = made.add("methods", lambda p: cell("toy", p.seed, 1.0))
    vary = {"share": [0.5, 1.0], "knob": [1, 2]}
    made.add("less", lambda p: cell("toy", 0, p.varied["share"] * p.varied["knob"]), vary=vary)
    table = made.report().tables.table_one(main)
    assert table.head == ["", "toy"]
    rows = {row[0]: row[1] for row in table.rows}
    assert rows["uncertainty bands: the network's sets"] == sets
    assert rows["data dependency: score with a share of 0.5 of the frames"] == "0.500"


def test_the_tube_is_of_the_first_method_whose_sets_are_bounded():
    def drawn(reach):
        estimates = [SimpleNamespace(lower=np.full(6, -reach), upper=np.full(6, reach))]
        return SimpleNamespace(estimates=estimates, rows=[0])

    assert tube_method({"wide": drawn(np.inf), "toy": drawn(1.0), "next": drawn(1.0)}) == "toy"
    assert tube_method({"wide": drawn(np.inf), "wider": drawn(np.inf)}) == "wide"


def test_lines_of_a_curve_are_of_one_backbone_and_one_of_all_else():
    made = Fabricated()
    made.add(
        "knobs",
        lambda p: cell(
            p.method,
            p.seed,
            p.varied["sharpness"] + (10.0 if p.backbone == "other" else 0.0),
            0.5 if p.method == "cjp" else None,
        ),
        backbones=("net", "other"),
        vary={"sharpness": [0.0, 1.0], "gate": ["corrected", "literal"]},
        seeds=1,
    )
    panels = made.report().panels("sharpness", [0.0, 1.0], made.places)
    lines = panels["score, calibrated"]
    assert lines["net, cjp, gate literal"] == [0.0, 1.0]
    assert lines["other, cjp, gate literal"] == [10.0, 11.0]
    assert len(lines) == 8
    own = panels["coverage, own bounds"]
    assert own["net, cjp, gate corrected"] == [0.5, 0.5]
    assert np.isnan(own["net, csp, gate corrected"]).all()


def test_adaptiveness_is_what_its_names_say():
    error = np.tile(np.arange(9.0)[:, np.newaxis], (1, 6))
    found = adaptiveness(1.0 + error, error)
    # The ratio is (7 + 8 + 9) / (1 + 2 + 3).
    assert found == {"width_ratio": pytest.approx(4.0), "rank_correlation": pytest.approx(1.0)}
    backwards = adaptiveness(9.0 - error, error)
    assert backwards == {
        "width_ratio": pytest.approx(0.25),
        "rank_correlation": pytest.approx(-1.0),
    }


@pytest.mark.parametrize(
    "width",
    [np.full((9, 6), 0.1), 0.3 * (1.0 + 1e-15 * np.arange(54.0).reshape(9, 6)), np.zeros((9, 6))],
)
def test_one_width_for_all_frames_has_no_adaptiveness(width):
    nothing = {"width_ratio": None, "rank_correlation": None}
    assert adaptiveness(width, np.random.default_rng(0).random((9, 6))) == nothing


def test_sets_of_no_width_where_errors_are_small_have_no_ratio():
    error = np.tile(np.arange(9.0)[:, np.newaxis], (1, 6))
    width = np.where(error < 4, 0.0, error)
    assert adaptiveness(width, error)["width_ratio"] is None
