"""Quantise the backbone of a float32 graph to 8 bits with onnxruntime's static quantisation.

Weights are int8 with one scale per output channel; feature maps are uint8 with one scale each, from
their ranges on training frames. Both use pairs of QuantizeLinear and DequantizeLinear (QDQ), which
the kernels of every processor support. The head stays in float32, because its outputs are metres
and it takes a hundredth of the arithmetic; layers that a head applies to every cell of a map count
as the backbone. Thresholds come from the quantised graph, so they include the quantisation error.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, helper, numpy_helper
from onnxruntime.quantization import (
    CalibrationDataReader,
    CalibrationMethod,
    QuantFormat,
    QuantType,
    quantize_static,
)
from onnxruntime.quantization.quant_utils import add_pre_process_metadata

from cvo_edge.errors import UsageError
from cvo_edge.vocabulary import Provider
from cvo_export.graph.first_convolution import read_blocks

Feed = Mapping[str, NDArray[np.generic]]

# An activation after a convolution is folded into the range of its output, at no cost.
_QUANTISED_KINDS = ("Conv", "Add", "MaxPool", "Relu", "Clip")

# Largest int8 weight, symmetric about zero.
_LARGEST_STEP = 127
_LEAST_WEIGHT = 1e-8


def quantised(content: bytes, feeds: Sequence[Feed], provider: Provider = "onnxruntime") -> bytes:
    """Return the graph with its backbone in 8 bits.

    If the graph begins as our exporter writes it, the first convolution reads the image's 8-bit
    values directly, for onnxruntime in blocks (``first_convolution``; OpenVINO would be slower).
    Otherwise it stays in float32, so that normalised pixels are not rounded again. ``feeds`` are
    the inputs by name of the frames that give the ranges of the feature maps.

    Raises UsageError if the backbone has no convolution, or one with computed weights.
    """
    model = onnx.shape_inference.infer_shapes(onnx.load_from_string(content))
    nodes = _backbone_nodes(model)
    convolutions = [node for node in nodes if node.op_type == "Conv"]
    constants = {constant.name for constant in model.graph.initializer}
    computed = [node.name for node in convolutions if node.input[1] not in constants]
    if not convolutions or computed:
        raise UsageError(
            "precision int8: expected a backbone of convolutions with constant weights, found "
            + (f"computed weights in {computed[0]}" if computed else "no convolution")
        )
    first = convolutions[0]
    zero = _fold_normalisation(model, first)
    chosen = [node for node in nodes if zero is not None or node is not first]
    _correct_biases(model, [node for node in chosen if node.op_type == "Conv"], feeds)
    kept = list(model.metadata_props)
    # Without this mark onnxruntime warns on stderr that the model was not pre-processed, although
    # the exporter has already folded normalisations and inferred shapes.
    add_pre_process_metadata(model)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "model.onnx"
        quantize_static(
            model,
            target,
            _Feeds(feeds),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=list(_QUANTISED_KINDS),
            nodes_to_quantize=[node.name for node in chosen],
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            calibrate_method=CalibrationMethod.MinMax,
        )
        found = onnx.load(target)
    if zero is not None:
        _take_pixels(found, first.input[0], zero)
        if provider == "onnxruntime":
            read_blocks(found, next(node for node in found.graph.node if node.op_type == "Conv"))
            _drop_unused(found)
    del found.metadata_props[:]
    found.metadata_props.extend(kept)
    written: bytes = found.SerializeToString()
    return written


def _fold_normalisation(model: ModelProto, first: NodeProto) -> int | None:
    """Fold the pixel normalisation into the first convolution and return its zero pixel.

    Instead of (x - mean) / std with weights W, the convolution reads x - zero with weights W / std,
    and its bias gains (W / std) (zero - mean). Padding then has the value of the zero pixel instead
    of the mean. Returns None and changes nothing if the graph does not begin with a normalisation.
    """
    graph = model.graph
    constants = {constant.name: constant for constant in graph.initializer}
    made = {output: node for node in graph.node for output in node.output}
    divide = made.get(first.input[0])
    subtract = made.get(divide.input[0]) if divide is not None else None
    cast = made.get(subtract.input[0]) if subtract is not None else None
    chain = [node.op_type if node is not None else "" for node in (cast, subtract, divide)]
    readers = [name for node in graph.node for name in node.input].count(first.input[0])
    if chain != ["Cast", "Sub", "Div"] or readers != 1 or subtract is None or divide is None:
        return None
    mean, std = (
        numpy_helper.to_array(constants[node.input[1]]).astype(np.float64)
        for node in (subtract, divide)
    )
    zero = int(np.clip(np.round(mean.mean()), 0, 255))
    weight = numpy_helper.to_array(constants[first.input[1]]).astype(np.float64) / std
    shift = (weight * (zero - mean)).sum(axis=(1, 2, 3))
    if len(first.input) == 3:
        shift += numpy_helper.to_array(constants[first.input[2]])
    else:
        first.input.append("")
    for index, values in ((1, weight), (2, shift)):
        name = f"{first.name}/of_pixels_{index}"
        graph.initializer.append(numpy_helper.from_array(values.astype(np.float32), name))
        first.input[index] = name
    graph.initializer.append(numpy_helper.from_array(np.array(zero, np.float32), "zero_pixel"))
    subtract.input[1] = "zero_pixel"
    first.input[0] = subtract.output[0]
    graph.node.remove(divide)
    _drop_unused(model)
    return zero


def _take_pixels(model: ModelProto, name: str, zero: int) -> None:
    """Replace the quantised x - zero by the image's 8-bit values, which are the same numbers."""
    graph = model.graph
    made = {output: node for node in graph.node for output in node.output}
    subtract = made[name]
    cast = made[subtract.input[0]]
    quantise = next(n for n in graph.node if n.op_type == "QuantizeLinear" and n.input[0] == name)
    for label, value in (("pixel_scale", np.float32(1.0)), ("pixel_zero", np.uint8(zero))):
        graph.initializer.append(numpy_helper.from_array(np.asarray(value), label))
    for node in graph.node:
        if node.op_type == "DequantizeLinear" and node.input[0] == quantise.output[0]:
            node.input[:] = [cast.input[0], "pixel_scale", "pixel_zero"]
    for node in (quantise, subtract, cast):
        graph.node.remove(node)
    _drop_unused(model)


def _drop_unused(model: ModelProto) -> None:
    """Remove constants that no node reads."""
    graph = model.graph
    used = {name for node in graph.node for name in node.input}
    kept = [constant for constant in graph.initializer if constant.name in used]
    del graph.initializer[:]
    graph.initializer.extend(kept)


def _correct_biases(
    model: ModelProto, convolutions: list[NodeProto], feeds: Sequence[Feed]
) -> None:
    """Correct each bias for the mean error of the rounded weights: b + (W - W') E[x].

    Nagel et al. 2019 (data-free quantisation), section 4.2, with measured instead of assumed means.
    The mean of a feature map after a rectifier is far from zero, so weight errors mainly shift the
    output; this shift is half of the total error of quantisation.
    """
    constants = {constant.name: constant for constant in model.graph.initializer}
    means = _mean_channels(model, [node.input[0] for node in convolutions], feeds)
    for node in convolutions:
        weight = numpy_helper.to_array(constants[node.input[1]]).astype(np.float64)
        largest = np.abs(weight).max(axis=(1, 2, 3), keepdims=True)
        step = np.maximum(largest, _LEAST_WEIGHT) / _LARGEST_STEP
        lost = (weight - step * np.round(weight / step)).sum(axis=(2, 3))
        # In a grouped convolution, each output depends only on the inputs of its group.
        group = next((a.i for a in node.attribute if a.name == "group"), 1)
        inputs = means[node.input[0]].reshape(group, -1).repeat(len(weight) // group, axis=0)
        shift = (lost * inputs).sum(axis=1)
        if len(node.input) == 2:
            # Exporters omit a bias of zeros.
            node.input.append("")
        else:
            shift += numpy_helper.to_array(constants[node.input[2]])
        corrected = numpy_helper.from_array(shift.astype(np.float32), f"{node.name}/corrected_bias")
        node.input[2] = corrected.name
        model.graph.initializer.append(corrected)
    _drop_unused(model)


def _mean_channels(
    model: ModelProto, names: Sequence[str], feeds: Sequence[Feed]
) -> dict[str, NDArray[np.float64]]:
    """Return each feature map's channel means over frames and pixels, (channels,) each."""
    shown = ModelProto()
    shown.CopyFrom(model)
    wanted = list(dict.fromkeys(names))
    shown.graph.output.extend(helper.make_empty_tensor_value_info(name) for name in wanted)
    engine = onnxruntime.InferenceSession(
        shown.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    total = [np.zeros(1)] * len(wanted)
    for feed in feeds:
        maps = engine.run(wanted, feed)
        total = [sums + found.mean(axis=(0, 2, 3)) for sums, found in zip(total, maps, strict=True)]
    return {name: sums / len(feeds) for name, sums in zip(wanted, total, strict=True)}


class _Feeds(CalibrationDataReader):  # type: ignore[misc]
    """Adapts feeds to onnxruntime's calibration interface."""

    def __init__(self, feeds: Sequence[Feed]) -> None:
        self._feeds: Iterator[Feed] = iter(feeds)

    def get_next(self) -> Feed | None:
        """Return the next feed, or None after the last."""
        return next(self._feeds, None)


def _backbone_nodes(model: ModelProto) -> list[NodeProto]:
    """Return the nodes to quantise: the kinds above whose output has four dimensions."""
    rank = {value.name: len(value.type.tensor_type.shape.dim) for value in model.graph.value_info}
    return [
        node
        for node in model.graph.node
        if node.op_type in _QUANTISED_KINDS and rank.get(node.output[0]) == 4
    ]
