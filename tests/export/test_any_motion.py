"""Recordings that turn round, and degrees of freedom that stand still, from training to sets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cvo_edge import Odometer, read_bundle
from cvo_export.datasets import open_dataset
from cvo_export.evaluate import evaluate, find_level, table
from cvo_export.networks.heads.cjp import CjpConfig
from cvo_export.networks.heads.cqr import CqrConfig
from cvo_export.networks.heads.csp import CspConfig
from cvo_export.networks.heads.mcqr import McqrConfig
from cvo_export.networks.standardised import fit_target
from cvo_export.publish import publish
from cvo_export.training.loop import train
from cvo_export.training.run import load_run

from .conftest import ignore_progress, tiny_config

_ROBOT = "synthetic:room,flights=8,frames=40,size=64x48,turn=1,still=z+pitch+roll"
_FEW = "synthetic:room,flights=6,frames=30,size=64x48,turn=1,still=z+pitch+roll"


def _bundle(folder: Path, head: Any) -> Path:
    run = train(
        folder / "run", tiny_config(dataset=_ROBOT, head=head, copies=1, steps=120), ignore_progress
    )
    assert run.target.turns
    publish(run, folder / "bundle", "robot")
    return folder / "bundle"


def test_a_wheeled_robot_that_turns_round_gets_sets_that_hold(tmp_path: Path) -> None:
    bundle = _bundle(tmp_path, CjpConfig())
    pose = read_bundle(bundle).calibration.pose
    assert pose.still == ("tz", "rx", "rz")
    assert (pose.rotation, pose.reference_q_xyzw) == ("tangent_predicted", None)
    assert pose.limits.highest[2] - pose.limits.lowest[2] < 0.1
    assert pose.limits.highest[4] == pytest.approx(np.pi)
    dataset = open_dataset(_ROBOT)
    with Odometer.load(bundle) as odometer:
        estimate = odometer.step(dataset.read_image(0))
    assert (estimate.lower[3:] < 0).all()
    assert (estimate.upper[3:] > 0).all()
    report = evaluate(bundle, dataset, "test")
    level = find_level(report["levels"], 0.9, "marginal")
    # 64 frames of cal and of test: the 99.9 % band of the coverage reaches down to .70.
    assert min(level["coverage"]) > 0.7
    moving = [0, 1, 4]
    score = np.array(level["interval_score"]) / pose.standard_deviation
    assert level["normalised_interval_score"] == pytest.approx(score[moving].mean())
    assert "tz rx rz hardly moved in training" in "\n".join(table(report))


@pytest.mark.parametrize(
    "head",
    [CqrConfig(trees=5), CspConfig(classes=8, label_sigma=4.0), McqrConfig(rays=8, directions=8)],
)
@pytest.mark.usefixtures("small_backbone")
def test_other_methods_learn_full_turns_and_are_restored(tmp_path: Path, head: Any) -> None:
    config = tiny_config(dataset=_FEW, head=head, steps=6, copies=1)
    run = train(tmp_path / "run", config, ignore_progress)
    assert run.target.turns
    restored = load_run(tmp_path / "run")
    state = run.graph.head.state_dict()
    assert all((restored.graph.head.state_dict()[name] == state[name]).all() for name in state)


def test_a_recording_that_turns_outside_training_is_learned_for_any_rotation():
    poses = np.zeros((40, 7))
    angle = np.linspace(0.0, 1.5 * np.pi, 40)
    poses[:, 5], poses[:, 6] = np.sin(angle / 2), np.cos(angle / 2)
    assert not fit_target(poses[:10]).turns
    assert fit_target(poses[:10], poses).turns
