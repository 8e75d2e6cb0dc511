"""Training: reproducible, bit-identical after resuming, and refuses files of another run."""

import shutil

import numpy as np
import pytest
import torch

from cvo_edge.errors import SinkError, UsageError
from cvo_export.datasets.motion import MAX_SPREAD_RAD
from cvo_export.networks.baselines.split import SplitConfig
from cvo_export.training import features
from cvo_export.training.features import ModelImages
from cvo_export.training.loop import train
from cvo_export.training.material import shared_folder
from cvo_export.training.run import load_run

from .conftest import DATASET, ignore_progress, tiny_config


def same_weights(first, second):
    a, b = first.graph.state_dict(), second.graph.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


class InterruptedTrainingError(Exception):
    pass


def stopping_after(calls, wanted):
    left = [calls]

    def progress(stage, done, total, note=""):
        if stage == wanted:
            left[0] -= 1
            if left[0] < 0:
                raise InterruptedTrainingError

    return progress


def test_the_same_seed_gives_the_same_weights(tiny_run, tmp_path):
    again = train(tmp_path / "again", tiny_config(), ignore_progress)
    assert same_weights(tiny_run, again)
    assert tiny_run.history == again.history


def test_training_lowers_the_score_on_val(tiny_run):
    scores = [entry.val_score for entry in tiny_run.history]
    assert min(scores) < 0.7 * scores[0]


def test_a_run_that_is_interrupted_three_times_ends_as_if_it_never_was(tiny_run, tmp_path):
    folder = tmp_path / "broken"
    for calls, wanted in ((1, "features"), (0, "training"), (17, "training")):
        with pytest.raises(InterruptedTrainingError):
            train(folder, tiny_config(), stopping_after(calls, wanted))
    resumed = train(folder, tiny_config(), ignore_progress)
    assert same_weights(tiny_run, resumed)
    assert tiny_run.history == resumed.history


def test_fine_tuning_is_resumable_and_changes_the_backbone(tmp_path):
    few = {"dataset": DATASET.replace("frames=40", "frames=20"), "steps": 30}
    config = tiny_config(fine_tune=1, **few)
    whole = train(tmp_path / "whole", config, ignore_progress)
    with pytest.raises(InterruptedTrainingError):
        train(tmp_path / "broken", config, stopping_after(3, "fine-tuning"))
    resumed = train(tmp_path / "broken", config, ignore_progress)
    assert same_weights(whole, resumed)
    frozen = train(tmp_path / "frozen", tiny_config(**few), ignore_progress)
    stem = "backbone.body.conv_stem.weight"
    assert not torch.equal(whole.graph.state_dict()[stem], frozen.graph.state_dict()[stem])


def test_a_run_folder_of_other_options_is_refused(tiny_run, run_dir):
    with pytest.raises(UsageError, match="found another run"):
        train(run_dir, tiny_config(seed=1), ignore_progress)


def test_a_full_disk_is_one_line_and_the_run_resumes(tmp_path, files_limited):
    folder, config = tmp_path / "run", tiny_config(steps=30)
    whole = train(tmp_path / "whole", config, ignore_progress)
    for limit, file in [
        (100, "split.json"),
        (100_000, r"features-0/\S*.npz"),
        (2_000_000, "checkpoint-cjp.pt"),
    ]:
        full = pytest.raises(SinkError, match=rf"{file}: cannot be written: File too large$")
        with files_limited(limit), full:
            train(folder, config, ignore_progress)
        assert not list(folder.rglob("*.partial"))
    assert same_weights(whole, train(folder, config, ignore_progress))
    (folder / "network.pt").unlink()
    full = pytest.raises(SinkError, match=r"network.pt: cannot be written: File too large$")
    with files_limited(100_000), full:
        train(folder, config, ignore_progress)
    assert not list(folder.rglob("*.partial"))


def test_arrays_are_stored_under_their_own_names_alone(tmp_path):
    features._store(tmp_path / "new" / "a.npz", {"poses": np.zeros((2, 7))})
    with np.load(tmp_path / "new" / "a.npz") as stored:
        assert stored.files == ["poses"]


def test_a_finished_run_is_read_back(tiny_run, run_dir):
    assert same_weights(tiny_run, load_run(run_dir))


def test_a_run_of_another_release_is_refused(tiny_run, run_dir, tmp_path):
    folder = shutil.copytree(run_dir, tmp_path / "run")
    stored = torch.load(folder / "network.pt", weights_only=True)
    stored["head"] = {f"old.{name}": values for name, values in stored["head"].items()}
    torch.save(stored, folder / "network.pt")
    with pytest.raises(UsageError, match="expected a network of this release"):
        load_run(folder)


@pytest.mark.parametrize(
    "other",
    [
        lambda stored: torch.zeros(3),
        lambda stored: None,
        lambda stored: [1, 2],
        lambda stored: stored["backbone"],
        lambda stored: {key: stored[key] for key in stored if key != "target"},
        lambda stored: {**stored, "target": stored["target"][:1]},
        lambda stored: {**stored, "target": [1, 2]},
        lambda stored: {**stored, "history": []},
        lambda stored: torch.nn.Linear(2, 2),
    ],
)
def test_a_network_file_of_another_kind_is_refused(tiny_run, run_dir, tmp_path, other):
    folder = shutil.copytree(run_dir, tmp_path / "run")
    stored = torch.load(folder / "network.pt", weights_only=True)
    torch.save(other(stored), folder / "network.pt")
    with pytest.raises(UsageError, match=r"network\.pt: expected a network of this release"):
        load_run(folder)


def test_an_unfinished_run_cannot_be_published(tmp_path):
    with pytest.raises(UsageError, match="finished run"):
        load_run(tmp_path)


@pytest.mark.parametrize("latent", ["codebook", "sample"])
def test_the_papers_choices_train(tmp_path, latent):
    config = tiny_config(steps=100)
    head = type(config.head)(latent_size=3, latent=latent, gate="literal", bounds="free")
    run = train(tmp_path / "run", tiny_config(steps=100, head=head), ignore_progress)
    assert np.isfinite(run.history[-1].loss)


def test_a_baseline_refuses_rotations_too_wide_for_one_chart(tmp_path):
    turning = "synthetic:room,flights=20,frames=20,size=64x48,turn=1"
    config = tiny_config(dataset=turning, head=SplitConfig())
    with pytest.raises(UsageError, match=f"within {MAX_SPREAD_RAD:g} rad of their mean for"):
        train(tmp_path / "run", config, ignore_progress)
    assert not (tmp_path / "run").exists()


def test_too_few_frames_of_val_to_decide_anything_are_refused(tmp_path):
    config = tiny_config(dataset="synthetic:room,flights=8,frames=10,size=64x48")
    with pytest.raises(UsageError, match="at least 9 frames of the role val"):
        train(tmp_path / "run", config, ignore_progress)
    assert not (tmp_path / "run").exists()


def test_features_of_other_pixels_are_not_shared(tiny_run, tmp_path):
    images = ModelImages(tiny_run.dataset, np.arange(20), 48, 64, "none")
    before = shared_folder(tmp_path, tiny_run.config, "w", images)
    assert shared_folder(tmp_path, tiny_run.config, "w", images) == before
    images.images[3, 2, 1] ^= 1
    assert shared_folder(tmp_path, tiny_run.config, "w", images) != before


def damaged(run_dir, folder, change):
    """A copy of a run that did not end, whose checkpoint is changed."""
    shutil.copytree(run_dir, folder)
    (folder / "network.pt").unlink()
    path = folder / "checkpoint-cjp.pt"
    state = torch.load(path, weights_only=True)
    torch.save(change({**state, "ended": False, "step": state["step"] // 2}), path)


@pytest.mark.parametrize(
    "change",
    [
        lambda state: torch.zeros(3),
        lambda state: {key: state[key] for key in state if key != "ended"},
        lambda state: {**state, "phase": "x"},
        lambda state: {**state, "phase": 7},
        lambda state: {**state, "step": "a"},
        lambda state: {**state, "torch_rng": torch.zeros(3, dtype=torch.uint8)},
        lambda state: {**state, "optimiser": {}},
        lambda state: {**state, "averaged": {}},
    ],
)
def test_a_checkpoint_of_another_kind_is_refused(tiny_run, run_dir, tmp_path, change):
    damaged(run_dir, tmp_path / "run", change)
    with pytest.raises(UsageError, match="expected a checkpoint of this version"):
        train(tmp_path / "run", tiny_run.config, ignore_progress)


def test_features_of_another_kind_are_made_anew(tmp_path):
    path = tmp_path / "a.npz"
    # numpy below 2.2 stores an argument that it does not know as an array of this name.
    arrays = {"features": np.zeros((2, 3)), "poses": np.zeros((2, 7))}
    np.savez(path, **arrays, allow_pickle=np.array(False))
    assert features._stored(path, 2).keys() == arrays.keys()
    for content in (b"", b"PK", path.read_bytes()[:100], b"\x80\x04N.", b"\x93NUMPY"):
        path.write_bytes(content)
        assert features._stored(path, 2) is None
    np.savez(path, features=np.zeros(()), poses=np.array(None, dtype=object))
    assert features._stored(path, 2) is None


def test_a_file_that_is_no_checkpoint_of_this_network_is_refused(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoint-cjp.pt").write_bytes(b"no checkpoint")
    with pytest.raises(UsageError, match="expected a checkpoint of this version"):
        train(tmp_path / "run", tiny_config(), ignore_progress)
