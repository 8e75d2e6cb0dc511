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

Feed = Mapping[str, NDArray[np.generic]]

# An activation behind a convolution becomes the range of its output, and costs nothing.
_QUANTISED_KINDS = ("Conv", "Add", "MaxPool", "Relu", "Clip")

# Of an int8 weight, symmetric about zero.
_LARGEST_STEP = 127
_LEAST_WEIGHT = 1e-8


def quantised(content: bytes, feeds: Sequence[Feed]) -> bytes:
    """Return the graph with its backbone in 8 bits, but for its first convolution.

    That one sees the image itself, whose 8 bits are not to be rounded once more. ``feeds`` are
    inputs by name, of frames that the ranges of the feature maps are taken from.
    """
    model = onnx.shape_inference.infer_shapes(onnx.load_from_string(content))
    nodes = _backbone_nodes(model)
    first = next(node for node in nodes if node.op_type == "Conv")
    chosen = [node for node in nodes if node is not first]
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
    del found.metadata_props[:]
    found.metadata_props.extend(kept)
    written: bytes = found.SerializeToString()
    return written


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
    used = {name for node in model.graph.node for name in node.input}
    for name, constant in constants.items():
        if name not in used:
            model.graph.initializer.remove(constant)


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
