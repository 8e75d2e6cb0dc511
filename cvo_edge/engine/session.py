"""Inference with onnxruntime: a session that checks the model it loads.

Other providers implement the same interface in their own modules.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from cvo_edge.bundle.format import Dtype, ModelSpec, TensorSpec
from cvo_edge.engine.cores import checked_threads, cores_of_threads
from cvo_edge.engine.model_cache import GRAPH_FILE, WEIGHTS_FILE, CachedModel
from cvo_edge.errors import BundleMismatchError, ModelError, UsageError

# Nothing is sent over the network.
onnxruntime.disable_telemetry_events()

# Smaller tensors, such as shapes and scales, stay in the graph file.
_SMALL_TENSOR = 1024

# Type names of onnxruntime and of OpenVINO.
_DTYPES: dict[str, Dtype] = {
    "tensor(uint8)": "uint8",
    "tensor(float)": "float32",
    "u8": "uint8",
    "f32": "float32",
}

# Name, type and shape of an input or output as declared; symbolic sizes are not integers.
Port = tuple[str, str, Sequence[Any]]


# y = a b in 8 bits: a (1, 32) uint8, b (32, 1) int8, all 127.
_PRODUCT = (
    b'\x08\x08:t\n\x18\n\x01a\n\x01b\x12\x01y"\rMatMulInteger\x12\x01g'
    b"*+\x08 \x08\x01\x10\x03B\x01bJ " + 32 * b"\x7f" + b"Z\x13\n\x01a\x12\x0e\n\x0c\x08\x02"
    b"\x12\x08\n\x02\x08\x01\n\x02\x08 b\x13\n\x01y\x12\x0e\n\x0c\x08\x06\x12\x08\n\x02\x08\x01"
    b"\n\x02\x08\x01B\x04\n\x00\x10\x12"
)


@cache
def saturates() -> bool:
    """Whether sums of 8-bit products saturate silently on this processor; takes half a millisecond.

    They do on x86 without VNNI, unless a session option forces precise sums, which halves the speed
    on processors that do not need it. The test multiplies, because CPU feature lists do not tell
    which kernels the engine uses.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4
    engine = onnxruntime.InferenceSession(
        _PRODUCT, options, providers=["CPUExecutionProvider"], enable_fallback=0
    )
    (found,) = engine.run(None, {"a": np.full((1, 32), 255, np.uint8)})
    return int(found[0, 0]) != 32 * 255 * 127


# Open sessions of this process.
_OPEN: WeakSet[Session] = WeakSet()


def _abandon() -> None:
    """Disable, in a forked process, the sessions of its parent.

    Their threads do not exist in the child, so running or destroying such a session may block
    forever; therefore these objects are never freed.
    """
    for session in _OPEN:
        session.forked = True
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(session))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_abandon)


class Session:
    """One loaded model.

    Parameters
    ----------
    model
        The model's bytes or a cached model, never a path: the bytes that run are those whose
        digest was checked, and a model cannot open other files.
    threads
        Threads of one inference; all allowed cores by default.
    expected
        The calibration's description of inputs and outputs; None skips the comparison.
    spinning
        Whether threads busy-wait for each other within an inference: faster, but uses more
        processor time.
    keep_in
        Folder that the cached model is written to, for a cache.

    Attributes
    ----------
    engine
        The bare ``onnxruntime.InferenceSession``, for comparison in benchmarks.
    inputs, outputs
        The tensors that the model declares.
    caller_core
        The core, if any, that the calling thread moves to during a call.
    forked
        Whether this process was forked from the one that loaded the model; it cannot run it.

    Raises
    ------
    ModelError
        onnxruntime refuses the model.
    BundleMismatchError
        Names, types or shapes differ from ``expected``.
    """

    caller_core: frozenset[int] = frozenset()

    def __init__(
        self,
        model: bytes | CachedModel,
        threads: int | None = None,
        expected: ModelSpec | None = None,
        *,
        spinning: bool = True,
        keep_in: Path | None = None,
    ) -> None:
        self.threads = checked_threads(threads)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = self.threads
        options.inter_op_num_threads = 1
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
        # Spinning between frames uses four times the processor time at camera rate. This option
        # keeps the speed within a call and releases the cores after it.
        options.add_session_config_entry("session.force_spinning_stop", "1")
        options.add_session_config_entry("session.intra_op.allow_spinning", str(int(spinning)))
        others_of_process = [core for session in _OPEN for core in session.caller_core]
        cores = cores_of_threads(self.threads, others_of_process)
        if cores:
            self._cores = set(cores)
            # All cores but the caller's; onnxruntime counts them from one.
            others = ";".join(str(core + 1) for core in cores[1:])
            options.add_session_config_entry("session.intra_op_thread_affinities", others)
            # If threads sleep while they wait, the scheduler places the caller better.
            self.caller_core = frozenset(cores[:1] if spinning else ())
        options.log_severity_level = 4
        if keep_in is not None:
            options.optimized_model_filepath = str(keep_in / GRAPH_FILE)
            prefix = "session.optimized_model_external_initializers_"
            options.add_session_config_entry(prefix + "file_name", WEIGHTS_FILE)
            options.add_session_config_entry(prefix + "min_size_in_bytes", str(_SMALL_TENSOR))
        if isinstance(model, CachedModel):
            content, weights = model.graph, str(model.folder)
            options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        else:
            # By default, a model's external data would be read from the current folder.
            content, weights = model, os.devnull
            # Set for every precision; the graph of a cached model already includes it.
            if saturates():
                options.add_session_config_entry("session.x64quantprecision", "1")
        key = "session.model_external_initializers_file_folder_path"
        options.add_session_config_entry(key, weights)
        try:
            # The fallback would print to stdout and load the same model again.
            self.engine = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"], enable_fallback=0
            )
            inputs, outputs = (
                [(each.name, each.type, each.shape) for each in ports]
                for ports in (self.engine.get_inputs(), self.engine.get_outputs())
            )
        # onnxruntime raises a dozen unrelated types here, including UnicodeDecodeError.
        except Exception as error:
            raise ModelError(f"model.onnx: refused by onnxruntime: {one_line(error)}") from None
        self._declare(inputs, outputs, expected)

    def _declare(
        self, inputs: Sequence[Port], outputs: Sequence[Port], expected: ModelSpec | None
    ) -> None:
        """Store the declared tensors, after comparing them with the expected ones."""
        self.inputs, self.outputs = _tensors(inputs, "input"), _tensors(outputs, "output")
        if expected is not None:
            _compare("inputs", expected.inputs, self.inputs)
            _compare("outputs", expected.outputs, self.outputs)
        self._names = [spec.name for spec in self.outputs]
        self._shapes = [spec.shape for spec in self.outputs]
        self.forked = False
        _OPEN.add(self)

    def run(self, feeds: Mapping[str, NDArray[np.generic]]) -> dict[str, NDArray[np.float32]]:
        """Input arrays by name -> output arrays by name.

        Raises ModelError if inference fails, and UsageError in a forked process.
        """
        if self.forked:
            raise UsageError(
                "session: this process was forked after the model was loaded; load it again in "
                "this process"
            )
        try:
            values = self._call(feeds)
        except Exception as error:
            raise ModelError(f"model.onnx: inference failed: {one_line(error)}") from None
        # A model may declare one shape and return another.
        for name, shape, value in zip(self._names, self._shapes, values, strict=True):
            if value.shape != shape:
                raise ModelError(
                    f"model.onnx: expected the declared shape {list(shape)} for {name}, found "
                    f"{list(value.shape)}"
                )
        return dict(zip(self._names, values, strict=True))

    def _call(self, feeds: Mapping[str, NDArray[np.generic]]) -> Sequence[Any]:
        """Input arrays by name -> output arrays in the order of ``outputs``."""
        if not self.caller_core:
            return self.engine.run(self._names, feeds)  # type: ignore[no-any-return]
        # The calling thread runs on the one core that no inference thread is pinned to, unless its
        # owner has given it others since the model was loaded.
        pinned = os.sched_getaffinity(0) == self._cores
        if pinned:
            try:
                os.sched_setaffinity(0, self.caller_core)
            except OSError:
                # This process may no longer use that core.
                pinned, self.caller_core = False, frozenset()
        try:
            return self.engine.run(self._names, feeds)  # type: ignore[no-any-return]
        finally:
            # Nor is a change undone that was made during the call.
            if pinned and os.sched_getaffinity(0) == self.caller_core:
                with contextlib.suppress(OSError):
                    os.sched_setaffinity(0, self._cores)


def _tensors(ports: Sequence[Port], kind: str) -> tuple[TensorSpec, ...]:
    tensors = []
    for name, type_name, shape in ports:
        if type_name not in _DTYPES or not all(isinstance(size, int) for size in shape):
            raise BundleMismatchError(
                f"model.onnx: expected uint8 or float32 {kind}s with fixed shapes, "
                f"found {name} {type_name} {list(shape)}"
            )
        tensors.append(TensorSpec(name=name, dtype=_DTYPES[type_name], shape=tuple(shape)))
    return tuple(tensors)


def _compare(what: str, expected: tuple[TensorSpec, ...], found: tuple[TensorSpec, ...]) -> None:
    if sorted(expected, key=_name) != sorted(found, key=_name):
        raise BundleMismatchError(
            f"model.onnx: expected {what} {_listed(expected)} (from calibration.json), "
            f"found {_listed(found)}"
        )


def _name(spec: TensorSpec) -> str:
    return spec.name


def _listed(tensors: tuple[TensorSpec, ...]) -> str:
    return ", ".join(f"{spec.name} {spec.dtype} {list(spec.shape)}" for spec in tensors)


def one_line(error: Exception | str) -> str:
    """Return an engine's message as one line of bounded length."""
    line = " ".join(str(error).split())
    return line if len(line) <= 200 else line[:197] + "..."
