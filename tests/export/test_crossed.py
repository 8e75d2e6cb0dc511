"""Crossed calibration: every recording trains and calibrates, and no head scores its own."""

import msgspec
import numpy as np
import pytest
import torch

from cvo_edge.bundle.format import CONFIDENCES
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.bundle.rules import check_rules
from cvo_edge.conformal import conformal_quantile
from cvo_edge.errors import CalibrationFileError, UsageError
from cvo_edge.input import preprocess
from cvo_edge.programs.inspect import inspect_lines
from cvo_export.calibrate import calibrate
from cvo_export.data.noise import parse_noise
from cvo_export.datasets import synthetic
from cvo_export.evaluate import evaluate, table
from cvo_export.networks.heads.scr import ScrConfig
from cvo_export.publish import publish
from cvo_export.training.loop import train
from cvo_export.training.run import PoseGraph, load_run

from .conftest import ignore_progress, thumbnails, tiny_config
from .test_train import InterruptedTrainingError, stopping_after

FOLDS, STEPS = 2, 12


@pytest.fixture(scope="module", autouse=True)
def _small_backbone():
    with thumbnails():
        yield


FLIGHTS = "synthetic:room,flights=8,frames=12,size=64x48"


def config(**changes):
    few = {"dataset": FLIGHTS, "split": "sequence", "folds": FOLDS, "copies": 1, "steps": STEPS}
    return tiny_config(**{**few, **changes})


@pytest.fixture(scope="module")
def crossed_dir(tmp_path_factory):
    return tmp_path_factory.mktemp("crossed") / "run"


@pytest.fixture(scope="module")
def run(crossed_dir):
    return train(crossed_dir, config(), ignore_progress)


@pytest.fixture(scope="module")
def bundle(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("crossed") / "bundle"
    publish(run, folder, "crossed", rule="pooled", score="additive")
    return folder


def equal(first, second):
    a, b = first.state_dict(), second.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_each_recording_of_train_fit_and_cal_is_whole_in_one_fold(run):
    roles = run.split.roles
    dealt = np.sort(np.concatenate(run.fold_frames))
    expected = np.sort(np.concatenate([roles[role] for role in ("train", "fit", "cal")]))
    assert dealt.tolist() == expected.tolist() == sorted(run.training_frames.tolist())
    first, second = (set(run.dataset.sequence[fold].tolist()) for fold in run.fold_frames)
    assert first
    assert second
    assert not first & second


def test_what_a_folds_recordings_show_has_no_part_in_its_head(run, tmp_path, monkeypatch):
    photograph = synthetic.Flight.photograph
    of_fold = set(run.dataset.sequence[run.fold_frames[1]].tolist())

    def negative(flight, *wanted):
        image = photograph(flight, *wanted)
        return 255 - image if flight._entropy[1] in of_fold else image

    monkeypatch.setattr(synthetic.Flight, "photograph", negative)
    other = train(tmp_path / "run", config(), ignore_progress)
    assert equal(run.folds[1], other.folds[1])
    assert not equal(run.folds[0], other.folds[0])
    assert not equal(run.graph.head, other.graph.head)


def scores_by_hand(run, head, indices):
    """Additive scores (n, 6) of frames, by torch alone."""
    graph = PoseGraph(run.graph.backbone, head).eval()
    images = [
        preprocess.model_input(run.dataset.read_image(index), 48, 64, "none")
        for index in indices.tolist()
    ]
    with torch.no_grad():
        _, lower, upper = graph(torch.from_numpy(np.concatenate(images)))
    truth = run.target.coordinates(run.dataset.poses[indices])
    return np.maximum(lower.double().numpy() - truth, truth - upper.double().numpy())


def test_thresholds_come_from_the_graphs_that_never_saw_the_recordings(run, bundle):
    scores = np.concatenate(
        [
            scores_by_hand(run, head, indices)
            for head, indices in zip(run.folds, run.fold_frames, strict=True)
        ]
    )
    calibration = read_calibration(bundle)
    for confidence in CONFIDENCES:
        stored = calibration.threshold(confidence, "marginal").q_hat
        expected = [conformal_quantile(scores[:, dof], confidence) for dof in range(6)]
        found = [np.inf if value is None else value for value in stored]
        assert found == pytest.approx(expected, abs=1e-4)
    of_all = scores_by_hand(run, run.graph.head, run.training_frames)
    by_its_own = [conformal_quantile(of_all[:, dof], 0.5) for dof in range(6)]
    assert calibration.threshold(0.5, "marginal").q_hat != pytest.approx(by_its_own, abs=1e-4)


def test_the_bundle_says_what_it_is_and_promises_no_more(run, bundle):
    calibration = read_calibration(bundle)
    source = calibration.calibration
    recordings = np.unique(run.dataset.sequence[run.training_frames]).size
    assert (source.crossed, source.n, source.n_sequences) == (
        FOLDS,
        run.training_frames.size,
        recordings,
    )
    shown = " ".join(" ".join(inspect_lines(calibration)).split())
    assert "this network was trained on all of them: its coverage is measured, not proven" in shown
    nothing = "nothing is proven: the network was trained on the recordings that calibrate it"
    assert f"at 0.5 marginal and joint: {nothing}" in shown
    report = evaluate(bundle, run.dataset, "test")
    assert "other_rule" not in report
    assert report["levels"][0]["statement"] == nothing
    noisy = evaluate(bundle, run.dataset, "test", noise=parse_noise("gaussian"))
    assert "recalibrated" not in noisy
    assert table(noisy)[-1].startswith("recalibrated: not for a crossed calibration")


def test_its_recordings_calibrate_nothing_else(run, bundle, tmp_path):
    with pytest.raises(UsageError, match="its crossed calibration, which trained it"):
        calibrate(bundle, run.dataset, tmp_path / "again", "again")


@pytest.mark.parametrize(
    ("source", "options", "found"),
    [
        ({"crossed": 7}, {"folds": 7}, "at most one fold for each of the 6 sequences, found 7"),
        ({"crossed": 3}, {}, "expected provenance.options.folds 3, found 2"),
        ({"dataset": "other", "split": None}, {}, "the split by sequence that the network was"),
    ],
)
def test_a_file_that_contradicts_its_folds_is_refused(bundle, source, options, found):
    calibration = read_calibration(bundle)
    if "split" in source:
        split = calibration.calibration.split
        source["split"] = msgspec.structs.replace(split, kind="random")
    provenance = msgspec.structs.replace(
        calibration.provenance, options={**calibration.provenance.options, **options}
    )
    changed = msgspec.structs.replace(
        calibration,
        calibration=msgspec.structs.replace(calibration.calibration, **source),
        provenance=provenance,
    )
    with pytest.raises(CalibrationFileError, match=found):
        check_rules(changed)


def test_an_interrupted_crossed_run_ends_as_if_it_never_was(run, tmp_path):
    folder = tmp_path / "broken"
    with pytest.raises(InterruptedTrainingError):
        train(folder, config(), stopping_after(2 * STEPS + 5, "training"))
    assert sorted(path.name for path in folder.glob("checkpoint-*")) == [
        "checkpoint-cjp.pt",
        "checkpoint-without0-cjp.pt",
        "checkpoint-without1-cjp.pt",
    ]
    resumed = train(folder, config(), ignore_progress)
    for found in (resumed, load_run(folder)):
        assert equal(run.graph, found.graph)
        assert all(map(equal, run.folds, found.folds))
    assert run.history == resumed.history
    assert run.best.lesson == "cjp"


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"split": "random"}, "folds: expected --split sequence, found random"),
        ({"head": ScrConfig()}, r"trains a head on features \(cjp, cqr, csp, mcqr, .*found scr"),
        ({"folds": 7}, "at most one for each of the 6 recordings .*, found 7"),
        ({"fine_tune": 1}, "expected a frozen backbone, .* found --fine-tune 1"),
    ],
)
def test_what_cannot_be_crossed_is_refused_before_anything_is_written(tmp_path, changes, found):
    with pytest.raises(UsageError, match=found):
        train(tmp_path / "run", config(**changes), ignore_progress)
    assert not (tmp_path / "run").exists()


def test_options_of_other_runs_are_written_as_before(tmp_path):
    assert b"folds" not in msgspec.json.encode(tiny_config())
    assert b'"folds":2' in msgspec.json.encode(config())
