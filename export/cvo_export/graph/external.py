"""Read an ONNX file, with the weights that lie in files beside it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import onnx
from google.protobuf.message import DecodeError
from onnx.external_data_helper import load_external_data_for_tensor, uses_external_data

from cvo_edge.errors import ModelError


def read_onnx(path: Path) -> onnx.ModelProto:
    """Return the model with all weights inside.

    Raises ModelError if the file or a file of its weights cannot be read, or lies outside the
    model's folder.
    """
    if not path.is_file():
        raise ModelError(f"{path}: expected an ONNX file or a bundle folder, found neither")
    try:
        model = onnx.load_from_string(path.read_bytes())
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}") from None
    except DecodeError:
        raise ModelError("model: expected an ONNX file, found something else") from None
    folder = path.resolve().parent
    for tensor in _tensors(model.graph):
        if not uses_external_data(tensor):
            continue
        entries = {entry.key: entry.value for entry in tensor.external_data}
        location = entries.get("location", "")
        beside = folder / location
        inside = beside.resolve().is_relative_to(folder) and beside.resolve() != folder
        if not inside or PurePosixPath(location).is_absolute():
            raise ModelError(
                f"{path}: expected weights in a file in its folder, found the path {location!r}"
            )
        if not beside.is_file():
            raise ModelError(
                f"{path}: expected its weights in {beside}, found no such file; copy it there, or "
                "export with external_data=False"
            )
        try:
            load_external_data_for_tensor(tensor, str(folder))
        except (OSError, ValueError, onnx.checker.ValidationError) as error:
            raise ModelError(f"{beside}: cannot be read as weights: {error}") from None
        del tensor.external_data[:]
        tensor.data_location = onnx.TensorProto.DEFAULT
    return model


def _tensors(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("t"):
                yield attribute.t
            yield from attribute.tensors
            for inner in (*attribute.graphs, *([attribute.g] if attribute.HasField("g") else [])):
                yield from _tensors(inner)
