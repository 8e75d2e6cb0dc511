"""Inference with OpenVINO, for bundles that were calibrated with it.

In 8 bits it is faster than onnxruntime on some processors (``docs/performance.md``). Thresholds
cannot be shared between the two, because their 8-bit results differ.
"""

from __future__ import annotations

import io
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import ModelSpec
from cvo_edge.engine.cores import checked_threads
from cvo_edge.engine.model_cache import GRAPH_FILE, WEIGHTS_FILE, CachedModel
from cvo_edge.engine.session import Session, one_line
from cvo_edge.errors import ModelError


class OpenvinoSession(Session):
    """One loaded model; parameters, attributes and errors are those of ``Session``.

    ``at_once`` is the number of threads that call it concurrently; each call uses ``threads``
    threads. A cached model is a compiled one, which serves every number of threads.
    """

    def __init__(
        self,
        model: bytes | CachedModel,
        threads: int | None,
        expected: ModelSpec,
        *,
        at_once: int = 1,
        keep_in: Path | None = None,
    ) -> None:
        try:
            from openvino import Core, Type
        # An older or incomplete installation may raise any exception.
        except Exception as error:
            raise ModelError(
                "model.provider: the bundle needs openvino 2026.4 or newer, but its import failed: "
                f'{one_line(error)}; run pip install "cvo-edge[openvino]"'
            ) from None
        if isinstance(model, bytes):
            # OpenVINO would read files that a model names as external data from the current folder;
            # an onnxruntime session refuses such a model.
            Session(model, 1, expected)
        self.threads = checked_threads(threads)
        settings = {
            "PERFORMANCE_HINT": "LATENCY" if at_once == 1 else "THROUGHPUT",
            "NUM_STREAMS": at_once,
            "INFERENCE_NUM_THREADS": self.threads * at_once,
            # By default OpenVINO computes in bfloat16 if the processor supports it.
            "INFERENCE_PRECISION_HINT": Type.f32,
        }
        try:
            core = Core()
            if isinstance(model, CachedModel):
                self.engine = core.import_model(model.graph, "CPU", settings)
            else:
                self.engine = core.compile_model(core.read_model(model=model), "CPU", settings)
            precision = self.engine.get_property("INFERENCE_PRECISION_HINT")
        # OpenVINO raises a RuntimeError of many lines; the cause follows the list of locations.
        except Exception as error:
            summary = str(error).rpartition("Summary:")[2]
            raise ModelError(f"model.onnx: refused by OpenVINO: {one_line(summary)}") from None
        if precision != Type.f32:
            raise ModelError(f"model.onnx: expected OpenVINO to compute in f32, found {precision}")
        self._declare(_ports(self.engine.inputs), _ports(self.engine.outputs), expected)
        self._requests = threading.local()
        if keep_in is not None:
            self._keep(keep_in)

    def _keep(self, folder: Path) -> None:
        compiled = io.BytesIO()
        self.engine.export_model(compiled)
        try:
            (folder / GRAPH_FILE).write_bytes(compiled.getvalue())
            (folder / WEIGHTS_FILE).touch()
        except OSError as error:
            raise ModelError(f"{folder}: cannot be written: {error.strerror}") from None

    def _call(self, feeds: Mapping[str, NDArray[np.generic]]) -> Sequence[Any]:
        # A request serves one call at a time.
        if not hasattr(self._requests, "own"):
            self._requests.own = self.engine.create_infer_request()
        request = self._requests.own
        # OpenVINO's own conversion of inputs and outputs takes longer than these copies.
        for name, values in feeds.items():
            target = request.get_tensor(name).data
            if target.shape != values.shape:
                raise ValueError(f"expected {name} {target.shape}, found {values.shape}")
            np.copyto(target, values, casting="no")
        request.infer()
        return [request.get_tensor(name).data.copy() for name in self._names]


def _ports(ports: Sequence[Any]) -> list[tuple[str, str, list[Any]]]:
    return [
        (
            port.any_name,
            port.get_element_type().get_type_name(),
            [size.get_length() if size.is_static else str(size) for size in port.partial_shape],
        )
        for port in ports
    ]
