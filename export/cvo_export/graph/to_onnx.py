"""Export torch modules to ONNX with fixed names and opset, and check that both agree."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from onnxscript import opset18 as op
from timm.utils.model import reparameterize_model
from torch import Tensor, nn

from cvo_edge.engine.session import Session
from cvo_edge.errors import GateError

OPSET = 18

# Largest difference between torch and onnxruntime in float32, as a part of the number itself, or
# absolute (m, rad, quaternion units) for numbers below 1. They round differently because
# they compute in a different order, and 20 m are rounded 20 times as coarsely as 1 m.
PARITY_TOLERANCE = 1e-4


def _softplus(x: Any, beta: float = 1.0, _threshold: float = 20.0) -> Any:  # noqa: ANN401
    """Translate torch's softplus to one node, where the exporter makes three.

    ONNX's needs no threshold: it is exact for large numbers, too.
    """
    if beta != 1.0:
        raise GateError(f"export: expected softplus with beta 1, found {beta:g}")
    return op.Softplus(x)


def export_onnx(
    module: nn.Module,
    inputs: Sequence[Tensor],
    input_names: Sequence[str],
    output_names: Sequence[str],
) -> bytes:
    """Export a module for inputs of exactly these shapes; returns the content of an ONNX file.

    Branches that a network has for training alone (RepViT, MobileOne, FastViT) become one
    convolution, in a copy.
    """
    module = reparameterize_model(module.eval())
    # The exporter reports its progress on stdout, which is reserved for our data, and to a logger.
    exporter_log = logging.getLogger("torch.onnx")
    level = exporter_log.level
    exporter_log.setLevel(logging.ERROR)
    try:
        with (
            torch.no_grad(),
            warnings.catch_warnings(),
            contextlib.redirect_stdout(io.StringIO()),
        ):
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                module,
                tuple(inputs),
                input_names=list(input_names),
                output_names=list(output_names),
                opset_version=OPSET,
                custom_translation_table={torch.ops.aten.softplus.default: _softplus},
                dynamo=True,
                verbose=False,
            )
    finally:
        exporter_log.setLevel(level)
    if program is None:
        raise GateError("export: expected a graph from torch.onnx, but it returned nothing")
    proto = program.model_proto
    # Source file names and line numbers of this machine are useless on a board.
    for node in proto.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    del proto.graph.metadata_props[:]
    for value in (*proto.graph.value_info, *proto.graph.input, *proto.graph.output):
        del value.metadata_props[:]
    content: bytes = proto.SerializeToString()
    return content


def check_parity(
    module: nn.Module,
    session: Session,
    feeds: Iterable[dict[str, NDArray[np.generic]]],
    input_names: Sequence[str],
    output_names: Sequence[str],
    points: Collection[str] = (),
) -> float:
    """Return the largest difference between torch's outputs and the same of the exported graph.

    It is relative to each number that exceeds 1, and absolute for the others; in the outputs
    ``points`` (..., 3), it is relative to the point's distance from the origin instead. Raises
    GateError if it exceeds ``PARITY_TOLERANCE`` or is NaN.
    """
    worst = 0.0
    module.eval()
    for feed in feeds:
        found = session.run(feed)
        with torch.no_grad():
            expected = module(*(torch.from_numpy(feed[name]) for name in input_names))
        for name, tensor in zip(output_names, expected, strict=True):
            values = tensor.numpy()
            size = np.abs(values)
            if name in points:
                size = np.linalg.norm(values, axis=-1, keepdims=True)
            # Infinite numbers give NaN, which is refused.
            with np.errstate(invalid="ignore"):
                ratio = np.abs(values - found[name]) / np.maximum(1.0, size)
            difference = float(ratio.max())
            worst = max(worst, difference) if difference == difference else np.inf
    if not worst <= PARITY_TOLERANCE:
        raise GateError(
            f"export: expected torch and onnxruntime to agree within {PARITY_TOLERANCE:g}, "
            f"relative to numbers above 1, found a difference of {worst:.3g}"
        )
    return worst
