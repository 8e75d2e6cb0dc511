"""Let the first convolution of an 8-bit graph read the image's rows in blocks of four bytes.

onnxruntime's fast 8-bit convolution takes a multiple of four input channels and of sixteen output
channels. For the three channels of an image it first copies the pixels of every output into a
matrix, which takes longer than the multiplication. But a row of pixels is also a row of four-byte
blocks. An output of the rewritten convolution consists of several neighbouring outputs of the
original one; its weights are zero where a block extends beyond their pixels. The integer sums stay
the same, and so does every output of the graph.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, numpy_helper

from cvo_export.graph.nodes import Nodes
from cvo_export.graph.tensors import own_inputs, sizes

_BLOCK, _COLOURS, _OUTPUTS = 4, 3, 16


class _Plan(NamedTuple):
    """Geometry of the rewritten convolution; lengths along a row in blocks.

    Attributes
    ----------
    together
        Neighbouring outputs of the original in one output.
    kernel, stride, left, right
        Length of the kernel, its step, and the padding of a row on both sides.
    skipped
        Bytes of the kernel before the first pixel of its first output.
    apart
        Bytes from an output's first pixel to that of the next output.
    rows, columns
        Size of the original's output.
    """

    together: int
    kernel: int
    stride: int
    left: int
    right: int
    skipped: int
    apart: int
    rows: int
    columns: int


def read_blocks(model: ModelProto, convolution: NodeProto) -> None:
    """Rewrite a convolution whose input, weights and bias each come from a DequantizeLinear.

    The first of them reads the transposed image, (1, height, width, 3) uint8. Without effect if the
    output is not only quantised, or a size is not a multiple of the blocks.
    """
    graph = model.graph
    made = {output: node for node in graph.node for output in node.output}
    constants = {constant.name: numpy_helper.to_array(constant) for constant in graph.initializer}
    pixels, weight, bias = (made[name] for name in convolution.input)
    transpose = made[pixels.input[0]]
    image = next(value for value in own_inputs(model) if value.name == transpose.input[0])
    readers = [node for node in graph.node if convolution.output[0] in node.input]
    height, width = sizes(image)[1:3]
    kernel = constants[weight.input[0]]
    plan = _plan(convolution, kernel.shape, height, width)
    if [node.op_type for node in readers] != ["QuantizeLinear"] or plan is None:
        return
    nodes = Nodes("blocks/")
    for node in (weight, bias):
        values = [np.tile(constants[name], plan.together) for name in node.input[1:]]
        first = constants[node.input[0]]
        whole = _in_blocks(kernel, plan) if node is weight else np.tile(first, plan.together)
        node.input[:] = map(nodes.constant, (whole, *values))
    for each in convolution.attribute:
        if each.name in ("kernel_shape", "strides"):
            each.ints[1] = plan.kernel if each.name == "kernel_shape" else plan.stride
        elif each.name == "pads":
            each.ints[1], each.ints[3] = plan.left, plan.right
    shape = np.array([1, height, _COLOURS * width // _BLOCK, _BLOCK])
    transpose.input[0] = nodes("Reshape", image.name, nodes.constant(shape))
    _insert(model, transpose, nodes.taken())
    quantise = readers[0]
    result, quantise.output[0] = quantise.output[0], "blocks/maps"
    by_pixel = nodes("Transpose", quantise.output[0], perm=[0, 2, 3, 1])
    shape = np.array([1, plan.rows, plan.columns, len(kernel)])
    by_pixel = nodes("Reshape", by_pixel, nodes.constant(shape))
    nodes.name(nodes("Transpose", by_pixel, perm=[0, 3, 1, 2]), result)
    _forget_shapes(model, (*transpose.output, *convolution.input, *convolution.output))
    after = list(graph.node).index(quantise) + 1
    _insert(model, graph.node[after], nodes.taken())
    graph.initializer.extend(nodes.constants)


def _plan(convolution: NodeProto, shape: tuple[int, ...], height: int, width: int) -> _Plan | None:
    """Return the geometry, or None if this convolution cannot be rewritten."""
    settings = {each.name: list(each.ints) for each in convolution.attribute}
    (down, along), (top, left, bottom, right) = settings["strides"], settings["pads"]
    outputs, channels, tall, long = shape
    rows = (height + top + bottom - tall) // down + 1
    columns = (width + left + right - long) // along + 1
    apart = _COLOURS * along
    together = _BLOCK // math.gcd(_BLOCK, apart)
    row = _COLOURS * width
    if (
        channels != _COLOURS
        or settings["dilations"] != [1, 1]
        or row % _BLOCK
        or columns % together
        or outputs * together % _OUTPUTS
    ):
        return None
    # Bytes from the begin of the row, of the pixels that the first output reads.
    begin, end = -_COLOURS * left, (together - 1) * apart + _COLOURS * (long - left)
    first, last = begin // _BLOCK, -(-end // _BLOCK)
    kernel, stride = last - first, together * apart // _BLOCK
    beyond = first + (columns // together - 1) * stride + kernel - row // _BLOCK
    # A kernel may end before the row does.
    right = max(beyond, 0)
    return _Plan(
        together, kernel, stride, -first, right, begin - first * _BLOCK, apart, rows, columns
    )


def _in_blocks(kernel: NDArray[Any], plan: _Plan) -> NDArray[Any]:
    """Weights (n, 3, rows, columns) -> (together n, 4, rows, blocks)."""
    outputs, _, tall, long = kernel.shape
    by_byte = kernel.transpose(0, 2, 3, 1).reshape(outputs, tall, _COLOURS * long)
    wide = np.zeros((plan.together, outputs, tall, plan.kernel * _BLOCK), kernel.dtype)
    for number in range(plan.together):
        begin = plan.skipped + number * plan.apart
        wide[number, :, :, begin : begin + by_byte.shape[2]] = by_byte
    return wide.reshape(-1, tall, plan.kernel, _BLOCK).transpose(0, 3, 1, 2)


def _forget_shapes(model: ModelProto, names: tuple[str, ...]) -> None:
    """Remove what the graph states of results that now have another shape."""
    kept = [value for value in model.graph.value_info if value.name not in names]
    del model.graph.value_info[:]
    model.graph.value_info.extend(kept)


def _insert(model: ModelProto, before: NodeProto, nodes: list[NodeProto]) -> None:
    """Insert nodes before another one."""
    place = list(model.graph.node).index(before)
    for node in reversed(nodes):
        model.graph.node.insert(place, node)
