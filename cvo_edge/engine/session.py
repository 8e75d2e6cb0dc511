"""The only file that knows onnxruntime: a model -> a session that checks what it is.

Bundles of another provider have their session in a file of its own, behind the same calls.
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
from cvo_edge.cores import checked_threads, cores_of_threads
from cvo_edge.engine.model_cache import GRAPH_FILE, WEIGHTS_FILE, PreparedModel
from cvo_edge.errors import BundleMismatchError, ModelError, UsageError

# No word of it leaves this machine.
onnxruntime.disable_telemetry_events()

# Smaller ones stay in the graph: shapes and scales, of no size.
_SMALL_TENSOR = 1024

# As onnxruntime and as OpenVINO has them.
_DTYPES: dict[str, Dtype] = {
    "tensor(uint8)": "uint8",
    "tensor(float)": "float32",
    "u8": "uint8",
    "f32": "float32",
}

# What a model declares of an input or output: name, type, and shape, whose sizes may be no numbers.
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
    """Whether sums of 8-bit products overflow on this processor, in silence, in half a millisecond.

    They do on x86 without VNNI, unless a session is told to be precise, which costs half of the
    speed where it is not needed. Asked by multiplying, as lists of what processors can do are not
    the same as what an engine makes of it.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4
    engine = onnxruntime.InferenceSession(
        _PRODUCT, options, providers=["CPUExecutionProvider"], enable_fallback=0
    )
    (found,) = engine.run(None, {"a": np.full((1, 32), 255, np.uint8)})
    return int(found[0, 0]) != 32 * 255 * 127


# Of this process, whichever thread holds them.
_OPEN: WeakSet[Session] = WeakSet()


def _abandon() -> None:
    """Give up the sessions of the process that this one was forked from.

    Their threads were not forked with them: to run one may wait for ever, and so does to end one,
    in a destructor, which is why these objects are never freed.
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
        The model itself, never a path: what was digest-checked is what runs, and a model cannot
        reach for other files. Or what a cache has of it.
    threads
        Threads of one inference; all allowed cores by default.
    expected
        What the calibration says of inputs and outputs; None to take the model as it is.
    spinning
        Whether threads wait for each other at full speed within an inference: faster, for more
        processor time.
    keep_in
        Folder to which the prepared model is written, for a cache.

    Attributes
    ----------
    engine
        The bare ``onnxruntime.InferenceSession``, for benchmarks beside it.
    inputs, outputs
        What the model itself declares.
    forked
        Whether this is a process that was forked from the one that loaded it, where it cannot run.

    Raises
    ------
    ModelError
        onnxruntime refuses the model.
    BundleMismatchError
        Names, types or shapes differ from ``expected``.
    """

    def __init__(
        self,
        model: bytes | PreparedModel,
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
        # Threads that spin between frames cost four times the processor time at camera rate; this
        # keeps the speed inside one call and gives the cores back after it.
        options.add_session_config_entry("session.force_spinning_stop", "1")
        options.add_session_config_entry("session.intra_op.allow_spinning", str(int(spinning)))
        self._caller_core: set[int] = set()
        cores = cores_of_threads(self.threads)
        if cores:
            # All but the caller's, and counted from one.
            others = ";".join(str(core + 1) for core in cores[1:])
            options.add_session_config_entry("session.intra_op_thread_affinities", others)
            # Where threads rest while they wait, the system finds the caller a better core.
            self._caller_core = {cores[0]} if spinning else set()
        options.log_severity_level = 4
        if keep_in is not None:
            options.optimized_model_filepath = str(keep_in / GRAPH_FILE)
            prefix = "session.optimized_model_external_initializers_"
            options.add_session_config_entry(prefix + "file_name", WEIGHTS_FILE)
            options.add_session_config_entry(prefix + "min_size_in_bytes", str(_SMALL_TENSOR))
        if isinstance(model, PreparedModel):
            content, weights = model.graph, str(model.folder)
            options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        else:
            # Else it takes what a model names as external data from the folder the process is in.
            content, weights = model, os.devnull
            # Whatever the calibration says of the model. What is prepared has it in its graph.
            if saturates():
                options.add_session_config_entry("session.x64quantprecision", "1")
        key = "session.model_external_initializers_file_folder_path"
        options.add_session_config_entry(key, weights)
        try:
            # Without the fallback, which says on stdout that it loads the same model once more.
            self.engine = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"], enable_fallback=0
            )
            inputs, outputs = (
                [(each.name, each.type, each.shape) for each in ports]
                for ports in (self.engine.get_inputs(), self.engine.get_outputs())
            )
        # onnxruntime raises a dozen unrelated types here, UnicodeDecodeError among them.
        except Exception as error:
            raise ModelError(f"model.onnx: refused by onnxruntime: {one_line(error)}") from None
        self._declare(inputs, outputs, expected)

    def _declare(
        self, inputs: Sequence[Port], outputs: Sequence[Port], expected: ModelSpec | None
    ) -> None:
        """Keep what the model itself declares, unless it is not what is expected."""
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

        Raises ModelError where it fails, and UsageError in a process forked from its own.
        """
        if self.forked:
            raise UsageError(
                "session: expected the process that loaded the model, found one forked from it; "
                "load it there"
            )
        try:
            values = self._call(feeds)
        except Exception as error:
            raise ModelError(f"model.onnx: inference failed: {one_line(error)}") from None
        # A model may declare one shape and give another.
        for name, shape, value in zip(self._names, self._shapes, values, strict=True):
            if value.shape != shape:
                raise ModelError(
                    f"model.onnx: expected {name} {list(shape)}, as declared, found "
                    f"{list(value.shape)}"
                )
        return dict(zip(self._names, values, strict=True))

    def _call(self, feeds: Mapping[str, NDArray[np.generic]]) -> Sequence[Any]:
        """Input arrays by name -> output arrays in the order of ``outputs``."""
        if not self._caller_core:
            return self.engine.run(None, feeds)  # type: ignore[no-any-return]
        # The calling thread is on the core that no other thread of ours has.
        before = os.sched_getaffinity(0)
        try:
            os.sched_setaffinity(0, self._caller_core)
        except OSError:
            # Someone has taken the core away since.
            self._caller_core = set()
        try:
            return self.engine.run(None, feeds)  # type: ignore[no-any-return]
        finally:
            if self._caller_core:
                with contextlib.suppress(OSError):
                    os.sched_setaffinity(0, before)


def _tensors(ports: Sequence[Port], kind: str) -> tuple[TensorSpec, ...]:
    tensors = []
    for name, type_name, shape in ports:
        if type_name not in _DTYPES or not all(isinstance(size, int) for size in shape):
            raise BundleMismatchError(
                f"model.onnx: expected {kind}s of uint8 or float32 with fixed shapes, "
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
    """Return what an engine says as one line of bounded length."""
    line = " ".join(str(error).split())
    return line if len(line) <= 200 else line[:197] + "..."
