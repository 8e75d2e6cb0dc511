"""Bundles for OpenVINO: thresholds from its own outputs, computed in float32, not in bfloat16."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from onnx import TensorProto, helper

from cvo_edge.bundle.format import TensorSpec
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.engine.loading import read_bundle
from cvo_edge.engine.model_cache import CachedModel, ModelCache
from cvo_edge.engine.openvino import OpenvinoSession
from cvo_edge.engine.selftest import check_selftest
from cvo_edge.errors import ModelError
from cvo_edge.odometer import Odometer
from cvo_edge.programs.inspect import inspect_lines
from cvo_export.calibrate import calibrate
from cvo_export.datasets import open_dataset
from cvo_export.publish import publish

from .conftest import DATASET

openvino = pytest.importorskip("openvino")

ARTIFACTS = Path(__file__).resolve().parents[2] / "calibration_artifacts"


@pytest.fixture(scope="module")
def eight(tiny_run, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("eight") / "onnxruntime"
    publish(tiny_run, folder, "eight", precision="int8")
    return folder


@pytest.fixture(scope="module")
def of_openvino(eight, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("eight") / "openvino"
    calibrate(eight, open_dataset(DATASET), folder, "eight", provider="openvino")
    return folder


def images(count: int) -> list[np.ndarray]:
    dataset = open_dataset(DATASET)
    return [dataset.read_image(index) for index in range(0, 8 * count, 8)]


def test_thresholds_are_those_of_the_providers_own_numbers(eight, of_openvino, tiny_run):
    """At every stored threshold, the rule gives the number of calibration frames inside."""
    here, there = read_bundle(eight), read_bundle(of_openvino)
    assert here.model_bytes == there.model_bytes
    assert here.calibration.thresholds != there.calibration.thresholds
    calibration, roles = there.calibration, tiny_run.split.roles
    n = calibration.calibration.n
    assert n == roles["cal"].size
    for scope in ("marginal", "joint"):
        with Odometer(there, confidence=0.9, scope=scope) as odometer:
            assert isinstance(odometer.session, OpenvinoSession)
            # The frame that gives the threshold lies on the border, within rounding.
            inside = np.array(
                [
                    odometer.conformal_set(seen).distance(point) < 1e-9
                    for seen, point in observations(odometer, tiny_run.dataset, roles["cal"])
                ]
            )
        covered = inside.all(axis=1).sum() if scope == "joint" else inside.sum(axis=0)
        assert np.all(covered == np.ceil((n + 1) * 0.9))


def observations(odometer, dataset, indices):
    for number, index in enumerate(indices.tolist()):
        seen = odometer.observe(dataset.read_image(index), number)
        truth = odometer.chart.coordinates(
            np.atleast_2d(dataset.poses[index]), np.atleast_2d(seen.pose)
        )
        yield seen, truth[0]


def test_float32_is_onnxruntimes_to_five_digits(tiny_run, tiny_bundle, tmp_path):
    """OpenVINO prefers bfloat16 where available, which would leave three digits."""
    publish(tiny_run, tmp_path / "b", "b", provider="openvino")
    bundle = read_bundle(tmp_path / "b")
    with Odometer(read_bundle(tiny_bundle)) as here, Odometer(bundle) as there:
        assert there.session.engine.get_property("INFERENCE_PRECISION_HINT") == openvino.Type.f32
        for image in images(8):
            expected, found = here.step(image), there.step(image)
            np.testing.assert_allclose(found.pose.t_m, expected.pose.t_m, atol=1e-5)
            np.testing.assert_allclose(found.lower, expected.lower, atol=1e-4)


def test_the_self_test_is_of_the_provider(of_openvino):
    with Odometer.load(of_openvino) as odometer:
        assert check_selftest(odometer) < 1e-5
    assert any("on openvino" in line for line in inspect_lines(read_calibration(of_openvino)))


def test_workers_beside_each_other_give_what_one_gives(of_openvino):
    with (
        Odometer.load(of_openvino, threads=2) as one,
        Odometer.load(of_openvino, threads=2, mode="throughput") as two,
    ):
        expected, found = list(one.stream(images(20))), list(two.stream(images(20)))
    assert [each.seq for each in found] == list(range(20))
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_allclose(a.pose.t_m, b.pose.t_m, atol=1e-6)


def test_a_compiled_model_is_kept_and_computes_the_very_same(of_openvino, eight, tmp_path):
    """The model file is that of the other bundle; each engine has its own entry."""
    cache = ModelCache(tmp_path / "cache")
    for _ in ("compiled", "found"):
        prepared = read_bundle(of_openvino, cache=cache)
        assert isinstance(prepared.model, CachedModel)
    assert read_bundle(eight, cache=cache).model.provider == "onnxruntime"
    engines = sorted(entry.engine.split()[0] for entry in cache.entries() if entry.current)
    assert engines == ["onnxruntime", "openvino"]
    for threads in (1, 2):
        with Odometer(prepared, threads=threads) as kept, Odometer.load(of_openvino) as plain:
            # By default it would compute in bfloat16 where the processor can.
            precision = kept.session.engine.get_property("INFERENCE_PRECISION_HINT")
            assert precision == openvino.Type.f32
            for image in images(3):
                expected, found = plain.step(image), kept.step(image)
                np.testing.assert_allclose(found.pose.t_m, expected.pose.t_m, atol=1e-6)
                np.testing.assert_allclose(found.upper, expected.upper, atol=1e-6)


def test_an_input_of_another_form_is_refused(of_openvino):
    with Odometer.load(of_openvino) as odometer:
        spec = odometer.session.inputs[0]
        for image in (np.zeros((1, 1, 1, 3), np.uint8), np.zeros(spec.shape, np.float32)):
            with pytest.raises(ModelError, match="inference failed"):
                odometer.session.run({spec.name: image})


def test_without_the_package_one_line_says_what_to_install(of_openvino):
    without = (
        "import sys; sys.modules['openvino'] = None; from cvo_edge.__main__ import main; main()"
    )
    command = [
        sys.executable,
        "-c",
        without,
        "run",
        str(of_openvino),
        str(ARTIFACTS / "synthetic-room-clip"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 4
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert "cvo-edge[openvino]" in line


def test_a_forest_is_refused_by_its_name():
    """OpenVINO does not support tree ensembles."""
    bundle = read_bundle(ARTIFACTS / "synthetic-room-cqr")
    with pytest.raises(ModelError, match=r"refused by OpenVINO: .*TreeEnsemble") as caught:
        OpenvinoSession(bundle.model_bytes, 1, bundle.calibration.model)
    assert "\n" not in str(caught.value)


def test_a_model_that_reaches_for_another_file_is_refused(bundle, tmp_path, monkeypatch):
    """OpenVINO itself would read the file, relative to the working directory."""
    np.arange(4, dtype=np.float32).tofile(tmp_path / "secret")
    weights = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[4])
    weights.data_location = TensorProto.EXTERNAL
    for key, value in (("location", "secret"), ("offset", "0"), ("length", "16")):
        weights.external_data.add(key=key, value=value)
    x, y = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [4]) for name in "xy")
    graph = helper.make_graph(
        [helper.make_node("Add", ["x", "w"], ["y"])], "g", [x], [y], [weights]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    content = model.SerializeToString()
    specs = [(TensorSpec(name=name, dtype="float32", shape=(4,)),) for name in "xy"]
    spec = replace(bundle.calibration.model, inputs=specs[0], outputs=specs[1], provider="openvino")
    monkeypatch.chdir(tmp_path)
    core = openvino.Core()
    assert core.compile_model(core.read_model(model=content), "CPU")
    with pytest.raises(ModelError, match="refused by onnxruntime"):
        OpenvinoSession(content, 1, spec)
