"""What an ONNX graph takes and gives, as text, and the options that would describe it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import onnx
from onnx import TensorProto, helper

# Numbers of a pose in one output, or of a position and a rotation in two, and their form; the
# likeliest first.
_POSES = ((7, ""), (12, ",form=matrix"), (16, ",form=matrix"))
_ROTATIONS = ((4, ""), (9, ",form=matrix"), (16, ",form=matrix"), (6, ",form=six"))
_RARE_POSES = ((9, ",form=six"), (6, ",form=rotvec"))
_POSITION_NAMES = ("pos", "trans", "xyz", "loc")


def own_inputs(model: onnx.ModelProto) -> list[onnx.ValueInfoProto]:
    """Return the inputs that are no constants."""
    constants = {tensor.name for tensor in model.graph.initializer}
    return [value for value in model.graph.input if value.name not in constants]


def sizes(value: onnx.ValueInfoProto) -> list[int]:
    """Return the sizes of an input or output; 0 for one that the graph does not fix."""
    return [dim.dim_value for dim in value.type.tensor_type.shape.dim]


def tensor_text(value: onnx.ValueInfoProto) -> str:
    """Return e.g. ``x float32 [?, 3, 224, 224]``."""
    kind = value.type.tensor_type.elem_type
    name = "no tensor" if kind == TensorProto.UNDEFINED else helper.tensor_dtype_to_np_dtype(kind)
    return f"{value.name} {name} [{', '.join(str(size or '?') for size in sizes(value))}]"


def tensors_text(model: onnx.ModelProto) -> str:
    """Return all inputs and outputs with their types and sizes."""
    return f"inputs {_listed(own_inputs(model))}; outputs {_listed(model.graph.output)}"


def advice(model: onnx.ModelProto) -> str:
    """Say which options describe the graph, or how to export it so that they can."""
    inputs = own_inputs(model)
    if len(inputs) != 1:
        return (
            "export it with one image as its only input, and constants for the rest: each image is "
            "estimated alone, without the state of the one before"
        )
    dims = sizes(inputs[0])
    if len(dims) != 4 or dims[0] > 1:
        return "export it for one image, [1, 3, H, W] or [1, H, W, 3]"
    outputs = _outputs(model)
    if outputs is None:
        return (
            "no output has the size of a pose; export it with outputs that --output can describe: "
            "a position of 3 numbers and a rotation of 4, 9, 6 or 3, or both in one"
        )
    return f"state them, e.g. {_input(inputs[0])}{outputs}"


def _listed(values: Iterable[onnx.ValueInfoProto]) -> str:
    return ", ".join(map(tensor_text, values)) or "none"


def _input(value: onnx.ValueInfoProto) -> str:
    """Return --input and --size, as far as they are needed; the range can only be guessed."""
    dims = sizes(value)
    layout = "nhwc" if dims[3] == 3 and dims[1] != 3 else "nchw"
    plane = dims[2:] if layout == "nchw" else dims[1:3]
    given = "" if 3 in (dims[1], dims[3]) and layout == "nhwc" else f"layout={layout}"
    if value.type.tensor_type.elem_type != TensorProto.UINT8:
        given = f"layout={layout},range=0-1"
    return (f"--input {given} " if given else "") + ("" if all(plane) else "--size HEIGHTxWIDTH ")


def _outputs(model: onnx.ModelProto) -> str | None:
    """Return --output options that fit the sizes of the outputs, or None."""
    counts = {value.name: _count(sizes(value)) for value in model.graph.output}
    bounds = [f" --output {role}={role}" for role in ("lower", "upper") if counts.get(role) == 6]
    rest = [name for name in counts if name not in ("lower", "upper")]
    found = _one(rest, counts, _POSES) or _two(rest, counts) or _one(rest, counts, _RARE_POSES)
    return None if found is None else found + ("".join(bounds) if len(bounds) == 2 else "")


def _one(
    names: Sequence[str], counts: dict[str, int], forms: Sequence[tuple[int, str]]
) -> str | None:
    for count, form in forms:
        for name in names:
            if counts[name] == count:
                return f"--output pose={name}{form}"
    return None


def _two(names: Sequence[str], counts: dict[str, int]) -> str | None:
    threes = [name for name in names if counts[name] == 3]
    threes.sort(key=lambda name: not any(part in name.lower() for part in _POSITION_NAMES))
    if not threes:
        return None
    turns = [(n, form) for count, form in _ROTATIONS for n in names if counts[n] == count]
    turns += [(name, ",form=rotvec") for name in threes[1:]]
    if not turns:
        return None
    name, form = turns[0]
    return f"--output translation={threes[0]} --output rotation={name}{form}"


def _count(dims: Sequence[int]) -> int:
    """Return how many numbers an output of one image has; 0 if the graph does not say."""
    count = 1
    for size in dims[1:] if len(dims) > 1 else dims:
        count *= size
    return count
