"""A study: each cell runs once, files may be moved, and the page is self-contained."""

import fcntl
import json
import re
import shutil

import numpy as np
import pytest

from cvo_edge.errors import UsageError
from cvo_export.cli import app
from cvo_export.data.noise import parse_noise
from cvo_export.data.splits import make_split, training_frames
from cvo_export.datasets import open_dataset
from cvo_export.evaluate import evaluate, find_level
from cvo_export.study import cells
from cvo_export.study.cells import CellFolder
from cvo_export.study.grid import expanded, plan_study, read_study, run_study
from cvo_export.study.report import page_template, write_report
from cvo_export.study.workers import run_tasks

from .conftest import ignore_progress

DATASET = "synthetic:room,flights=8,frames=20,size=64x48"
GRID = """
[[grids]]
data = ["$CVO_TEST_DATA"]
split = "random"
methods = ["cjp"]
backbones = ["test_efficientnet"]
weights = "none"
size = "64x48"
copies = 1
steps = 100
"""
CONFIG = f"""
title = "Tiny <study>"
{GRID}
name = "methods"
seeds = 2
noises = ["speckle:0.3"]
{GRID}
name = "sharpness"
seeds = 1
vary = {{ sharpness = [0.5, 1.0] }}
"""


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    """Folder, study, results, page and messages of a study."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "study.toml").write_text(CONFIG)
    said = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CVO_TEST_DATA", DATASET)
        study = read_study(folder / "study.toml")
        cell_folder = CellFolder(folder / "out", folder / "out" / "features")
        results = run_study(study, cell_folder, engine, ignore_progress, said.append)
        page = write_report(results, cell_folder, page_template())
    return cell_folder, study, results, page, said


def engine(tasks, ended):
    run_tasks(1, tasks, ended)


def test_a_cell_of_two_grids_is_run_once(studied):
    folder, _, results, _, said = studied
    # Sharpness 0.5 is the default, so this cell is seed 0 of the first grid.
    assert len(said) == 1 + 3  # one for the data set and one per cell
    assert len(results.cells) == len(list((folder.out / "cells").iterdir())) == 3
    assert len(results.places) == 4
    first, _, default, other = results.places
    assert (first.cell, default.varied) == (default.cell, {"sharpness": 0.5})
    assert other.cell != default.cell
    assert other.varied == {"sharpness": 1.0}


def test_a_finished_study_runs_nothing(studied, monkeypatch):
    folder, study, results, _, _ = studied
    monkeypatch.setenv("CVO_TEST_DATA", DATASET)
    monkeypatch.setattr(cells, "train", None)
    monkeypatch.setattr(cells, "evaluate", None)
    said = []
    again = run_study(study, folder, engine, ignore_progress, said.append)
    assert len(said) == 1
    assert again == results


def test_a_noise_that_is_new_is_evaluated_without_training(studied, monkeypatch, tmp_path):
    known, _, results, _, _ = studied
    folder = CellFolder(shutil.copytree(known.out, tmp_path / "out"), known.features)
    monkeypatch.setenv("CVO_TEST_DATA", DATASET)
    name = results.places[1].cell
    before = folder.cell(name).read_bytes()
    monkeypatch.setattr(cells, "train", None)
    text = CONFIG.replace('["speckle:0.3"]', '["speckle:0.3", "exposure"]').replace(
        "seeds = 2", "seeds = 1"
    )
    (tmp_path / "study.toml").write_text(text)
    grown = run_study(
        read_study(tmp_path / "study.toml"), folder, engine, ignore_progress, [].append
    )
    assert set(grown.cells[results.places[0].cell].noise) == {"speckle:0.3", "exposure:-2.0"}
    assert folder.cell(name).read_bytes() == before


def test_a_cell_that_is_made_again_keeps_its_training_time(studied, monkeypatch, tmp_path):
    known, _, results, _, _ = studied
    folder = CellFolder(shutil.copytree(known.out, tmp_path / "out"), known.features)
    monkeypatch.setenv("CVO_TEST_DATA", DATASET)
    name = results.places[0].cell
    folder.cell(name).unlink()
    shutil.rmtree(folder.bundle(name))
    (tmp_path / "study.toml").write_text(CONFIG)
    study = read_study(tmp_path / "study.toml")
    again = run_study(study, folder, engine, ignore_progress, [].append).cells[name]
    assert again.training is not None
    assert again.training == results.cells[name].training
    assert again.bundle == results.cells[name].bundle


def test_cells_of_other_data_are_refused(studied, monkeypatch):
    folder, study, _, _, _ = studied
    monkeypatch.setenv("CVO_TEST_DATA", DATASET.replace("flights=", "seed=7,flights="))
    with pytest.raises(UsageError, match=r"cells/.*: expected a cell of synthetic:"):
        run_study(study, folder, engine, ignore_progress, [].append)


def test_a_folder_is_filled_by_one_program_at_a_time(studied, monkeypatch):
    folder, study, _, _, _ = studied
    monkeypatch.setenv("CVO_TEST_DATA", DATASET)
    with (folder.out / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match="another program is running cells"):
            run_study(study, folder, engine, ignore_progress, [].append)


@pytest.mark.parametrize("content", [b'{"method": "\xff"}', b"{}", b"[" * 5000])
def test_a_damaged_cell_is_named(studied, monkeypatch, tmp_path, content):
    known, study, results, _, _ = studied
    folder = CellFolder(shutil.copytree(known.out, tmp_path / "out"), known.features)
    monkeypatch.setenv("CVO_TEST_DATA", DATASET)
    damaged = folder.cell(results.places[0].cell)
    damaged.write_bytes(content)
    with pytest.raises(UsageError) as caught:
        run_study(study, folder, engine, ignore_progress, [].append)
    assert str(caught.value).startswith(f"{damaged}: expected the figures of a cell, found ")
    assert "\n" not in str(caught.value)


def test_fine_tuning_is_part_of_the_training_time(monkeypatch):
    now = iter([0.0, 10.0, 25.0, 30.0])
    monkeypatch.setattr(cells, "process_time", lambda: next(now))
    monkeypatch.setattr(cells, "perf_counter", lambda: 0.0)
    clock = cells._Clock()
    clock("features", 2, 2)
    # Features of the fine-tuned backbone.
    clock("features", 2, 2)
    assert clock.seconds().processor == 25.0 - 10.0


def test_a_cell_holds_what_evaluate_says_of_its_bundle(studied):
    folder, _, results, _, _ = studied
    place = results.places[1]
    found, dataset = results.cells[place.cell], open_dataset(DATASET)
    report = evaluate(folder.bundle(place.cell), dataset, "test")
    marginal = find_level(report["levels"], 0.9, "marginal")
    assert found.marginal.coverage == marginal["coverage"]
    assert found.adaptiveness == marginal["adaptiveness"]
    noise = parse_noise("speckle:0.3")
    noisy = evaluate(folder.bundle(place.cell), dataset, "test", noise=noise)
    figures = found.noise[str(noise)]
    for level, kept in ((noisy, figures.clean), (noisy["recalibrated"], figures.recalibrated)):
        assert find_level(level["levels"], 0.9, "marginal")["coverage"] == kept.coverage
    assert figures.point_error == noisy["point_error"]


def test_results_hold_no_path_and_a_page_needs_no_other_file(studied):
    folder, _, results, page, _ = studied
    text = (folder.out / "results.json").read_text()
    html = page.read_text()
    for written in (text, html):
        assert str(folder.out.parent) not in written
    assert json.loads(text)["cells"].keys() == results.cells.keys()
    assert "Tiny &lt;study&gt;" in html
    sources = re.findall(r'(?:src|href)="([^"]{0,30})', html)
    assert sources
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    pictures = sorted(path.name.split("-")[0] for path in (folder.out / "pictures").iterdir())
    assert pictures == ["curves", "sets", "tube"]
    assert len(sources) == len(pictures)
    score = results.cells[results.places[0].cell].marginal.normalised_interval_score
    assert f"{score:.3f}" in html


def test_names_of_cells_depend_on_no_place(studied, monkeypatch, tmp_path):
    _, study, results, _, _ = studied
    monkeypatch.setenv("CVO_TEST_DATA", DATASET + ",seed=0")
    names = []

    def said_only(tasks, ended):
        names.extend(tasks)
        raise InterruptedError

    with pytest.raises(InterruptedError):
        run_study(study, CellFolder(tmp_path, tmp_path), said_only, ignore_progress, [].append)
    assert set(names) == set(results.cells)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("title = 1", "not a valid study"),
        (CONFIG.replace("steps", "stepz"), "unknown field `stepz`"),
        (CONFIG.replace('"sharpness"', '"METHODS"'), "grid names must differ"),
        (CONFIG.replace("sharpness = [0.5", "stages = [4"), "stages: expected text, found 4"),
        (CONFIG.replace("sharpness = [0.5, 1.0]", "grid = [3]"), "grid: expected text, found 3"),
        (CONFIG.replace("sharpness = [0.5", 'share = ["half"'), "share: expected above 0"),
        (CONFIG.replace("sharpness = [0.5", "share = [0.0"), "share: expected above 0"),
        (CONFIG.replace("sharpness = [0.5", "share = [nan"), "share: expected above 0"),
        (
            CONFIG.replace("sharpness = [0.5, 1.0]", "share = [1, 1.0]"),
            "share: expected each value",
        ),
        (CONFIG.replace("sharpness = [0.5", "kl_weight = [inf"), "expected a finite number"),
        (CONFIG.replace("sharpness = [0.5", "dropout = [2.0"), "grid sharpness: .*dropout"),
        (CONFIG.replace('["cjp"]', '["cjp", "cjp"]'), "methods: expected each value once"),
        (CONFIG.replace('"none"', '"/nowhere.safetensors"'), "expected a safetensors file"),
        (CONFIG.replace("test_efficientnet", "a/b"), "expected a timm model"),
        (CONFIG.replace("$CVO_TEST_DATA", DATASET.split(",")[0] + ",flights=1,frames=20"), "val"),
        (CONFIG.replace("speckle:0.3", "rain"), "expected NAME or NAME:STRENGTH"),
        (CONFIG.replace('["cjp"]', '["abc"]'), "expected one of cjp"),
        (CONFIG.replace("sharpness = [0.5", "classes = [4"), "--classes is not an option of cjp"),
        (CONFIG.replace("CVO_TEST_DATA", "CVO_UNSET"), "variable CVO_UNSET is not set"),
        ("grids = [", "not a valid study"),
    ],
)
def test_a_study_that_cannot_be_is_refused_before_anything(text, message, tmp_path, monkeypatch):
    monkeypatch.setenv("CVO_TEST_DATA", DATASET)
    (tmp_path / "study.toml").write_text(text)
    with pytest.raises(UsageError, match=message) as caught:
        app(["study", str(tmp_path / "study.toml"), str(tmp_path / "out")], standalone_mode=False)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_a_missing_configuration_is_said(tmp_path):
    with pytest.raises(UsageError, match="cannot be read: No such file"):
        read_study(tmp_path / "none.toml")


def test_two_data_sets_of_one_name_are_told_apart(monkeypatch, tmp_path):
    monkeypatch.setenv("CVO_TEST_DATA", DATASET)
    other = f"{DATASET},seed=1"
    text = CONFIG.replace('data = ["$CVO_TEST_DATA"]', f'data = ["$CVO_TEST_DATA", "{other}"]')
    (tmp_path / "study.toml").write_text(text)
    names = []

    def only_named(tasks, ended):
        names.extend(tasks)
        raise InterruptedError

    folder = CellFolder(tmp_path / "out", tmp_path / "out")
    with pytest.raises(InterruptedError):
        run_study(
            read_study(tmp_path / "study.toml"), folder, only_named, ignore_progress, [].append
        )
    assert len(names) == 6


def planned(text, folder, monkeypatch):
    """The plan of a study that has not run."""
    monkeypatch.setenv("CVO_TEST_DATA", DATASET)
    (folder / "study.toml").write_text(text)
    return plan_study(read_study(folder / "study.toml"))


def test_labels_tell_data_sets_of_one_name_apart(monkeypatch, tmp_path):
    other = f"{DATASET},seed=1"
    text = CONFIG.replace('data = ["$CVO_TEST_DATA"]', f'data = ["$CVO_TEST_DATA", "{other}"]')
    plan = planned(text, tmp_path, monkeypatch)
    name = open_dataset(DATASET).name
    assert plan.labels == {
        "$CVO_TEST_DATA": f"{name} ($CVO_TEST_DATA)",
        other: f"{name} ({other})",
    }
    assert {place.data for place in plan.places} == set(plan.labels.values())


def test_variables_are_replaced(monkeypatch):
    monkeypatch.setenv("CVO_TEST_DATA", "place")
    assert expanded("7scenes:$CVO_TEST_DATA/a") == expanded("7scenes:${CVO_TEST_DATA}/a")
    assert expanded("7scenes:$CVO_TEST_DATA/a") == "7scenes:place/a"


@pytest.mark.parametrize("kind", ["random", "block", "sequence"])
def test_a_share_of_the_training_frames_is_a_part_of_a_larger_one(kind):
    dataset = open_dataset("synthetic:room,flights=20,frames=40,size=64x48")
    split = make_split(dataset, kind, 3)
    everything = training_frames(dataset, split, 1.0)
    half, quarter = (training_frames(dataset, split, share) for share in (0.5, 0.25))
    for role, (all_of_it, larger, smaller) in enumerate(
        zip(everything, half, quarter, strict=True)
    ):
        assert set(smaller) <= set(larger) <= set(all_of_it), role
        assert 0 < smaller.size < larger.size < all_of_it.size or kind != "random"
        assert (np.diff(larger) > 0).all()
        if kind == "sequence":
            used = np.unique(dataset.sequence[larger])
            whole = all_of_it[np.isin(dataset.sequence[all_of_it], used)]
            assert larger.tolist() == whole.tolist()


@pytest.mark.parametrize(("name", "cells"), [("small", 10), ("full", 62)])
def test_the_configurations_that_come_with_the_project_can_be(name, cells, request, monkeypatch):
    """Methods, options, noises and names are valid for data with as many sequences."""
    monkeypatch.setenv("CVO_DATA", "of-another-place")
    monkeypatch.setenv("CVO_WEIGHTS", "of-another-place")
    study = read_study(request.config.rootpath / "bench" / "study" / f"{name}.toml")
    stand_in = open_dataset("synthetic:room,flights=20,frames=10,size=64x48")
    monkeypatch.setattr("cvo_export.training.configure.open_dataset", lambda _: stand_in)
    monkeypatch.setattr("cvo_export.study.grid.open_dataset", lambda _: stand_in)
    assert len(plan_study(study).configs) == cells
