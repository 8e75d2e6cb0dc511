"""A new method needs two files: a toy method works with every command.

``toy_head`` and ``toy_network`` are registered with one line each, like the project's methods.
"""

import json
from functools import partial

import pytest
from typer.testing import CliRunner

from cvo_edge.heads import HEADS
from cvo_edge.output.records import read_records
from cvo_edge.programs import cli as runtime
from cvo_export import cli as training
from cvo_export.networks.methods import TRAINABLE
from cvo_export.study import grid

from . import toy_network
from .conftest import DATASET
from .toy_head import ToyHead

SMALL = [
    "--backbone",
    "test_efficientnet",
    "--weights",
    "none",
    "--size",
    "64x48",
    "--copies",
    "1",
    "--steps",
    "100",
]


@pytest.fixture(scope="module", autouse=True)
def _registered():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(HEADS, "toy", ToyHead)
        patch.setitem(TRAINABLE, "toy", toy_network.METHOD)
        yield


def call(app, *words, code=0):
    found = CliRunner().invoke(app, [str(word) for word in words])
    assert found.exit_code == code, found.output or found.exception
    return found.output


@pytest.fixture(scope="module")
def bundle(_registered, tmp_path_factory):
    folder = tmp_path_factory.mktemp("toy")
    call(
        training.app,
        *("train", "toy", DATASET, folder / "run", "--split", "random", "--toy-noise", "0.3"),
        *("--seed", "1"),
        *SMALL,
    )
    options = json.loads((folder / "run/config.json").read_bytes())["head"]
    assert options == {"method": "toy", "toy_noise": 0.3}
    call(training.app, "publish", folder / "run", folder / "bundle")
    return folder / "bundle"


def test_its_options_are_those_of_its_struct(bundle):
    shown = " ".join(call(training.app, "train", "--help").split())
    assert "--toy-noise" in shown
    assert "Noise on the features while training." in shown


def test_inspect_describes_it(bundle):
    shown = call(runtime.app, "inspect", bundle)
    assert "toy, toy_distance score, units of a toy" in shown


def test_evaluate_has_its_figures_and_its_promise(bundle, tmp_path):
    call(training.app, "evaluate", bundle, DATASET, "--json", tmp_path / "report.json")
    report = json.loads((tmp_path / "report.json").read_bytes())
    assert report["method"] == "toy"
    level = next(
        level
        for level in report["levels"]
        if (level["confidence"], level["scope"]) == (0.9, "marginal")
    )
    low, high = level["coverage_band"]
    assert all(low <= value <= high for value in level["coverage"])
    assert level["toy_width"] == pytest.approx(sum(level["mean_width"]) / 6)


def test_run_writes_its_intervals(bundle, tmp_path):
    call(training.app, "render", DATASET, tmp_path / "clip", "--sequence", "flight-01")
    call(runtime.app, "run", bundle, tmp_path / "clip", "-o", tmp_path / "out.jsonl", "--quiet")
    records = list(read_records(tmp_path / "out.jsonl"))
    assert len(records) == 40
    assert any(record.interval is not None and record.interval.bounded for record in records)


def test_compare_and_the_report_of_a_study_hold_it(bundle, tmp_path, monkeypatch):
    # The command has no option for it; drawing pictures of full size is most of its time.
    with monkeypatch.context() as patch:
        patch.setattr(grid, "Grid", partial(grid.Grid, size="64x48"))
        table = call(
            training.app,
            *("compare", DATASET, tmp_path / "compare", "--methods", "toy,split", "--seeds", "1"),
            *("--backbone", "test_efficientnet", "--split", "random", "--jobs", "1"),
            *("--weights", "none", "--copies", "1", "--steps", "100"),
        )
    assert any(line.startswith("toy") for line in table.splitlines())
    (tmp_path / "study.toml").write_text(
        'title = "Toys"\n[[grids]]\nname = "toys"\nmethods = ["toy"]\nseeds = 1\n'
        f'data = ["{DATASET}"]\nsplit = "random"\nbackbones = ["test_efficientnet"]\n'
        'weights = "none"\nsize = "64x48"\n'
        "copies = 1\nsteps = 100\n"
    )
    call(training.app, "study", tmp_path / "study.toml", tmp_path / "study", "--jobs", "1")
    page = (tmp_path / "study/report.html").read_text()
    assert "toy" in page
    assert "each degree of freedom" in page
