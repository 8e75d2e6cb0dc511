"""Quantisation: which nodes have 8 bits, bias correction, and figures from the quantised graph."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from cvo_edge.conformal import conformal_quantile
from cvo_edge.engine import session
from cvo_edge.engine.loading import read_bundle
from cvo_edge.engine.selftest import check_selftest
from cvo_edge.engine.session import Session
from cvo_edge.errors import UsageError
from cvo_edge.odometer import Odometer
from cvo_export.bundles.observed import observe
from cvo_export.graph.quantise import quantised
from cvo_export.graph.to_onnx import export_onnx
from cvo_export.networks.backbone import Backbone, BackboneConfig
from cvo_export.networks.heads.cqr import CqrConfig
from cvo_export.publish import publish
from cvo_export.training.loop import train

from .conftest import ignore_progress, tiny_config


class Maps(nn.Module):
    """Three convolutions, one of them depthwise; the output is the mean of the last maps."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.first = nn.Conv2d(3, 16, 3, padding=1)
        self.by_channel = nn.Conv2d(16, 16, 3, padding=1, groups=16)
        self.last = nn.Conv2d(16, 8, 1)
        # Channels differ greatly in magnitude, as after a folded normalisation.
        with torch.no_grad():
            self.by_channel.weight *= torch.logspace(-1, 1.5, 16)[:, None, None, None]

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the means of the last maps (n, 8) for images (n, height, width, 3)."""
        x = image.permute(0, 3, 1, 2).float() / 127.5 - 1.0
        x = torch.clamp(self.first(x), 0.0, 6.0)
        x = torch.clamp(self.by_channel(x), 0.0, 6.0)
        return self.last(x).mean(dim=(2, 3))


@pytest.fixture(scope="module")
def both():
    """The float32 graph, the quantised graph, and the feeds used for quantisation."""
    image = torch.zeros((1, 24, 32, 3), dtype=torch.uint8)
    content = export_onnx(Maps().eval(), [image], ["image"], ["features"])
    generator = np.random.default_rng(0)
    feeds = [
        {"image": generator.integers(0, 256, (1, 24, 32, 3)).astype(np.uint8)} for _ in range(16)
    ]
    return content, quantised(content, feeds), feeds


def kinds(content):
    return [node.op_type for node in onnx.load_from_string(content).graph.node]


def backbone_graph(normalisation):
    """Return a small network in the exporter's form, with pixel scaling first, and its feeds."""
    config = BackboneConfig(stages=("8",), grid=(1, 1), normalisation=normalisation)
    torch.manual_seed(0)
    image = torch.zeros((1, 48, 64, 3), dtype=torch.uint8)
    content = export_onnx(Backbone(config, 48, 64).eval(), [image], ["image"], ["features"])
    generator = np.random.default_rng(0)
    feeds = [
        {"image": generator.integers(0, 256, (1, 48, 64, 3)).astype(np.uint8)} for _ in range(16)
    ]
    return content, feeds


@pytest.mark.parametrize("normalisation", ["half", "timm"])
def test_every_convolution_is_in_eight_bits_and_the_first_takes_the_pixels(normalisation):
    content, feeds = backbone_graph(normalisation)
    small = quantised(content, feeds)
    model = onnx.load_from_string(small)
    made = {output: node for node in model.graph.node for output in node.output}
    constants = {constant.name: constant for constant in model.graph.initializer}
    convolutions = [node for node in model.graph.node if node.op_type == "Conv"]
    for node in convolutions:
        weight = constants[made[node.input[1]].input[0]]
        assert weight.data_type == onnx.TensorProto.INT8
        # Every channel has its own scale.
        assert list(constants[made[node.input[1]].input[1]].dims) == list(weight.dims[:1])
    pixels = made[convolutions[0].input[0]]
    assert pixels.op_type == "DequantizeLinear"
    blocks = made[made[pixels.input[0]].input[0]]
    assert (blocks.op_type, blocks.input[0]) == ("Reshape", "image")
    assert not {"Cast", "Sub", "Div"} & set(kinds(small))
    # Every remaining constant is used.
    read = {name for node in model.graph.node for name in node.input}
    assert set(constants) <= read
    plain, eight = Session(content, 1), Session(small, 1)
    expected = np.concatenate([plain.run(feed)["features"] for feed in feeds])
    found = np.concatenate([eight.run(feed)["features"] for feed in feeds])
    assert np.abs(found - expected).max() < 0.1 * np.abs(expected).max()


class FirstLayer(nn.Module):
    """One convolution that reads scaled pixels; its output are its maps."""

    def __init__(self, kernel: int, stride: int, padding: int, outputs: int) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.first = nn.Conv2d(3, outputs, kernel, stride, padding)
        self.mean = nn.Buffer(torch.tensor([120.0, 115.0, 100.0])[:, None, None])
        self.second = nn.Conv2d(outputs, 4, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the maps for images (1, height, width, 3)."""
        x = (image.permute(0, 3, 1, 2).float() - self.mean) / 60.0
        return self.second(torch.relu(self.first(x)))


@pytest.mark.parametrize(
    ("kernel", "stride", "padding", "outputs", "width", "rewritten"),
    [
        (3, 2, 1, 32, 32, True),
        (3, 2, 0, 8, 36, False),  # 17 outputs in a row, two together
        (3, 2, 0, 8, 40, False),
        (2, 2, 0, 8, 40, True),
        (7, 2, 3, 64, 32, True),
        (3, 1, 1, 4, 32, True),
        (4, 4, 0, 16, 32, True),
        (5, 4, 2, 16, 28, True),
        (3, 2, 1, 12, 32, False),  # 24 output channels
        (3, 2, 1, 32, 30, False),  # 90 bytes in a row
    ],
)
def test_reading_blocks_instead_of_pixels_changes_no_number(
    kernel, stride, padding, outputs, width, rewritten
):
    image = torch.zeros((1, 20, width, 3), dtype=torch.uint8)
    layer = FirstLayer(kernel, stride, padding, outputs).eval()
    content = export_onnx(layer, [image], ["image"], ["maps"])
    generator = np.random.default_rng(0)
    feeds = [{"image": generator.integers(0, 256, image.shape).astype(np.uint8)} for _ in range(4)]
    plain, in_blocks = (quantised(content, feeds, each) for each in ("openvino", "onnxruntime"))
    assert ("Reshape" in kinds(in_blocks)) == rewritten
    # Shapes that the graph still states are true.
    onnx.shape_inference.infer_shapes(onnx.load_from_string(in_blocks), strict_mode=True)
    plain, in_blocks = Session(plain, 1), Session(in_blocks, 1)
    for feed in feeds:
        np.testing.assert_array_equal(plain.run(feed)["maps"], in_blocks.run(feed)["maps"])


def test_where_the_graph_begins_otherwise_the_first_convolution_stays_float(both):
    content, small, _ = both
    model = onnx.load_from_string(small)
    made = {output: node for node in model.graph.node for output in node.output}
    constants = {constant.name: constant for constant in model.graph.initializer}
    first, *others = [node for node in model.graph.node if node.op_type == "Conv"]
    assert first.input[1] in constants
    assert len(others) == 2
    for node in others:
        assert made[node.input[1]].op_type == "DequantizeLinear"
    assert "QuantizeLinear" not in kinds(content)


def mean_shift(content, small, feeds):
    """Return the largest change of an output's mean over the feeds."""
    plain, eight = Session(content, 1), Session(small, 1)
    differences = [eight.run(feed)["features"] - plain.run(feed)["features"] for feed in feeds]
    return float(np.abs(np.mean(differences, axis=0)).max())


def test_the_mean_output_stays_where_it_was(both, monkeypatch):
    content, small, feeds = both
    monkeypatch.setattr("cvo_export.graph.quantise._correct_biases", lambda *_: None)
    uncorrected = quantised(content, feeds)
    assert mean_shift(content, small, feeds) < 0.3 * mean_shift(content, uncorrected, feeds)


def test_nothing_of_the_quantiser_is_left_in_the_file(both):
    model = onnx.load_from_string(both[1])
    assert [entry.key for entry in model.metadata_props] == []


@pytest.mark.parametrize("head", [None, CqrConfig(trees=10)])
def test_an_eight_bit_bundle_is_calibrated_as_such(head, tmp_path, tiny_run):
    run = tiny_run
    if head is not None:
        run = train(tmp_path / "run", tiny_config(head=head, steps=100), ignore_progress)
    publish(run, tmp_path / "fp32", "plain")
    calibration = publish(run, tmp_path / "int8", "eight bits", precision="int8")
    plain = read_bundle(tmp_path / "fp32")
    assert (plain.calibration.model.precision, calibration.model.precision) == ("fp32", "int8")
    assert "QuantizeLinear" in kinds(read_bundle(tmp_path / "int8").model_bytes)
    with Odometer.load(tmp_path / "int8") as odometer:
        assert check_selftest(odometer) < calibration.selftest.tolerance
        seen = observe(odometer, run.dataset, run.split.roles["cal"])
        scores = odometer.head.scores(seen.outputs, seen.point, seen.truth)
        stored = calibration.threshold(0.9, "marginal").q_hat
        assert list(stored) == [conformal_quantile(scores[:, 0, dof], 0.9) for dof in range(6)]
    assert stored != plain.calibration.threshold(0.9, "marginal").q_hat


def test_the_runtimes_question_to_the_processor_is_this_product():
    ones = numpy_helper.from_array(np.full((32, 1), 127, np.int8), "b")
    graph = helper.make_graph(
        [helper.make_node("MatMulInteger", ["a", "b"], ["y"])],
        "g",
        [helper.make_tensor_value_info("a", TensorProto.UINT8, [1, 32])],
        [helper.make_tensor_value_info("y", TensorProto.INT32, [1, 1])],
        [ones],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    model.ClearField("producer_name")
    assert onnx.load_from_string(session._PRODUCT) == model


def test_a_backbone_without_constant_weights_is_refused_in_one_line():
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 8, 8])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 4, 1, 1])
    w = numpy_helper.from_array(np.ones((4, 3, 3, 3), np.float32), "w")
    nodes = [
        helper.make_node("Relu", ["w"], ["computed"]),
        helper.make_node("Conv", ["x", "computed"], ["maps"], name="standardised"),
        helper.make_node("GlobalAveragePool", ["maps"], ["y"]),
    ]
    graph = helper.make_graph(nodes, "g", [x], [y], [w])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    with pytest.raises(UsageError, match=r"expected .* found computed weights in standardised"):
        quantised(model.SerializeToString(), [{"x": np.zeros((1, 3, 8, 8), np.float32)}])
