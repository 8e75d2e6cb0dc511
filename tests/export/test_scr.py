"""Scene coordinate regression and the fusion, from training to bundle."""

from contextlib import contextmanager

import cv2
import numpy as np
import onnx
import pytest
import torch

from cvo_edge import Odometer
from cvo_edge.engine.loading import read_bundle
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.heads import scr as scr_module
from cvo_edge.heads.scr import ScrParameters
from cvo_edge.pose_solver import NU
from cvo_export.bundles.observed import observe
from cvo_export.data import place as place_module
from cvo_export.data.augment import AugmentConfig
from cvo_export.datasets import open_dataset
from cvo_export.evaluate import evaluate, find_level
from cvo_export.networks.backbone import BackboneConfig
from cvo_export.networks.heads import fused as fused_module
from cvo_export.networks.heads.base import deviation_of
from cvo_export.networks.heads.fused import FusedConfig
from cvo_export.networks.heads.scr import ScrConfig, cell_loss, spread_poses
from cvo_export.networks.methods import TRAINABLE
from cvo_export.networks.stem import split_backbone
from cvo_export.publish import publish
from cvo_export.training import loop as loop_module
from cvo_export.training.configure import _copies
from cvo_export.training.loop import train
from cvo_export.training.run import load_run

from .conftest import ignore_progress, tiny_config
from .test_train import InterruptedTrainingError, same_weights, stopping_after

SCENE = "synthetic:room,flights=6,frames=30,size=192x144"
CONFIGS = {
    "scr": ScrConfig(width=48, blocks=1, cell_steps=60),
    "fused": FusedConfig(width=48, blocks=1, cell_steps=60),
}


def config(method, **changes):
    values = {
        "head": CONFIGS[method],
        "dataset": SCENE,
        "height": 144,
        "width": 192,
        "augment": AugmentConfig(2.0, 0.3, motion_blur=0.3, zoom=0.1),
        "steps": 40,
    }
    return tiny_config(**{**values, **changes})


@pytest.fixture(scope="module", autouse=True)
def _short_regression():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fused_module, "_REGRESSION_STEPS", 200)
        yield


@contextmanager
def every_frame_accepted():
    """The short runs have learned too little to locate a frame."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scr_module, "LOST", 1.0)
        patch.setattr(scr_module, "_CONVERGED", np.inf)
        yield


_MAPS = {}


@contextmanager
def mapped_once():
    """Triangulate the same poses once, for runs whose map is not what a test is about."""
    triangulate = loop_module.sparse_map

    def sparse_map(read_image, poses, camera, seed, progress):
        key = (poses.tobytes(), camera, seed)
        if key not in _MAPS:
            _MAPS[key] = triangulate(read_image, poses, camera, seed, progress)
        return _MAPS[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop_module, "sparse_map", sparse_map)
        yield


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    made = {}

    def of(method):
        if method not in made:
            folder = tmp_path_factory.mktemp("runs") / method
            with mapped_once():
                run = train(folder, config(method), ignore_progress)
            bundle = folder.with_name(method + "-bundle")
            with every_frame_accepted():
                publish(run, bundle, method)
            made[method] = (folder, run, bundle)
        return made[method]

    return of


@pytest.mark.parametrize("method", list(CONFIGS))
def test_a_finished_run_is_read_back_and_publishes_the_same_bundle(runs, method, tmp_path):
    folder, run, bundle = runs(method)
    again = load_run(folder)
    assert same_weights(run, again)
    with every_frame_accepted():
        publish(again, tmp_path / "again", method)
    first, second = read_bundle(bundle), read_bundle(tmp_path / "again")
    assert second.calibration.thresholds == first.calibration.thresholds
    assert second.calibration.method_parameters == first.calibration.method_parameters


def test_a_run_that_is_interrupted_at_every_stage_ends_as_if_it_never_was(runs, tmp_path):
    _, run, _ = runs("scr")
    # The last one interrupts the second lesson.
    first = sum(entry.lesson == "scr-cells" for entry in run.history)
    for stage, calls in (("map", 20), ("features", 1), ("training", first + 5)):
        with pytest.raises(InterruptedTrainingError):
            train(tmp_path / "run", config("scr"), stopping_after(calls, stage))
    resumed = train(tmp_path / "run", config("scr"), ignore_progress)
    assert same_weights(run, resumed)
    assert run.history == resumed.history


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A run that learned its place, unlike the others, which only pass through every step."""
    folder = tmp_path_factory.mktemp("learned") / "fused"
    head = FusedConfig(width=64, blocks=1, cell_steps=1500)
    with mapped_once():
        run = train(folder, config("fused", head=head, steps=400, averaging=0.98), ignore_progress)
    bundle = folder.with_name("bundle")
    publish(run, bundle, "learned")
    return run, bundle


def test_a_bundle_locates_the_camera_and_covers_it(learned):
    run, bundle = learned
    report = evaluate(bundle, run.dataset, "test")
    spread = float(np.linalg.norm(run.dataset.poses[:, :3].std(axis=0)))
    assert report["point_error"]["median_m"] < 0.3 * spread
    assert report["frames"]["invalid"] == 0
    for scope in ("marginal", "joint"):
        level = find_level(report["levels"], 0.9, scope)
        covered = level["coverage"] if scope == "marginal" else [level["joint_coverage"]]
        assert min(covered) > 0.7


def test_a_camera_of_another_focal_length_works_if_it_is_given(learned):
    run, bundle = learned
    own = run.dataset.camera()
    box = own.height // 20, own.height - own.height // 20, 5, own.width - 11
    other = own.cropped(*box).scaled(400, 300)

    def cropped(image):
        top, bottom, left, right = box
        return cv2.resize(image[top:bottom, left:right], (400, 300), interpolation=cv2.INTER_AREA)

    def errors(camera, change):
        with Odometer.load(bundle, camera=camera) as odometer:
            found = [
                (
                    odometer.step(change(run.dataset.read_image(int(index)))),
                    run.dataset.poses[index],
                )
                for index in run.split.roles["test"]
            ]
        known = [(each, pose) for each, pose in found if each.bounded]
        # Limits and alarm of so small a network doubt many frames.
        assert len(known) > 0.7 * len(found)
        assert np.mean([each.covers(pose) for each, pose in known]) > 0.75
        return [np.linalg.norm(each.pose.t_m - pose[:3]) for each, pose in known]

    # Nine cells of ten are left at most, on each side.
    assert np.median(errors(other, cropped)) < 2.5 * np.median(errors(None, lambda image: image))


def test_the_runtime_solves_for_the_pose_of_torchs_coordinates(runs):
    _, run, bundle = runs("scr")
    with every_frame_accepted(), Odometer.load(bundle) as odometer:
        seen = observe(odometer, run.dataset, run.split.roles["test"][:8])
        parameters = odometer.head.parameters
    assert isinstance(parameters, ScrParameters)
    for row, index in enumerate(seen.indices):
        from cvo_edge.input.preprocess import model_input

        image = model_input(run.dataset.read_image(int(index)), 144, 192, "none")
        with torch.no_grad():
            coordinates, scale = run.graph(torch.from_numpy(image))
        np.testing.assert_allclose(seen.outputs["coordinates"][row], coordinates[0], atol=1e-4)
        np.testing.assert_allclose(seen.outputs["log_scale_px"][row], scale[0], atol=1e-4)


def test_8_bits_hold_the_whole_network_but_its_last_layer(learned, tmp_path):
    run, bundle = learned
    publish(run, tmp_path / "int8", "int8", precision="int8")
    model = onnx.load(tmp_path / "int8" / "model.onnx")
    constants = {each.name: each for each in model.graph.initializer}
    of_cells = [
        node
        for node in model.graph.node
        if node.op_type in ("MatMul", "Gemm", "Conv") and node.input[1] in constants
    ]
    # Of the layers that read cells, 64 values each, the last is the only one in float32.
    widths = [list(constants[node.input[1]].dims) for node in of_cells]
    assert [each for each in widths if 64 in each] == [[64, 5]]
    found = evaluate(tmp_path / "int8", run.dataset, "test")["point_error"]
    assert (
        found["median_m"] < 1.3 * evaluate(bundle, run.dataset, "test")["point_error"]["median_m"]
    )


def test_another_room_gets_no_interval(learned):
    _, bundle = learned
    generator = np.random.default_rng(0)
    with Odometer.load(bundle) as odometer:
        for _ in range(10):
            noise = generator.integers(0, 255, (144, 192, 3)).astype(np.uint8)
            assert not odometer.step(noise).bounded
        other = odometer.step(np.zeros((200, 150, 3), np.uint8) + np.arange(150)[:, None] % 251)
        assert not other.bounded


def test_a_data_set_without_a_camera_is_refused(tmp_path, monkeypatch):
    from cvo_export.datasets.base import PoseDataset

    monkeypatch.setattr(PoseDataset, "camera", lambda self: None)
    with pytest.raises(UsageError, match="expected the camera's intrinsics for scr, found none"):
        train(tmp_path / "run", config("scr"), ignore_progress)


def test_images_that_are_no_whole_number_of_cells_are_refused():
    with pytest.raises(UsageError, match=r"size: expected multiples of 16 .*, found 100x96"):
        split_backbone(BackboneConfig("test_efficientnet"), 96, 100, "none")


@pytest.mark.parametrize("name", ["mobilenetv2_050", "resnet18", "mobilenetv3_small_050"])
def test_a_backbone_is_cut_without_changing_what_it_computes(name):
    """``split_backbone`` compares both parts with timm's own stages, and refuses a difference."""
    stem, upper, _ = split_backbone(BackboneConfig(name), 96, 128, "none")
    image = torch.zeros((2, 96, 128, 3), dtype=torch.uint8)
    with torch.no_grad():
        assert upper(stem(image)).shape == (2, 6 * 8, upper.size)


def test_the_loss_is_least_at_the_truth():
    generator = np.random.default_rng(0)
    count, focal = 64, 200.0
    y = np.zeros((count, place_module.COLUMNS), np.float32)
    y[:, place_module.RAY] = generator.uniform(-0.5, 0.5, (count, 2))
    y[:, place_module.ROTATION] = np.eye(3).ravel()
    y[:, place_module.SHOWN] = 1.0
    depth = generator.uniform(1.0, 3.0, count)
    y[:, place_module.LOG_DEPTH] = np.log(depth)
    y[:, place_module.DEPTH_WEIGHT] = 1.0
    truth = np.column_stack([y[:, place_module.RAY], np.ones(count)]) * depth[:, None]

    def loss(points, log_scale=0.0):
        x = torch.tensor(points, dtype=torch.float32)
        scales = torch.full((count,), float(log_scale))
        return float(cell_loss(x, scales, torch.from_numpy(y), focal, 2.0))

    best = loss(truth)
    for _ in range(20):
        assert loss(truth + generator.normal(0.0, 0.02, truth.shape)) > best
    # Points behind the camera, or far off, cost more than any point near the truth.
    assert loss(-truth) > loss(truth + 0.5) > best
    # The scale is that of the errors: 2-D Student's t with nu = 3.
    error = generator.standard_t(NU, (count, 2)) * 4.0 / focal
    noisy = truth + np.column_stack([error * depth[:, None], np.zeros(count)])
    losses = [loss(noisy, np.log(scale)) for scale in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)]
    assert np.argmin(losses) in (2, 3, 4)


def test_spread_poses_cover_all_poses():
    poses = open_dataset("synthetic:room,flights=4,frames=30,size=64x48").poses
    few, many = (
        max(np.linalg.norm(poses[:, None, :3] - spread_poses(poses, n)[:, :3], axis=2).min(axis=1))
        for n in (1, 16)
    )
    assert many < 0.6 * few


def test_a_network_that_recognises_nothing_is_not_published(runs, tmp_path):
    _, run, _ = runs("scr")
    with pytest.raises(SourceError, match=r"found none of \d+: image_unfamiliar \d+ \("):
        publish(run, tmp_path / "bundle", "lost")
    assert not (tmp_path / "bundle").exists()


@pytest.mark.parametrize(("frames", "copies"), [(100, 16), (2400, 16), (10_000, 7), (500_000, 1)])
def test_large_data_sets_get_fewer_copies(monkeypatch, frames, copies):
    monkeypatch.setattr("cvo_export.training.configure.open_dataset", lambda _: range(frames))
    assert _copies(TRAINABLE["scr"], "any", 256 * 192) == copies
    assert _copies(TRAINABLE["scr"], "any", 512 * 384) <= max(1, copies)
    assert _copies(TRAINABLE["cjp"], "any", 256 * 192) == 48


@pytest.mark.parametrize("rows", [1, 100, 65_536, 200_001])
def test_the_deviation_in_parts_is_numpys(rows):
    values = np.random.default_rng(0).normal(3.0, 2.0, (rows, 5)).astype(np.float16)
    mean = values.mean(axis=0, dtype=np.float64)
    np.testing.assert_array_equal(deviation_of(values, mean), values.std(axis=0, dtype=np.float64))
