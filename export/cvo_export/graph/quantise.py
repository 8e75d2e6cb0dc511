"""A float32 graph -> the same with an 8-bit backbone, by onnxruntime's static quantisation.

Weights are int8, a scale per output channel; feature maps are uint8, a scale each, from the ranges
seen on training frames; both as pairs of QuantizeLinear and DequantizeLinear (QDQ), which every
processor's kernels understand. The head stays in float32: it is a hundredth of the arithmetic, and
its numbers are metres. What 8 bits cost is not hidden: thresholds come from the quantised graph.
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

Feed = Mapping[str, NDArray[np.generic]]

# An activation behind a convolution becomes the range of its output, and costs nothing.
_QUANTISED_KINDS = ("Conv", "Add", "MaxPool", "Relu", "Clip")

# Of an int8 weight, symmetric about zero.
_LARGEST_STEP = 127
_LEAST_WEIGHT = 1e-8


def quantised(content: bytes, feeds: Sequence[Feed]) -> bytes:
    """Return the graph with its backbone in 8 bits.

    The first convolution takes the image's own 8 bits, where the graph begins as our exporter
    writes it, and stays in float32 elsewhere: normalised pixels are not to be rounded once more.
    ``feeds`` are inputs by name, of frames that the ranges of the feature maps are taken from.
    Raises UsageError for a backbone that has nothing to quantise.
    """
    model = onnx.shape_inference.infer_shapes(onnx.load_from_string(content))
    nodes = _backbone_nodes(model)
    convolutions = [node for node in nodes if node.op_type == "Conv"]
    constants = {constant.name for constant in model.graph.initializer}
    computed = [node.name for node in convolutions if node.input[1] not in constants]
    if not convolutions or computed:
        raise UsageError(
            "precision int8: expected a backbone of convolutions with constant weights, found "
            + (f"those of {computed[0]} computed" if computed else "none")
        )
    first = convolutions[0]
    zero = _fold_normalisation(model, first)
    chosen = [node for node in nodes if zero is not None or node is not first]
    _correct_biases(model, [node for node in chosen if node.op_type == "Conv"], feeds)
    kept = list(model.metadata_props)
    # Else it asks on stderr for what the exporter has done: folded normalisations, known shapes.
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
    del found.metadata_props[:]
    found.metadata_props.extend(kept)
    written: bytes = found.SerializeToString()
    return written


def _fold_normalisation(model: ModelProto, first: NodeProto) -> int | None:
    """Put pixel scaling into the first convolution; returns the pixel that is its zero, or None.

    Of (x - mean) / std a convolution takes W / std of x - zero instead, and the rest goes into its
    bias: (W / std) (zero - mean). Where it pads, the border is of that pixel instead of the mean.
    None, and nothing is changed, where the graph does not begin so.
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
    """Let who reads the quantised x - zero read the image's 8 bits, which are the same numbers."""
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
    """Remove constants that no node reads any more."""
    graph = model.graph
    used = {name for node in graph.node for name in node.input}
    kept = [constant for constant in graph.initializer if constant.name in used]
    del graph.initializer[:]
    graph.initializer.extend(kept)


def _correct_biases(
    model: ModelProto, convolutions: list[NodeProto], feeds: Sequence[Feed]
) -> None:
    """Put into each bias what rounded weights change of the mean output, b + (W - W') E[x].

    Nagel et al. 2019 (data-free quantisation), section 4.2, with means seen instead of assumed.
    Feature maps behind a rectifier are far from zero on average, so that the error of a weight is
    first of all a shift: half of all that 8 bits cost.
    """
    constants = {constant.name: constant for constant in model.graph.initializer}
    means = _mean_channels(model, [node.input[0] for node in convolutions], feeds)
    for node in convolutions:
        weight = numpy_helper.to_array(constants[node.input[1]]).astype(np.float64)
        largest = np.abs(weight).max(axis=(1, 2, 3), keepdims=True)
        step = np.maximum(largest, _LEAST_WEIGHT) / _LARGEST_STEP
        lost = (weight - step * np.round(weight / step)).sum(axis=(2, 3))
        # Of a grouped convolution each output sees the inputs of its group.
        group = next((a.i for a in node.attribute if a.name == "group"), 1)
        inputs = means[node.input[0]].reshape(group, -1).repeat(len(weight) // group, axis=0)
        shift = (lost * inputs).sum(axis=1)
        if len(node.input) == 2:
            # An exporter leaves out a bias of zeros.
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
    """Mean of every channel of these feature maps over frames and pixels, (channels,) each."""
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
    """Feeds one after the other, as onnxruntime asks for them."""

    def __init__(self, feeds: Sequence[Feed]) -> None:
        self._feeds: Iterator[Feed] = iter(feeds)

    def get_next(self) -> Feed | None:
        """Return the next feed, None behind the last."""
        return next(self._feeds, None)


def _backbone_nodes(model: ModelProto) -> list[NodeProto]:
    """Nodes that work on feature maps: those of four dimensions, of the kinds above."""
    rank = {value.name: len(value.type.tensor_type.shape.dim) for value in model.graph.value_info}
    return [
        node
        for node in model.graph.node
        if node.op_type in _QUANTISED_KINDS and rank.get(node.output[0]) == 4
    ]
