"""Calibration of existing networks: an ONNX file or the model of a bundle."""

import dataclasses
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from cvo_edge import Odometer
from cvo_edge.bundle.format import ImageSpec
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.conformal import conformal_quantile
from cvo_edge.engine.loading import read_bundle
from cvo_edge.engine.selftest import check_selftest
from cvo_edge.errors import BundleMismatchError, CvoError, ModelError, SinkError, UsageError
from cvo_edge.geometry import mean_rotation
from cvo_edge.programs.inspect import inspect_lines
from cvo_export.bundles.observed import observe
from cvo_export.calibrate import calibrate
from cvo_export.cli import app
from cvo_export.data.splits import make_split, same_split
from cvo_export.datasets import open_dataset
from cvo_export.datasets.sizes import one_size
from cvo_export.evaluate import evaluate, find_level

DATASET = "synthetic:room,flights=12,frames=20,size=64x48,seed=4"


@pytest.fixture(scope="module")
def dataset():
    return open_dataset(DATASET)


def own_model(dataset, bounds, height=48, width=64, outputs=("pose", "lower", "upper")):
    """A small network from elsewhere, which estimates the position from the mean colour."""
    generator = np.random.default_rng(0)
    rotation = mean_rotation(dataset.poses[:, 3:]).astype(np.float32)
    centre = dataset.poses[:, :3].mean(axis=0).astype(np.float32)
    constants = {
        "slope": generator.normal(0.0, 2e-4, (3, 3)).astype(np.float32),
        "centre": centre[None],
        "rotation": rotation[None],
        "axes": np.array([1, 2]),
        "zeros": np.zeros((1, 3), np.float32),
        "half": np.array([[0.3, 0.3, 0.1, 0.1, 0.2, 0.05]], np.float32),
    }
    nodes = [
        helper.make_node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["float", "axes"], ["colour"], keepdims=0),
        helper.make_node("MatMul", ["colour", "slope"], ["shift"]),
        helper.make_node("Add", ["shift", "centre"], ["position"]),
        helper.make_node("Concat", ["position", "rotation"], [outputs[0]], axis=1),
    ]
    shapes = {outputs[0]: [1, 7]}
    if bounds:
        nodes += [
            helper.make_node("Concat", ["position", "zeros"], ["point"], axis=1),
            helper.make_node("Sub", ["point", "half"], [outputs[1]]),
            helper.make_node("Add", ["point", "half"], [outputs[2]]),
        ]
        shapes |= {outputs[1]: [1, 6], outputs[2]: [1, 6]}
    graph = helper.make_graph(
        nodes,
        "own",
        [helper.make_tensor_value_info("image", TensorProto.UINT8, [1, height, width, 3])],
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in shapes.items()],
        [numpy_helper.from_array(values, name) for name, values in constants.items()],
    )
    opsets = [helper.make_opsetid("", 18)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=10).SerializeToString()


@pytest.fixture
def model_file(dataset, tmp_path):
    path = tmp_path / "own.onnx"
    path.write_bytes(own_model(dataset, bounds=False))
    return path


def test_a_point_network_gets_order_statistics_of_its_residuals(model_file, dataset, tmp_path):
    calibration = calibrate(model_file, dataset, tmp_path / "b", "own", kind="random")
    assert (calibration.method, calibration.calibration.score) == ("cqr", "residual")
    split = same_split(dataset, calibration.calibration.split)
    with Odometer.load(tmp_path / "b") as odometer:
        check_selftest(odometer)
        seen = observe(odometer, dataset, split.roles["cal"])
    for dof in range(6):
        expected = conformal_quantile(np.abs(seen.truth - seen.point)[:, dof], 0.9)
        assert calibration.threshold(0.9, "marginal").q_hat[dof] == expected
    level = find_level(evaluate(tmp_path / "b", dataset, "test")["levels"], 0.9, "marginal")
    low, high = level["coverage_band"]
    assert all(low <= share <= high for share in level["coverage"])


@pytest.mark.parametrize(("count", "colour"), [(2, True), (10, False)])
def test_a_few_grey_frames_are_not_calibrated_with(model_file, tmp_path, count, colour):
    dataset = open_dataset("synthetic:room,flights=2,frames=40,size=64x48")
    roles = make_split(dataset, "random", 0, "calibration").roles
    grey = {*roles["cal"][:count].tolist(), int(roles["test"][0])}

    def read_image(index):
        image = dataset.read_image(index)
        return image[:, :, 1] if index in grey else image

    some = dataclasses.replace(dataset, read_image=read_image)
    calibration = calibrate(model_file, some, tmp_path / "b", "own", kind="random")
    assert calibration.images == ImageSpec(width=64, height=48, colour=colour)
    # The frames that the runtime doubts are left out, and no others.
    assert calibration.calibration.n == roles["cal"].size - colour * count
    frames = evaluate(tmp_path / "b", some, "test")["frames"]
    assert (frames["degraded"], frames["invalid"]) == (colour * 1, 0)


def test_a_camera_of_another_size_than_the_new_images_is_not_kept(model_file, tmp_path):
    small = open_dataset("synthetic:room,flights=1,frames=12,size=64x48")
    first = calibrate(model_file, small, tmp_path / "a", "a", kind="random")
    assert (first.camera.width, first.images.width) == (64, 64)
    larger = open_dataset("synthetic:room,flights=1,frames=12,size=80x60")
    for new, kept in ((small, first.camera), (larger, None)):
        unknown = dataclasses.replace(new, intrinsics=None)
        again = calibrate(
            tmp_path / "a", unknown, tmp_path / "b", "b", kind="random", new_data=True
        )
        assert again.camera == kept
        assert again.images.width == one_size(new)[0]


@pytest.mark.parametrize("rotation", ["tangent_predicted", "euler_zyx"])
def test_a_network_with_bounds_gets_the_scores_of_quantile_regression(dataset, tmp_path, rotation):
    path = tmp_path / "own.onnx"
    path.write_bytes(own_model(dataset, bounds=True))
    calibration = calibrate(
        path, dataset, tmp_path / "b", "own", kind="random", rotation=rotation, score="additive"
    )
    assert calibration.calibration.score == "additive"
    assert calibration.pose.rotation == rotation
    level = find_level(evaluate(tmp_path / "b", dataset, "test")["levels"], 0.9, "marginal")
    assert np.mean(level["coverage"]) > 0.8


def test_sides_joint_scope_and_rule_are_those_asked_for(model_file, dataset, tmp_path):
    calibration = calibrate(
        *(model_file, dataset, tmp_path / "b", "own"),
        kind="sequence",
        sides="asymmetric",
        joint="bonferroni",
        rule="hierarchical",
    )
    assert calibration.method_parameters["sides"] == "asymmetric"
    assert calibration.calibration.joint == "bonferroni"
    assert calibration.calibration.rule == "hierarchical"
    # 8 sequences are too few for a finite two-sided threshold at 0.9.
    assert calibration.threshold(0.9, "marginal").q_hat == (None,) * 6


def test_few_frames_are_unbounded_and_said_to_be(model_file, tmp_path):
    few = open_dataset("synthetic:room,flights=1,frames=12,size=64x48")
    calibration = calibrate(model_file, few, tmp_path / "b", "few", kind="random")
    assert calibration.calibration.n == 8
    assert calibration.threshold(0.8, "marginal").q_hat != (None,) * 6
    assert calibration.threshold(0.9, "marginal").q_hat == (None,) * 6
    text = " ".join(" ".join(inspect_lines(calibration)).split())
    for confidence, needed in ((0.9, 9), (0.95, 19), (0.99, 99)):
        said = f"finite from {needed} calibration frames, has 8"
        assert f"unbounded at {confidence} marginal and joint: {said}" in text


def test_what_two_sides_and_bonferroni_would_need_is_said(model_file, dataset, tmp_path):
    lines = inspect_lines(
        calibrate(
            *(model_file, dataset, tmp_path / "b", "own"),
            kind="random",
            sides="asymmetric",
            joint="bonferroni",
        )
    )
    # Half of 0.01 per side needs 199 frames; half of a sixth of 0.05 needs 239.
    assert "unbounded    at 0.99 marginal: finite from 199 calibration frames, has 168" in lines
    assert "unbounded    at 0.95 joint: finite from 239 calibration frames, has 168" in lines


def test_a_bundle_keeps_its_model_and_method_on_new_data(tiny_bundle, dataset, tmp_path):
    before = read_bundle(tiny_bundle)
    calibrate(tiny_bundle, dataset, tmp_path / "b", "new site", kind="random", new_data=True)
    after = read_bundle(tmp_path / "b")
    assert after.model_bytes == before.model_bytes
    assert after.calibration.method == before.calibration.method
    assert after.calibration.calibration.split.purpose == "calibration"
    assert after.calibration.calibration.dataset == dataset.name
    assert after.calibration.thresholds != before.calibration.thresholds
    assert after.calibration.provenance == before.calibration.provenance
    old, new = before.calibration.pose.limits, after.calibration.pose.limits
    assert all(a >= b for a, b in zip(old.lowest, new.lowest, strict=True))
    assert all(a <= b for a, b in zip(old.highest, new.highest, strict=True))
    level = find_level(evaluate(tmp_path / "b", dataset, "test")["levels"], 0.9, "marginal")
    assert np.mean(level["coverage"]) > 0.8


def test_on_the_runs_own_data_the_frames_it_trained_on_stay_out(tiny_bundle, tiny_run, tmp_path):
    # The val and cal frames are the run's, so the thresholds are bit-identical.
    before = read_calibration(tiny_bundle)
    after = calibrate(
        tiny_bundle, tiny_run.dataset, tmp_path / "b", "again", score=before.calibration.score
    )
    assert after.thresholds == before.thresholds
    assert after.calibration.split == before.calibration.split


def test_other_frames_of_the_training_datas_name_need_a_word(tiny_bundle, tmp_path):
    # The network was trained on eight of the nine flights.
    superset = open_dataset("synthetic:room,flights=9,frames=40,size=64x48")
    with pytest.raises(UsageError, match="--new-data"):
        calibrate(tiny_bundle, superset, tmp_path / "b", "leak", kind="random")
    assert not (tmp_path / "b").exists()


def test_the_run_is_remembered_when_a_bundle_comes_back_to_its_own_data(
    tiny_bundle, tiny_run, dataset, tmp_path
):
    before = read_calibration(tiny_bundle)
    calibrate(tiny_bundle, dataset, tmp_path / "b", "away", kind="random", new_data=True)
    after = calibrate(
        tmp_path / "b", tiny_run.dataset, tmp_path / "c", "home", score=before.calibration.score
    )
    assert after.calibration.split == before.calibration.split
    assert after.calibration.n == before.calibration.n


def test_a_network_of_a_far_place_answers_about_a_given_origin(tmp_path):
    dataset = open_dataset("synthetic:room,flights=4,frames=10,size=64x48,seed=4")
    path, utm_m = tmp_path / "own.onnx", (5e5, 5e6, 100.0)
    path.write_bytes(own_model(dataset, bounds=True))
    poses = dataset.poses + np.array([*utm_m, 0.0, 0.0, 0.0, 0.0])
    far_dataset = replace(dataset, poses=poses)
    near = calibrate(path, dataset, tmp_path / "near", "own", kind="random")
    far = calibrate(path, far_dataset, tmp_path / "far", "own", kind="random", origin_m=utm_m)
    assert far.pose.origin_m == utm_m
    for one, other in zip(near.thresholds, far.thresholds, strict=True):
        for a, b in zip(one.q_hat, other.q_hat, strict=True):
            assert b == (None if a is None else pytest.approx(a, abs=1e-6))
    with Odometer.load(tmp_path / "far") as odometer:
        estimate = odometer.step(dataset.read_image(0))
    assert np.abs(estimate.pose.t_m - utm_m).max() < 10.0
    again = calibrate(tmp_path / "far", far_dataset, tmp_path / "again", "own", kind="random")
    assert again.pose.origin_m == utm_m
    assert again.pose.limits.highest[1] < 100.0


@pytest.mark.parametrize("origin_m", [(0.0, np.nan, 0.0), (0.0, 0.0, -1e9)])
def test_an_origin_is_three_possible_numbers(model_file, dataset, tmp_path, origin_m):
    with pytest.raises(UsageError, match=r"^origin: expected metres below 1e\+09, found \("):
        calibrate(model_file, dataset, tmp_path / "b", "b", origin_m=origin_m)


@pytest.mark.parametrize(
    "given", [{"rotation": "euler_zyx"}, {"crop": "centre"}, {"origin_m": (0.0, 0.0, 0.0)}]
)
def test_options_of_a_model_file_are_refused_with_a_bundle(tiny_bundle, dataset, tmp_path, given):
    with pytest.raises(UsageError, match="expected only with an ONNX file"):
        calibrate(tiny_bundle, dataset, tmp_path / "b", "b", **given)


def test_a_split_is_not_asked_for_on_the_runs_own_data(tiny_bundle, tiny_run, tmp_path):
    with pytest.raises(UsageError, match="its recorded split is used"):
        calibrate(tiny_bundle, tiny_run.dataset, tmp_path / "b", "b", kind="random")


def test_a_network_is_calibrated_where_torch_is_not_installed(model_file, tmp_path):
    program = (
        "import sys\n"
        "for name in ('torch', 'torchvision', 'timm', 'sklearn'):\n"
        "    sys.modules[name] = None\n"
        "from cvo_export.cli import main\n"
        "main()\n"
    )
    arguments = ["calibrate", model_file, DATASET, tmp_path / "b", "--split", "random"]
    found = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    assert "residual score" in found.stdout
    assert read_calibration(tmp_path / "b").provenance.backbone is None


@pytest.mark.parametrize(
    ("content", "error", "match"),
    [
        (b"no model at all", ModelError, "expected an ONNX file, found something else"),
        (None, ModelError, "expected an ONNX file or a bundle folder"),
        ({"outputs": ("place", "lower", "upper")}, BundleMismatchError, "pose"),
        ({"outputs": ("pose", "low", "high")}, BundleMismatchError, "found inputs image uint8"),
        ({"height": 8, "width": 8}, BundleMismatchError, "at least 16x16 pixels, found 8x8"),
    ],
)
def test_what_is_no_such_model_is_refused(dataset, tmp_path, content, error, match):
    path = tmp_path / "model.onnx"
    if isinstance(content, dict):
        content = own_model(dataset, bounds=True, **content)
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(error, match=match):
        calibrate(path, dataset, tmp_path / "b", "wrong")
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(
    ("extra", "code"),
    [
        (["--score", "aps"], 2),
        (["--split", "block"], 2),
        (["--sides", "sideways"], 2),
    ],
)
def test_wrong_options_are_one_line_with_exit_code_two(model_file, tmp_path, extra, code):
    few = "synthetic:room,flights=1,frames=12,size=64x48"
    with pytest.raises(Exception) as caught:
        app(
            ["calibrate", str(model_file), few, str(tmp_path / "b"), *extra],
            standalone_mode=False,
        )
    assert caught.value.exit_code == code
    if isinstance(caught.value, CvoError):
        assert "\n" not in str(caught.value)


def test_a_folder_with_other_files_is_left_alone(model_file, dataset, tmp_path):
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "precious.txt").write_text("keep")
    with pytest.raises(SinkError):
        calibrate(model_file, dataset, tmp_path / "b", "own")
    with pytest.raises(UsageError, match="score"):
        calibrate(model_file, dataset, tmp_path / "c", "own", score="lac", kind="random")
