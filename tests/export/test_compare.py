"""The comparison: each cell runs once, with the same figures for any number of workers."""

import json
import shutil
from functools import partial

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from cvo_edge.errors import SinkError, UsageError
from cvo_export.cli import app
from cvo_export.datasets import open_dataset
from cvo_export.evaluate import evaluate, find_level
from cvo_export.networks.backbone import Backbone, BackboneConfig
from cvo_export.networks.methods import TRAINABLE
from cvo_export.study import cells, frame_times
from cvo_export.study.cells import CellFolder
from cvo_export.study.compare import compare
from cvo_export.study.grid import Grid
from cvo_export.study.workers import run_tasks
from cvo_export.training.run import load_run

from .conftest import ignore_progress

DATASET = "synthetic:room,flights=8,frames=20,size=64x48"
METHODS = ["split", "gaussian"]


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    """Options of the grid; runs share features only if their weights come from a file."""
    path = tmp_path_factory.mktemp("weights") / "weights.safetensors"
    torch.manual_seed(5)
    config = BackboneConfig("test_efficientnet", stages=("8",), grid=(3, 4))
    body = Backbone(config, 48, 64).body
    save_file(body.state_dict(), path)
    return {
        "data": [DATASET],
        "methods": METHODS,
        "seeds": 2,
        "split": "random",
        "backbones": ["test_efficientnet"],
        "size": "64x48",
        "weights": str(path),
        "stages": "8",
        "copies": 1,
        "steps": 100,
    }


def compared_again(out, options, jobs=1, **changes):
    said = []
    grid = Grid(name="compare", **{**options, **changes})
    folder = CellFolder.in_folder(out, None)
    lines = compare(grid, folder, partial(run_tasks, jobs), ignore_progress, said.append)
    # The first line describes the data set.
    return lines, said[1:]


@pytest.fixture(scope="module")
def compared(options, tmp_path_factory):
    """Results and messages of a comparison: seed 0 in this process, seed 1 in two others."""
    out = tmp_path_factory.mktemp("compare") / "out"
    _, first = compared_again(out, options, seeds=1)
    lines, second = compared_again(out, options, jobs=2)
    return out, lines, (first, second)


@pytest.fixture
def copied(compared, tmp_path):
    """A copy of the results that a test may change."""
    return shutil.copytree(compared[0], tmp_path / "out")


def path_of(out, name):
    """Return the file of the cell METHOD-SEED."""
    (found,) = (out / "cells").glob(f"*-{name}-????????.json")
    return found


def cell(out, name):
    return json.loads(path_of(out, name).read_text())


def cells_of(out):
    return sorted((out / "cells").iterdir())


def short(text):
    """Return METHOD-SEED, which precedes the digest in a cell's name."""
    return "-".join(text.split(":")[0].split("-")[-3:-1])


def test_every_cell_is_run_once_and_said(compared):
    out, _, (first, second) = compared
    names = [f"{method}-{seed}" for method in METHODS for seed in (0, 1)]
    assert sorted(short(path.stem) for path in (out / "cells").iterdir()) == sorted(names)
    assert [short(line) for line in first] == ["split-0", "gaussian-0"]
    assert sorted(short(line) for line in second) == ["gaussian-1", "split-1"]
    assert all(line.endswith(f"({i} of 2)") for i, line in enumerate(first, 1))
    # Each seed has one folder of features; the runs have none.
    assert len(list((out / "features").iterdir())) == 2
    assert not list((out / "runs").glob("*/features*"))


def test_a_cell_holds_what_evaluate_says_of_its_bundle(compared):
    out, _, _ = compared
    name = path_of(out, "gaussian-1").stem
    report = evaluate(out / "bundles" / name, open_dataset(DATASET), "test")
    marginal = find_level(report["levels"], 0.9, "marginal")
    joint = find_level(report["levels"], 0.9, "joint")
    found = cell(out, "gaussian-1")
    assert found["marginal"]["coverage"] == marginal["coverage"]
    assert found["marginal"]["joint_coverage"] == marginal["joint_coverage"]
    score = marginal["normalised_interval_score"]
    assert found["marginal"]["normalised_interval_score"] == score
    width = np.array(marginal["median_width"])
    assert found["marginal"]["median_width"]["m"] == pytest.approx(width[:3].mean())
    assert found["marginal"]["median_width"]["deg"] == pytest.approx(np.rad2deg(width[3:].mean()))
    assert found["joint"]["joint_coverage"] == joint["joint_coverage"]
    assert found["joint_volume"] == joint["joint_volume"]
    assert found["own"]["coverage"] == report["own"]["coverage"]
    assert found["point_error"] == report["point_error"]
    assert cell(out, "split-1")["own"] is None
    assert found["training"]["processor"] > 0
    graph = load_run(out / "runs" / name).graph
    assert found["graph_parameters"] == sum(p.numel() for p in graph.parameters())
    behind = found["graph_parameters"] - found["head_parameters"]
    assert behind == sum(p.numel() for p in graph.backbone.parameters())
    model = out / "bundles" / name / "model.onnx"
    assert found["model_bytes"] == model.stat().st_size


def test_the_table_has_a_row_for_every_kind_of_set(compared):
    out, lines, _ = compared
    assert (out / "compare.txt").read_text() == "\n".join(lines) + "\n"
    rows = [line for line in lines if line.startswith(tuple(METHODS))]
    names = [row.split("  ")[0] for row in rows]
    assert names == ["split, conformal", "gaussian, own", "gaussian, conformal"]
    for name, row in zip(names, rows, strict=True):
        kind = "own" if name.endswith("own") else "marginal"
        for seed in (0, 1):
            figures = cell(out, f"{name.split(',')[0]}-{seed}")[kind]
            assert f"{figures['normalised_interval_score']:.3f}" in row
    assert len({row.index(") ") for row in rows}) == 1


def test_the_results_are_those_of_a_study(compared):
    out, _, _ = compared
    report = json.loads((out / "results.json").read_text())
    assert report["cells"] == {path.stem: json.loads(path.read_text()) for path in cells_of(out)}
    assert report["timing"] == {"compare": json.loads((out / "timing-compare.json").read_text())}
    timed = [path_of(out, f"{method}-0").stem for method in METHODS]
    assert set(report["timing"]["compare"]["ms"]) == set(timed)
    assert report["timing"]["compare"]["environment"]["cores_allowed"] >= 1
    (grid,) = report["study"]["grids"]
    assert grid["steps"] == 100
    assert str(out.parent) not in (out / "results.json").read_text()


def test_a_finished_comparison_trains_and_times_nothing(copied, compared, options, monkeypatch):
    shutil.rmtree(copied / "runs")
    shutil.rmtree(copied / "features")
    for name in ("train", "prepare_features"):
        monkeypatch.setattr(cells, name, None)
    monkeypatch.setattr(frame_times, "frame_ms", None)
    lines, said = compared_again(copied, options, jobs=2)
    assert lines == compared[1]
    assert said == []


def test_a_cell_that_is_gone_is_made_again_with_the_same_figures(copied, options):
    before = cell(copied, "gaussian-1")
    path = path_of(copied, "gaussian-1")
    path.unlink()
    shutil.rmtree(copied / "runs" / path.stem)
    # In a process of its own, as before.
    _, said = compared_again(copied, options, jobs=2)
    assert [short(line) for line in said] == ["gaussian-1"]
    after = cell(copied, "gaussian-1")
    assert {**after, "training": None} == {**before, "training": None}


def test_a_failed_cell_is_named_and_the_others_are_run(copied, options):
    split, gaussian = (path_of(copied, f"{method}-0") for method in METHODS)
    seconds = cell(copied, "gaussian-0")["training"]
    split.unlink()
    gaussian.unlink()
    (copied / "bundles" / split.stem / "precious.txt").write_text("keep")
    with pytest.raises(
        SinkError, match=rf"1 of 2 cells failed \({split.stem}\); run the same command"
    ):
        compared_again(copied, options)
    # The run was already complete, and so is its training time.
    assert cell(copied, "gaussian-0")["training"] == seconds
    assert not split.exists()


def test_cells_of_other_options_are_refused_by_name(copied, options):
    names = ", ".join(path.stem for path in cells_of(copied))
    with pytest.raises(UsageError, match=rf"cells of other options \({names}\); name a new folder"):
        compared_again(copied, options, steps=101)
    path = path_of(copied, "split-0")
    other = path.rename(path.with_stem(path.stem[:-8] + "0" * 8))
    with pytest.raises(UsageError, match=rf"options \({other.stem}\); name"):
        compared_again(copied, options, methods=["gaussian"])
    other.write_text(json.dumps({**json.loads(other.read_text()), "more": 1}))
    with pytest.raises(UsageError, match="expected the figures of a cell"):
        compared_again(copied, options)


def test_a_folder_of_an_earlier_version_is_refused(tmp_path, options):
    (tmp_path / "cells").mkdir()
    for name in ("mc-dropout-10", "cjp-0"):
        (tmp_path / "cells" / f"{name}.json").write_text("{}")
    found = r"cells of an earlier version \(cjp-0, mc-dropout-10\); name a new folder"
    with pytest.raises(UsageError, match=found):
        compared_again(tmp_path, options)


@pytest.mark.parametrize(
    ("methods", "message"),
    [
        ("split,other", r"method: expected one of cjp, .*split, found other"),
        ("split,split", "methods: expected each value once"),
    ],
)
def test_methods_that_cannot_be_compared_are_refused_before_anything(methods, message, tmp_path):
    command = ["compare", DATASET, str(tmp_path / "out"), "--weights", "none"]
    with pytest.raises(UsageError, match=message) as caught:
        app([*command, "--methods", methods], standalone_mode=False)
    assert caught.value.exit_code == 2
    assert not (tmp_path / "out").exists()


def test_the_command_compares_everything_by_default(tmp_path, monkeypatch, capsys):
    asked = []

    def compare(grid, folder, *_):
        asked.append((grid, folder))
        return ["the table"]

    monkeypatch.setattr("cvo_export.study.compare.compare", compare)
    app(["compare", DATASET, str(tmp_path / "out"), "--split", "random"], standalone_mode=False)
    ((grid, folder),) = asked
    assert grid.methods == list(TRAINABLE)
    assert (grid.data, grid.split, grid.seeds, grid.steps) == ([DATASET], "random", 3, None)
    assert folder.features == tmp_path / "out" / "features"
    assert capsys.readouterr().out == "the table\n"


def test_a_folder_that_cannot_be_one_is_refused(tmp_path, options):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(SinkError, match="cannot be written"):
        compared_again(tmp_path / "out", options)


def test_bundles_are_timed_again_when_one_has_changed(copied, options, monkeypatch):
    path = copied / "timing-compare.json"
    timing = json.loads(path.read_text())
    split = path_of(copied, "split-0").stem
    timing["bundles"][split] = "0" * 64
    path.write_text(json.dumps(timing))
    timed = []

    def frame_ms(bundles, dataset):
        timed.append(sorted(short(folder.name) for folder in bundles.values()))
        return {method: {"p50": 1.25, "p95": 2.5} for method in bundles}

    monkeypatch.setattr(frame_times, "frame_ms", frame_ms)
    for _ in range(2):
        lines, _ = compared_again(copied, options)
        assert sum("1.25 (2.50)" in line for line in lines) == 2
    compared_again(copied, options, methods=["gaussian"])
    assert timed == [["gaussian-0", "split-0"]]
    assert json.loads(path.read_text())["bundles"][split] == cell(copied, "split-0")["bundle"]
