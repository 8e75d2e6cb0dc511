"""From run to bundle: parity, thresholds through the runtime, atomic writing."""

import copy
import dataclasses
import json

import msgspec
import numpy as np
import pytest
import torch
from torch import nn

from cvo_edge import Odometer, SinkError, SourceError
from cvo_edge.bundle.format import CONFIDENCES
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.conformal import conformal_quantile
from cvo_edge.engine.loading import read_bundle
from cvo_edge.engine.selftest import check_selftest
from cvo_edge.engine.session import Session
from cvo_edge.errors import GateError
from cvo_edge.pose import about
from cvo_export.bundles.observed import observe
from cvo_export.graph.to_onnx import check_parity, export_onnx
from cvo_export.networks.heads.cjp import CjpConfig, CjpLearner, CjpNetwork, CjpPrediction
from cvo_export.networks.standardised import Target
from cvo_export.publish import publish
from cvo_export.training import run as runs
from cvo_export.training.loop import train

from .conftest import ignore_progress, tiny_config


def test_a_fresh_bundle_passes_its_own_self_test(tiny_bundle):
    with Odometer.load(tiny_bundle) as odometer:
        assert check_selftest(odometer) < odometer.calibration.selftest.tolerance


def test_thresholds_are_order_statistics_of_the_runtimes_scores(tiny_bundle, tiny_run):
    with Odometer.load(tiny_bundle) as odometer:
        seen = observe(odometer, tiny_run.dataset, tiny_run.split.roles["cal"])
        scores = odometer.head.scores(seen.outputs, seen.point, seen.truth)
        for confidence in CONFIDENCES:
            stored = odometer.calibration.threshold(confidence, "marginal").q_hat
            for dof in range(6):
                expected = conformal_quantile(scores[:, 0, dof], confidence)
                assert stored[dof] == (expected if np.isfinite(expected) else None)


def test_too_few_frames_are_unbounded_not_the_maximum(tiny_bundle):
    calibration = read_calibration(tiny_bundle)
    assert calibration.calibration.n == 64
    assert calibration.threshold(0.99, "marginal").q_hat == (None,) * 6
    assert calibration.threshold(0.99, "joint").q_hat == (None,) * 6
    assert None not in calibration.threshold(0.95, "marginal").q_hat


def test_both_scopes_and_all_confidences_are_stored(tiny_bundle):
    calibration = read_calibration(tiny_bundle)
    for scope in ("marginal", "joint"):
        assert calibration.confidences(scope) == CONFIDENCES


def test_nothing_but_two_files_and_no_path_in_them(tiny_bundle, tiny_run):
    assert sorted(path.name for path in tiny_bundle.iterdir()) == ["calibration.json", "model.onnx"]
    for path in tiny_bundle.iterdir():
        content = path.read_bytes()
        assert b"/home/" not in content
        assert b"site-packages" not in content
    assert "/" not in json.dumps(msgspec.to_builtins(read_calibration(tiny_bundle).provenance))


def test_torch_and_the_graph_agree_and_another_graph_does_not(tiny_bundle, tiny_run):
    session, outputs = (
        Session(read_bundle(tiny_bundle).model_bytes),
        tiny_run.graph.head.output_names,
    )
    image = np.random.default_rng(0).integers(0, 255, (1, 48, 64, 3)).astype(np.uint8)
    assert check_parity(tiny_run.graph, session, [{"image": image}], ["image"], outputs) < 1e-4
    other = copy.deepcopy(tiny_run.graph)
    other.head.decoder.mean += 1.0
    with pytest.raises(GateError, match="agree"):
        check_parity(other, session, [{"image": image}], ["image"], outputs)


class _Scaled(nn.Module):
    """x -> (scale x,): a graph with one output."""

    def __init__(self, scale: float | list[float]) -> None:
        super().__init__()
        self.register_buffer("scale", torch.tensor(scale))

    def forward(self, x):
        return (self.scale * x,)


@pytest.mark.parametrize("size", [1.0, 1000.0])
def test_parity_is_relative_to_numbers_above_one(size):
    session = Session(export_onnx(_Scaled(size), [torch.ones((1, 1))], ["x"], ["y"]))
    feed = {"x": np.ones((1, 1), np.float32)}

    def difference(part: float) -> float:
        return check_parity(_Scaled(size * (1.0 + part)), session, [feed], ["x"], ["y"])

    assert difference(5e-5) == pytest.approx(5e-5, rel=0.01)
    for wrong in (2e-4, np.nan, np.inf):
        with pytest.raises(GateError, match="agree"):
            difference(wrong)


def test_a_large_number_excuses_no_error_of_a_small_one_beside_it():
    """A pose holds metres and a quaternion: 500 m away, the rotation must still agree."""
    feed = {"x": np.array([[500.0, 1.0]], np.float32)}
    session = Session(export_onnx(_Scaled([1.0, 1.0]), [torch.ones((1, 2))], ["x"], ["y"]))
    assert check_parity(_Scaled([1.0 + 5e-5, 1.0]), session, [feed], ["x"], ["y"]) < 1e-4
    with pytest.raises(GateError, match="agree"):
        check_parity(_Scaled([1.0, 1.0 + 2e-4]), session, [feed], ["x"], ["y"])


def test_a_number_of_a_far_point_is_compared_with_the_distance_of_the_point():
    feed = {"x": np.array([[40.0, 1.0, 3.0]], np.float32)}
    session = Session(export_onnx(_Scaled([1.0] * 3), [torch.ones((1, 3))], ["x"], ["y"]))

    def difference(part: float) -> float:
        return check_parity(_Scaled([1.0, 1.0 + part, 1.0]), session, [feed], ["x"], ["y"], ["y"])

    assert difference(2e-3) == pytest.approx(2e-3 / np.sqrt(1610.0), rel=0.01)
    for wrong in (5e-3, np.nan, np.inf):
        with pytest.raises(GateError, match="agree"):
            difference(wrong)


def test_a_bundle_is_replaced_whole_and_anything_else_is_refused(tiny_run, tiny_bundle, tmp_path):
    target = tmp_path / "bundle"
    publish(tiny_run, target, "first")
    publish(tiny_run, target, "second", rule="hierarchical")
    assert read_calibration(target).name == "second"
    assert read_calibration(target).calibration.rule == "hierarchical"
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]
    other = tmp_path / "other"
    other.mkdir()
    (other / "precious.txt").write_text("keep")
    with pytest.raises(SinkError, match="expected a new folder"):
        publish(tiny_run, other, "third")
    assert [path.name for path in other.iterdir()] == ["precious.txt"]


@pytest.mark.usefixtures("small_backbone")
def test_sampled_latent_is_an_input_and_its_noise_a_function_of_the_frame(tmp_path):
    head = CjpConfig(latent_size=3, latent="sample")
    run = train(tmp_path / "run", tiny_config(steps=100, head=head), ignore_progress)
    publish(run, tmp_path / "bundle", "sampled")
    image = run.dataset.read_image(0)
    with Odometer.load(tmp_path / "bundle") as first, Odometer.load(tmp_path / "bundle") as again:
        assert [spec.name for spec in first.session.inputs] == ["image", "latent_noise"]
        a, b, c = first.step(image), first.step(image), again.step(image)
    np.testing.assert_array_equal(a.lower, c.lower)
    assert (a.lower != b.lower).any()


@pytest.mark.usefixtures("small_backbone")
def test_codebook_latent_needs_the_image_alone(tmp_path):
    head = CjpConfig(latent_size=3, latent="codebook")
    run = train(tmp_path / "run", tiny_config(steps=100, head=head), ignore_progress)
    publish(run, tmp_path / "bundle", "codebook")
    with Odometer.load(tmp_path / "bundle") as odometer:
        assert [spec.name for spec in odometer.session.inputs] == ["image"]


@pytest.mark.parametrize("latent", ["mean", "codebook"])
def test_several_members_answer_with_their_mean(latent):
    torch.manual_seed(0)
    config = CjpConfig(latent_size=4, hidden=(16, 8), members=3, latent=latent)
    network = CjpNetwork(20, config, 6).eval()
    features = torch.randn(5, 20)
    each = []
    for member in network.members:
        alone = CjpNetwork(20, msgspec.structs.replace(config, members=1), 6).eval()
        alone.members[0] = member
        each.append(alone(features))
    assert not torch.allclose(each[0][0], each[1][0])
    for found, values in zip(network(features), zip(*each, strict=True), strict=True):
        torch.testing.assert_close(found, torch.stack(values).mean(dim=0))


def test_members_learn_beside_each_other_as_if_alone():
    torch.manual_seed(0)
    config = CjpConfig(latent_size=4, hidden=(16, 8), members=2)
    target = Target.of_arrays([np.array([0.0, 0, 0, 1]), np.zeros(6), np.ones(6)])
    learner = CjpLearner(20, config, target).train()
    features, y = torch.randn(8, 20), torch.randn(8, 6)
    first, second = learner.network.members
    second.load_state_dict(first.state_dict())
    learner.loss(features, y, warm_up=True).backward()
    slopes = [member.encoder[0].weight.grad for member in (first, second)]
    # Weights and rows are the same, but each member draws its own noise.
    assert all(slope.abs().sum() > 0 for slope in slopes)
    assert not torch.allclose(*slopes)
    prediction = learner.network.samples(features)
    loss = learner.of_prediction(prediction, y.repeat(2, 1), warm_up=True)
    halves = [
        learner.of_prediction(CjpPrediction(*(v[rows] for v in prediction)), y, warm_up=True)
        for rows in (slice(8), slice(8, None))
    ]
    torch.testing.assert_close(loss, torch.stack(halves).mean())


@pytest.mark.usefixtures("small_backbone")
def test_a_run_of_several_members_becomes_a_bundle(tmp_path):
    head = CjpConfig(members=2)
    run = train(tmp_path / "run", tiny_config(steps=100, head=head), ignore_progress)
    publish(run, tmp_path / "bundle", "two")
    assert read_bundle(tmp_path / "bundle").calibration.provenance.options["head.members"] == 2


# A place in UTM coordinates: easting, northing, height.
UTM_M = (5e5, 5e6, 100.0)


def moved(dataset, offset_m):
    poses = dataset.poses.copy()
    poses[:, :3] += offset_m
    return dataclasses.replace(dataset, poses=poses)


@pytest.fixture(scope="module")
def far_bundle(tiny_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bundles") / "far"
    run = dataclasses.replace(tiny_run, dataset=moved(tiny_run.dataset, UTM_M))
    publish(run, folder, "far")
    return folder


@pytest.mark.parametrize("scope", ["marginal", "joint"])
def test_estimates_of_a_far_place_are_world_coordinates(tiny_run, tiny_bundle, far_bundle, scope):
    dataset, offset = tiny_run.dataset, np.array([*UTM_M, 0.0, 0.0, 0.0])
    far_dataset, rows = moved(dataset, UTM_M), np.arange(0, 320, 16)
    near_odometer = Odometer.load(tiny_bundle, scope=scope)
    with near_odometer, Odometer.load(far_bundle, scope=scope) as far_odometer:
        pose = near_odometer.calibration.pose, far_odometer.calibration.pose
        assert [each.origin_m for each in pose] == [None, UTM_M]
        assert pose[0].limits.lowest == pytest.approx(pose[1].limits.lowest, abs=1e-8)
        for index in rows.tolist():
            image = dataset.read_image(index)
            near, far = near_odometer.step(image), far_odometer.step(image)
            assert near.status == far.status == "ok"
            assert far.pose.t_m - UTM_M == pytest.approx(near.pose.t_m, abs=1e-6)
            assert far.lower - offset == pytest.approx(near.lower, abs=1e-6)
            assert far.upper - offset == pytest.approx(near.upper, abs=1e-6)
            truth = far_dataset.poses[index]
            assert (far.covers(truth) == near.covers(dataset.poses[index])).all()
        near_seen = observe(near_odometer, dataset, rows)
        far_seen = observe(far_odometer, far_dataset, rows)
    assert far_seen.true_pose == pytest.approx(near_seen.true_pose, abs=1e-6)
    assert (far_seen.pose == near_seen.pose).all()


def test_a_far_place_is_learned_as_if_it_were_near(tiny_run, tmp_path, monkeypatch):
    far = moved(tiny_run.dataset, UTM_M)
    monkeypatch.setattr(runs, "open_dataset", lambda text: far)
    run = train(tmp_path / "far", tiny_config(steps=1, copies=0, warm_up_steps=0), ignore_progress)
    for name in ("mean", "std", "reference_q_xyzw"):
        expected = getattr(tiny_run.target, name)
        assert getattr(run.target, name) == pytest.approx(expected, abs=1e-8)
    stored = np.load(tmp_path / "far" / "features-0" / "copy-000.npz")
    rows = np.concatenate([run.split.roles["train"], run.split.roles["fit"]])
    assert stored["poses"] == pytest.approx(tiny_run.dataset.poses[rows], abs=1e-8)


def test_only_a_far_place_has_an_origin(tiny_run):
    dataset = tiny_run.dataset
    assert dataset.origin_m is None
    assert dataset.local_poses is dataset.poses
    assert moved(dataset, (900.0, 0.0, 0.0)).origin_m is None
    far = moved(dataset, (0.0, 1280.0, 30.0))
    assert far.origin_m == (0.0, 1300.0, 0.0)
    assert (far.local_poses == about(far.poses, (0.0, 1300.0, 0.0))).all()


def test_a_damaged_image_costs_that_frame_only(tiny_bundle, tiny_run):
    def read_image(index):
        if index == 1:
            raise SourceError("damaged")
        return tiny_run.dataset.read_image(index)

    holed = dataclasses.replace(tiny_run.dataset, read_image=read_image)
    with Odometer.load(tiny_bundle) as odometer:
        seen = observe(odometer, holed, np.arange(3))
    assert seen.indices.tolist() == [0, 2]
    assert (seen.refused.invalid, seen.refused.degraded) == (1, 0)


def test_a_frame_that_nothing_may_be_claimed_of_is_not_calibrated_with(tiny_bundle, tiny_run):
    def read_image(index):
        image = tiny_run.dataset.read_image(index)
        return np.zeros_like(image) if index == 1 else image

    holed = dataclasses.replace(tiny_run.dataset, read_image=read_image)
    with Odometer.load(tiny_bundle) as odometer:
        seen = observe(odometer, holed, np.arange(3))
    assert seen.indices.tolist() == [0, 2]
    assert (seen.refused.invalid, seen.refused.degraded) == (0, 1)


def test_no_frame_that_passes_is_a_usage_error(tiny_bundle, tiny_run):
    blind = dataclasses.replace(tiny_run.dataset, read_image=lambda _: np.zeros((1, 1), np.uint8))
    with (
        Odometer.load(tiny_bundle) as odometer,
        pytest.raises(SourceError, match="found none of 2: image_unsupported 2"),
    ):
        observe(odometer, blind, np.array([0, 1]))
