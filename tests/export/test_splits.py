"""Splits: each frame has at most one role; gaps, shares, sequences and digests."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cvo_edge.errors import SourceError, UsageError
from cvo_export.data.splits import SHARES, deal_folds, default_kind, make_split, same_split
from cvo_export.datasets import PoseDataset

ROLES = tuple(SHARES["training"])


def dataset(lengths, own_train=(), own_test=(), prefix="f"):
    n = sum(lengths)
    sequence = np.repeat(np.arange(len(lengths)), lengths)
    return PoseDataset(
        name="made",
        poses=np.tile([0, 0, 0, 0, 0, 0, 1.0], (n, 1)),
        sequence=sequence,
        sequence_names=tuple(f"s{i}" for i in range(len(lengths))),
        frame_names=tuple(f"{prefix}{i}" for i in range(n)),
        read_image=lambda _: np.zeros((48, 64, 3), np.uint8),
        own_train=frozenset(own_train),
        own_test=frozenset(own_test),
    )


@settings(max_examples=40)
@given(
    st.lists(st.integers(60, 120), min_size=5, max_size=12),
    st.sampled_from(["random", "block", "sequence"]),
    st.integers(0, 10),
)
def test_no_frame_has_two_roles_and_every_role_has_frames(lengths, kind, seed):
    made = dataset(lengths)
    try:
        split = make_split(made, kind, seed)
    except UsageError:
        assert kind == "block"  # too few frames of a short recording may remain after the gaps
        return
    joined = np.concatenate([split.roles[role] for role in ROLES])
    assert len(set(joined.tolist())) == joined.size
    assert all(split.roles[role].size for role in ROLES)
    if kind == "random":
        assert joined.size == len(made)


def test_random_shares_are_exact_on_a_thousand_frames():
    split = make_split(dataset([1000]), "random", 0)
    assert [split.roles[role].size for role in ROLES] == [400, 100, 100, 200, 200]
    assert all(sum(shares.values()) == pytest.approx(1.0) for shares in SHARES.values())


@pytest.mark.parametrize("seed", range(5))
def test_block_leaves_fifteen_frames_between_roles(seed):
    split = make_split(dataset([1000]), "block", seed)
    role_of = np.full(1000, -1)
    for number, role in enumerate(ROLES):
        role_of[split.roles[role]] = number
    last_role, last_index = -1, -100
    for index in np.flatnonzero(role_of >= 0).tolist():
        if role_of[index] != last_role:
            assert index - last_index > 15
        last_role, last_index = role_of[index], index
    assert (role_of >= 0).sum() >= 600


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("length", [200, 300, 400, 600])
def test_block_keeps_three_fifths_of_short_recordings(length, seed):
    split = make_split(dataset([length]), "block", seed)
    assert sum(split.roles[role].size for role in ROLES) >= 0.6 * length
    assert min(split.roles[role].size for role in ROLES) >= 9
    assert split.blocks is not None
    # What the frames of different roles are apart is what the split says.
    role_of = {int(i): role for role in ROLES for i in split.roles[role]}
    kept = sorted(role_of)
    apart = [b - a - 1 for a, b in pairwise(kept) if role_of[a] != role_of[b]]
    assert min(apart) == split.blocks.gap
    assert (split.blocks.cost is None) == (split.blocks.gap == 15)


def test_long_recordings_have_the_usual_blocks():
    assert make_split(dataset([1000]), "block", 0).blocks == (20, 15)


def test_block_refuses_a_recording_that_would_not_survive():
    with pytest.raises(UsageError, match="too short"):
        make_split(dataset([40]), "block", 0)


def test_sequence_keeps_sequences_whole_and_respects_the_own_test_list():
    made = dataset([50] * 48, own_train=range(36), own_test=range(36, 48))
    split = make_split(made, "sequence", 1)
    by_role = {role: set(made.sequence[split.roles[role]].tolist()) for role in ROLES}
    assert by_role["test"] == set(range(36, 48))
    assert [len(by_role[role]) for role in ROLES] == [18, 4, 3, 11, 12]
    assert all(split.roles[role].size == 50 * len(by_role[role]) for role in ROLES)


def test_five_sequences_are_enough_for_the_five_roles():
    split = make_split(dataset([60] * 5), "sequence", 0)
    assert [split.roles[role].size for role in ROLES] == [60] * 5


def test_a_sequence_in_both_own_lists_is_test_alone():
    made = dataset([10] * 10, own_train=range(10), own_test=range(3))
    split = make_split(made, "sequence", 0)
    joined = np.concatenate([split.roles[role] for role in ROLES])
    assert len(set(joined.tolist())) == joined.size


def test_sequence_without_lists_gives_enough_calibration_sequences():
    made = dataset([10] * 48)
    split = make_split(made, "sequence", 0)
    assert len(set(made.sequence[split.roles["cal"]].tolist())) >= 11


def test_too_few_sequences_name_the_empty_role():
    with pytest.raises(UsageError, match="found none for"):
        make_split(dataset([50] * 3), "sequence", 0)
    assert default_kind(dataset([50] * 3)) == "block"
    assert default_kind(dataset([50] * 5)) == "sequence"


@pytest.mark.parametrize("kind", ["random", "block", "sequence"])
def test_the_same_seed_gives_the_same_split_and_another_another(kind):
    made = dataset([150] * 8)
    first, again, other = (make_split(made, kind, seed) for seed in (3, 3, 4))
    assert first.digest(made) == again.digest(made) != other.digest(made)
    assert same_split(made, first.spec(made)).kind == kind


def test_another_data_set_is_not_taken_for_the_recorded_one():
    made, renamed = dataset([1000]), dataset([1000], prefix="g")
    recorded = make_split(made, "random", 0).spec(made)
    with pytest.raises(SourceError, match="another data set"):
        same_split(renamed, recorded)


def test_the_same_names_with_other_poses_are_another_data_set():
    made = dataset([1000])
    moved = replace(made, poses=made.poses + 1e-3)
    with pytest.raises(SourceError, match="another data set"):
        same_split(moved, make_split(made, "random", 0).spec(made))


@pytest.mark.parametrize("kind", ["random", "block", "sequence"])
def test_for_calibration_a_data_sets_own_training_list_is_not_new(kind):
    made = dataset([200] * 10, own_train=range(4), own_test=range(4, 10))
    split = make_split(made, kind, 0, "calibration")
    used = np.concatenate(list(split.roles.values()))
    assert set(made.sequence[used].tolist()) <= set(range(4, 10))
    assert all(indices.size for indices in split.roles.values())
    assert default_kind(dataset([9] * 9, range(7), range(7, 9)), "calibration") == "block"


@pytest.mark.parametrize("kind", ["random", "block", "sequence"])
def test_for_calibration_no_frame_is_spent_on_training(kind):
    made = dataset([100] * 10)
    split = make_split(made, kind, 0, "calibration")
    assert set(split.roles) == {"val", "cal", "test"}
    joined = np.concatenate(list(split.roles.values()))
    assert len(set(joined.tolist())) == joined.size
    assert split.roles["cal"].size > 0.5 * joined.size
    assert same_split(made, split.spec(made)).roles["cal"].tolist() == split.roles["cal"].tolist()


@pytest.mark.parametrize("kind", ["random", "block", "sequence"])
def test_folds_hold_every_training_frame_once_and_keep_units_whole(kind):
    made = dataset([120] * 10)
    split = make_split(made, kind, 0)
    indices = np.concatenate([split.roles["train"], split.roles["fit"]])
    folds = deal_folds(made, split, indices, 3)
    assert sorted(np.concatenate(folds).tolist()) == list(range(indices.size))
    assert all(fold.size for fold in folds)
    if kind != "random":
        of = [set(made.sequence[indices[fold]].tolist()) for fold in folds]
        assert sum(map(len, of)) == len(set.union(*of))


def test_folds_of_one_recording_are_runs_of_frames():
    made = dataset([1000])
    split = make_split(made, "block", 0)
    indices = np.concatenate([split.roles["train"], split.roles["fit"]])
    for fold in deal_folds(made, split, indices, 3):
        frames = np.sort(indices[fold])
        # A fold consists of few runs of consecutive frames.
        assert (np.diff(frames) > 1).sum() < 0.1 * frames.size
