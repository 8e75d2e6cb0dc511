"""Append the statistics of ``familiarity`` to an exported graph, as ONNX nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from cvo_edge.bundle.format import DEGRADATION_OUTPUT, FAMILIARITY, NOVELTY_OUTPUT
from cvo_export.graph.familiarity import (
    LARGEST_LOGIT,
    LARGEST_NOVELTY,
    Familiarity,
    in_rgb,
    quarters,
)

# Outputs of the exported graph that the statistics read, and that they replace.
CELLS, PIXELS = "cells", "pixels"
_PREFIX = "familiarity/"


def with_familiarity(content: bytes, fitted: Familiarity) -> bytes:
    """Return a model whose outputs ``cells`` and ``pixels`` are replaced by the statistics.

    ``cells`` (1, K, channels) float32 and ``pixels`` (1, rows, columns, 3) uint8; ``novelty``
    (1, 4) and ``degradation`` (1, 1) are float32.
    """
    model = onnx.load_from_string(content)
    graph = model.graph
    shapes = {
        value.name: [dim.dim_value for dim in value.type.tensor_type.shape.dim]
        for value in graph.output
    }
    kept = [value for value in graph.output if value.name not in (CELLS, PIXELS)]
    nodes = _Nodes()
    features = CELLS
    if fitted.basis is not None:
        features = nodes("MatMul", CELLS, nodes.constant(fitted.basis))
    _novelty(nodes, features, fitted, shapes[PIXELS])
    _degradation(nodes, features, fitted)
    graph.node.extend(nodes.nodes)
    graph.initializer.extend(nodes.constants)
    del graph.output[:]
    graph.output.extend(kept)
    for name, shape in FAMILIARITY.items():
        graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
    written: bytes = model.SerializeToString()
    return written


class _Nodes:
    """Nodes and constants under construction; every method returns the name of its result."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._count = 0

    def constant(self, values: Any) -> str:  # noqa: ANN401 - anything numpy takes
        array = np.asarray(values)
        if array.dtype == np.float64:
            array = array.astype(np.float32)
        self._count += 1
        name = f"{_PREFIX}constant_{self._count}"
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def half(self, values: NDArray[np.float16]) -> str:
        """Store 16-bit numbers, which the engine widens once, when it loads the model."""
        return self("Cast", self.constant(values), to=TensorProto.FLOAT)

    def __call__(
        self,
        kind: str,
        *inputs: str,
        name: str | None = None,
        **attributes: Any,  # noqa: ANN401 - anything a node may have
    ) -> str:
        self._count += 1
        output = name or f"{_PREFIX}{kind.lower()}_{self._count}"
        label = f"{_PREFIX}node_{self._count}"
        self.nodes.append(helper.make_node(kind, list(inputs), [output], label, **attributes))
        return output

    def reduced(self, kind: str, value: str, axis: int, *, keep: bool = False) -> str:
        return self(kind, value, self.constant(np.array([axis], np.int64)), keepdims=int(keep))

    def shaped(self, value: str, *shape: int) -> str:
        return self("Reshape", value, self.constant(np.array(shape, np.int64)))


# A node takes microseconds whatever it computes: constants absorb factors and offsets, and one root
# is taken of all squares.
def _novelty(nodes: _Nodes, features: str, fitted: Familiarity, pixels: list[int]) -> None:
    cells, channels = fitted.mean.shape
    centred = nodes("Sub", features, nodes.constant(fitted.mean[np.newaxis]))
    z = nodes("MatMul", nodes.shaped(centred, cells, 1, channels), nodes.half(fitted.projection))
    squares = nodes("Mul", z, z)
    deviations = nodes("MatMul", squares, nodes.constant(fitted.precision[:, :, np.newaxis]))
    top = fitted.prototypes.shape[2]
    first = nodes("Slice", z, *(nodes.constant(np.array([n], np.int64)) for n in (0, top, 2)))
    prototypes = fitted.prototypes.transpose(0, 2, 1)
    product = nodes("MatMul", first, nodes.half(np.ascontiguousarray(-2 * prototypes)))
    lengths = np.square(prototypes.astype(np.float64)).sum(axis=1, keepdims=True)
    distances = nodes("Add", product, nodes.constant(lengths))
    nearest = nodes(
        "Add",
        nodes.reduced("ReduceMin", distances, 2),
        nodes.reduced("ReduceSum", squares, 2),
    )
    deviations = nodes.shaped(deviations, cells, 1)
    parts = (
        nodes.reduced("ReduceMax", nearest, 0, keep=True),
        nodes.reduced("ReduceMax", deviations, 0, keep=True),
        nodes.reduced("ReduceMean", deviations, 0, keep=True),
        _colour(nodes, fitted, pixels),
    )
    bounds = (nodes.constant(np.float32(bound)) for bound in (0.0, LARGEST_NOVELTY**2))
    nodes("Sqrt", nodes("Clip", nodes("Concat", *parts, axis=1), *bounds), name=NOVELTY_OUTPUT)


def _colour(nodes: _Nodes, fitted: Familiarity, pixels: list[int]) -> str:
    _, rows, columns, _ = pixels
    count = rows * columns
    values = nodes.shaped(nodes("Cast", PIXELS, to=TensorProto.FLOAT), count, 3)
    means = nodes("MatMul", nodes.constant(quarters(rows, columns)), values)
    centred = nodes("Sub", values, nodes.reduced("ReduceMean", values, 0, keep=True))
    covariance = nodes("Gemm", centred, centred, transA=1, alpha=1.0 / count)
    numbers = nodes("Concat", nodes.shaped(means, 1, 12), nodes.shaped(covariance, 1, 9), axis=1)
    whitening = in_rgb(fitted.colour_whitening)
    offset = -fitted.colour_mean @ fitted.colour_whitening
    white = nodes("Gemm", numbers, nodes.constant(whitening), nodes.constant(offset))
    return nodes.reduced("ReduceSumSquare", white, 1, keep=True)


def _degradation(nodes: _Nodes, features: str, fitted: Familiarity) -> None:
    cells, channels = fitted.mean.shape
    mean = nodes.reduced("ReduceMean", features, 1)
    deviations = nodes.reduced("ReduceL2", nodes("Sub", features, mean), 1)
    weights = fitted.weights.copy()
    # A deviation is the length of the differences over the root of their number.
    weights[channels:] /= np.sqrt(cells)
    logit = nodes(
        "Gemm",
        nodes("Concat", mean, deviations, axis=1),
        nodes.constant(weights[:, np.newaxis]),
        nodes.constant(np.array([fitted.bias])),
    )
    bounds = (nodes.constant(np.float32(sign * LARGEST_LOGIT)) for sign in (-1.0, 1.0))
    nodes("Clip", logit, *bounds, name=DEGRADATION_OUTPUT)
