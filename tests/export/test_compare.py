"""The comparison: every cell once, the same figures whoever runs it, and what is refused."""

import json
import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from cvo_edge.errors import CvoError, SinkError, UsageError
from cvo_export.cli import app
from cvo_export.datasets import open_dataset
from cvo_export.evaluate import evaluate, find_level
from cvo_export.networks.backbone import Backbone, BackboneConfig
from cvo_export.study import cells, frame_times
from cvo_export.study.compare import compare
from cvo_export.training.run import load_run

from .conftest import DATASET, ignore_progress

METHODS = ["split", "gaussian"]


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    """Arguments of ``configure``; weights of a file, as only features of such are shared."""
    path = tmp_path_factory.mktemp("weights") / "weights.safetensors"
    torch.manual_seed(5)
    body = Backbone(BackboneConfig(stages=("8",), grid=(3, 4)), 48, 64).body
    save_file(body.state_dict(), path)
    return {
        "dataset": DATASET,
        "split": "random",
        "size": "64x48",
        "crop": "none",
        "backbone": "mobilenetv2_100",
        "weights": str(path),
        "stages": "8",
        "grid": "3x4",
        "normalisation": None,
        "copies": 1,
        "steps": 100,
    }


def compared_again(out, options, **changes):
    said = []
    values = {"jobs": 1, "cache": None, "progress": ignore_progress, "say": said.append}
    methods, seeds = changes.pop("methods", METHODS), changes.pop("seeds", 2)
    lines = compare(out, options, methods, seeds, **{**values, **changes})
    return lines, said


@pytest.fixture(scope="module")
def compared(options, tmp_path_factory):
    """Seed 0 in this process, seed 1 in two others; and what was said of them."""
    out = tmp_path_factory.mktemp("compare") / "out"
    _, first = compared_again(out, options, seeds=1)
    lines, second = compared_again(out, options, jobs=2)
    return out, lines, (first, second)


@pytest.fixture
def copied(compared, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(compared[0], tmp_path / "out")


def cell(out, name):
    return json.loads((out / "cells" / f"{name}.json").read_text())


def test_every_cell_is_run_once_and_said(compared):
    out, _, (first, second) = compared
    names = [f"{method}-{seed}" for method in METHODS for seed in (0, 1)]
    assert sorted(path.stem for path in (out / "cells").iterdir()) == sorted(names)
    assert [line.split(":")[0] for line in first] == ["split-0", "gaussian-0"]
    assert sorted(line.split(":")[0] for line in second) == ["gaussian-1", "split-1"]
    assert all(line.endswith(f"({i} of 2)") for i, line in enumerate(first, 1))
    # One folder of features a seed, none in a run.
    assert len(list((out / "features").iterdir())) == 2
    assert not list((out / "runs").glob("*/features*"))


def test_a_cell_holds_what_evaluate_says_of_its_bundle(compared):
    out, _, _ = compared
    report = evaluate(out / "bundles" / "gaussian-1", open_dataset(DATASET), "test")
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
    graph = load_run(out / "runs" / "gaussian-1").graph
    assert found["graph_parameters"] == sum(p.numel() for p in graph.parameters())
    behind = found["graph_parameters"] - found["head_parameters"]
    assert behind == sum(p.numel() for p in graph.backbone.parameters())
    model = out / "bundles" / "gaussian-1" / "model.onnx"
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


def test_the_report_holds_every_figure_and_no_path(compared, options):
    out, _, _ = compared
    text = (out / "compare.json").read_text()
    report = json.loads(text)
    names = [f"{method}-{seed}" for method in METHODS for seed in (0, 1)]
    assert report["cells"] == [cell(out, name) for name in names]
    assert report["timing"] == json.loads((out / "timing.json").read_text())
    assert set(report["timing"]["ms"]) == set(METHODS)
    assert report["options"]["steps"] == 100
    assert report["heads"]["gaussian"]["method"] == "gaussian"
    assert report["timing"]["environment"]["cores_allowed"] >= 1
    assert options["weights"] not in text
    assert str(out.parent) not in text


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
    (copied / "cells" / "gaussian-1.json").unlink()
    shutil.rmtree(copied / "runs" / "gaussian-1")
    _, said = compared_again(copied, options)
    assert [line.split(":")[0] for line in said] == ["gaussian-1"]
    after = cell(copied, "gaussian-1")
    assert {**after, "training": None} == {**before, "training": None}


def test_a_failed_cell_is_named_and_the_others_are_run(copied, options):
    for method in METHODS:
        (copied / "cells" / f"{method}-0.json").unlink()
    (copied / "bundles" / "split-0" / "precious.txt").write_text("keep")
    said = []
    with pytest.raises(SinkError, match="expected 2 more cells, found 1; failed: split-0"):
        compared_again(copied, options, say=said.append)
    assert said[0].startswith("split-0: failed: ")
    assert said[1].startswith("gaussian-0: score ")
    # Its training was there already, so that this time nobody has measured it.
    assert cell(copied, "gaussian-0")["training"] is None
    assert not (copied / "cells" / "split-0.json").exists()


def test_cells_of_other_options_are_refused_by_name(copied, options):
    with pytest.raises(UsageError, match="others: gaussian-0, gaussian-1, split-0, split-1"):
        compared_again(copied, {**options, "steps": 101})
    other = cell(copied, "split-0")
    path = copied / "cells" / "split-0.json"
    path.write_text(json.dumps({**other, "options": "0" * 64}))
    with pytest.raises(UsageError, match=r"found others: split-0$"):
        compared_again(copied, options, methods=["gaussian"])
    path.write_text(json.dumps({**other, "more": 1}))
    with pytest.raises(UsageError, match="expected the figures of a cell"):
        compared_again(copied, options)


def test_an_unknown_method_is_refused_before_anything(tmp_path):
    command = ["compare", DATASET, str(tmp_path / "out"), "--weights", "none"]
    with pytest.raises(CvoError, match=r"expected one of cjp, .*split, found other") as caught:
        app([*command, "--methods", "split,other"], standalone_mode=False)
    assert caught.value.exit_code == 2
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_one_is_refused(tmp_path, options):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(SinkError, match="cannot be written"):
        compared_again(tmp_path / "out", options)


def test_bundles_are_timed_again_when_one_has_changed(copied, options, monkeypatch):
    path = copied / "timing.json"
    timing = json.loads(path.read_text())
    timing["bundles"]["split"] = "0" * 64
    path.write_text(json.dumps(timing))
    timed = []

    def frame_ms(bundles, dataset):
        timed.append(sorted(folder.name for folder in bundles.values()))
        return {method: {"p50": 1.25, "p95": 2.5} for method in bundles}

    monkeypatch.setattr(frame_times, "frame_ms", frame_ms)
    for _ in range(2):
        lines, _ = compared_again(copied, options)
        assert sum("1.25 (2.50)" in line for line in lines) == 2
    compared_again(copied, options, methods=["gaussian"])
    assert timed == [["gaussian-0", "split-0"]]
    assert json.loads(path.read_text())["bundles"]["split"] == cell(copied, "split-0")["bundle"]
