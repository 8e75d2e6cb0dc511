"""Bring an ONNX network to the form of a bundle by adding nodes to its graph; needs no torch.

A bundle's model takes ``image``, uint8 [1, H, W, 3] RGB, and gives ``pose`` [1, 7]: tx ty tz (m)
and qx qy qz qw, camera to world. ``adapted`` adds the conversion of the image before a network's
own input and the conversion of its own outputs after them. The network itself stays unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, compose, helper

from cvo_edge.engine.session import one_line
from cvo_edge.errors import BundleMismatchError, ModelError, UsageError
from cvo_export.graph.adapt_options import InputForm, OutputForm
from cvo_export.graph.nodes import Nodes
from cvo_export.graph.tensors import advice, own_inputs, sizes, tensor_text, tensors_text

Array = NDArray[np.float32]

_OWN = "network/"
_TYPES = (TensorProto.UINT8, TensorProto.FLOAT16, TensorProto.FLOAT, TensorProto.DOUBLE)
_LEAST_OPSET = 9
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_MATRIX_ROTATION, _MATRIX_POSITION = (0, 1, 2, 4, 5, 6, 8, 9, 10), (3, 7, 11)


def adapted(
    model: onnx.ModelProto,
    given: InputForm,
    outputs: Mapping[str, OutputForm],
    size: tuple[int, int] | None,
) -> tuple[bytes, tuple[str, ...]]:
    """Return the network in a bundle's form, and the names of the outputs that were left out.

    ``outputs`` maps ``pose``, or ``translation`` and ``rotation``, and optionally ``lower`` and
    ``upper`` to what the network calls them. ``size`` (height, width) is needed if the graph does
    not fix it.

    Raises
    ------
    UsageError
        The options do not fit together, or one is missing.
    BundleMismatchError
        The network's input or an output has another form than stated.
    """
    opset = max((e.version for e in model.opset_import if e.domain in ("", "ai.onnx")), default=1)
    if opset < _LEAST_OPSET:
        raise BundleMismatchError(
            f"model: expected opset {_LEAST_OPSET} or later, found {opset}; export it again"
        )
    _check_roles(outputs, model)
    own = [value.name for value in model.graph.output]
    for role, form in outputs.items():
        if form.name not in own:
            raise UsageError(
                f"--output {role}: expected one of {', '.join(own)}, found {form.name}; "
                f"{advice(model)}"
            )
    value = _own_input(model, given.name)
    model = compose.add_prefix(model, _OWN)
    nodes = Nodes("adapter/")
    plane = _put_image_before(model, nodes, value, given, size)
    shapes = _output_shapes(model, nodes, plane)
    results = _pose_of(nodes, outputs, shapes)
    for role in ("lower", "upper"):
        if role in outputs:
            results[role] = _flat(nodes, role, outputs[role], shapes, (6,))
    for name, result in results.items():
        nodes.name(result, name)
    model.graph.node.extend(nodes.taken())
    model.graph.initializer.extend(nodes.constants)
    del model.graph.output[:]
    for name in results:
        width = 7 if name == "pose" else 6
        model.graph.output.append(
            helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, width])
        )
    used = {form.name for form in outputs.values()}
    return model.SerializeToString(), tuple(name for name in own if name not in used)


def image_before(
    model: onnx.ModelProto, given: InputForm, size: tuple[int, int] | None
) -> tuple[bytes, str, tuple[int, int]]:
    """Return the network with a bundle's input and its own outputs; raises as ``adapted``.

    The second value stands before the names of its outputs; the third is height and width.
    """
    value = _own_input(model, given.name)
    model = compose.add_prefix(model, _OWN)
    nodes = Nodes("adapter/")
    plane = _put_image_before(model, nodes, value, given, size)
    model.graph.initializer.extend(nodes.constants)
    return model.SerializeToString(), _OWN, plane


def pose_behind(
    outputs: Mapping[str, OutputForm], shapes: Mapping[str, tuple[int, ...]]
) -> tuple[bytes, dict[str, str]]:
    """Return a graph from a network's own outputs, float32 of these shapes, to ``pose`` (1, 7).

    The second value maps the names of the outputs to those of the graph's inputs.
    """
    nodes = Nodes("adapter/")
    nodes.name(_pose_of(nodes, outputs, shapes)["pose"], "pose")
    ports = {form.name: _OWN + form.name for form in outputs.values()}
    graph = helper.make_graph(
        nodes.taken(),
        "pose",
        [
            helper.make_tensor_value_info(port, TensorProto.FLOAT, shapes[name])
            for name, port in ports.items()
        ],
        [helper.make_tensor_value_info("pose", TensorProto.FLOAT, [1, 7])],
        nodes.constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    return model.SerializeToString(), ports


def _check_roles(outputs: Mapping[str, OutputForm], model: onnx.ModelProto) -> None:
    found = set(outputs) - {"lower", "upper"}
    if found not in ({"pose"}, {"translation", "rotation"}) or len(outputs) - len(found) == 1:
        raise UsageError(
            "--output: expected pose, or translation and rotation, and lower and upper both or "
            f"neither, found {', '.join(outputs) or 'none'}; {tensors_text(model)}; "
            f"{advice(model)}"
        )


def _own_input(model: onnx.ModelProto, name: str | None) -> onnx.ValueInfoProto:
    values = own_inputs(model)
    if name not in (None, *(value.name for value in values)):
        raise UsageError(
            f"--input: expected name= of the input, found {name}; {tensors_text(model)}"
        )
    dims = sizes(values[0]) if len(values) == 1 else []
    kind = values[0].type.tensor_type.elem_type if dims else TensorProto.UNDEFINED
    if len(dims) != 4 or dims[0] > 1 or kind not in _TYPES:
        raise BundleMismatchError(
            "model: expected one input, an image, uint8 or float, with a batch of 1 or a dynamic "
            f"one, found {tensors_text(model)}; {advice(model)}"
        )
    return values[0]


def _put_image_before(
    model: onnx.ModelProto,
    nodes: Nodes,
    value: onnx.ValueInfoProto,
    given: InputForm,
    size: tuple[int, int] | None,
) -> tuple[int, int]:
    """Replace the input by ``image``; return its height and width."""
    layout, height, width = _image_form(value, given, size)
    image = _converted(nodes, given, layout, value.type.tensor_type.elem_type)
    nodes.name(image, _OWN + value.name)
    graph = model.graph
    behind = list(graph.node)
    del graph.node[:]
    graph.node.extend([*nodes.taken(), *behind])
    kept = [entry for entry in graph.input if entry.name != _OWN + value.name]
    del graph.input[:]
    shape = [1, height, width, 3]
    graph.input.extend([helper.make_tensor_value_info("image", TensorProto.UINT8, shape), *kept])
    # Inner shapes may still name the dynamic dimensions, which are fixed now.
    del graph.value_info[:]
    return height, width


def _image_form(
    value: onnx.ValueInfoProto, given: InputForm, size: tuple[int, int] | None
) -> tuple[str, int, int]:
    """Return layout, height and width of the input; raises if the options do not fit it."""
    kind = value.type.tensor_type.elem_type
    dims, form = sizes(value), tensor_text(value)
    layout = given.layout or ("nchw" if dims[1] == 3 else "nhwc" if dims[3] == 3 else None)
    if layout is None:
        raise UsageError(f"--input: expected layout=nchw or layout=nhwc for {form}, found neither")
    channels, *plane = (dims[1], dims[2], dims[3]) if layout == "nchw" else (dims[3], *dims[1:3])
    if channels not in (0, 3):
        raise BundleMismatchError(
            f"model: expected 3 channels in the layout {layout}, found {form}"
        )
    if kind == TensorProto.UINT8 and (given.range, given.mean, given.std) != (None,) * 3:
        raise UsageError(
            f"--input: expected layout or order alone for {form}, which takes 0 to 255, found "
            "range, mean or std"
        )
    if 0 in plane and size is None:
        raise UsageError(f"--size: expected HEIGHTxWIDTH, as the graph does not say it: {form}")
    height, width = size or (plane[0], plane[1])
    if any(
        of_graph not in (0, asked) for of_graph, asked in zip(plane, (height, width), strict=True)
    ):
        raise UsageError(f"--size: expected {plane[0]}x{plane[1]}, found {height}x{width}")
    if kind != TensorProto.UINT8 and given.range is None:
        raise UsageError(
            f"--input: expected range=0-1 or range=0-255 for {form}, found neither; it is the range"
            " that mean and std refer to, or that the network takes"
        )
    return layout, height, width


def _converted(nodes: Nodes, given: InputForm, layout: str, kind: int) -> str:
    """Return ``image`` as the network takes it: range, order, layout and type of element."""
    image = "image"
    if kind != TensorProto.UINT8:
        image = nodes("Cast", image, to=TensorProto.FLOAT)
    if given.order == "bgr":
        image = nodes("Gather", image, nodes.constant(np.array([2, 1, 0])), axis=3)
    if given.range == "0-1":
        image = nodes("Div", image, nodes.constant(_floats(255.0)))
    if given.mean is not None:
        image = nodes("Sub", image, nodes.constant(_floats(given.mean)))
    if given.std is not None:
        image = nodes("Div", image, nodes.constant(_floats(given.std)))
    if layout == "nchw":
        image = nodes("Transpose", image, perm=[0, 3, 1, 2])
    if kind in (TensorProto.FLOAT16, TensorProto.DOUBLE):
        image = nodes("Cast", image, to=kind)
    return nodes("Identity", image) if image == "image" else image


def _output_shapes(
    model: onnx.ModelProto, nodes: Nodes, plane: tuple[int, int]
) -> dict[str, tuple[int, ...]]:
    """Run the network on an image of height and width; return the shapes of its own outputs."""
    probe = onnx.ModelProto()
    probe.CopyFrom(model)
    probe.graph.initializer.extend(nodes.constants)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    try:
        engine = onnxruntime.InferenceSession(
            probe.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        names = [port.name for port in engine.get_outputs()]
        found = engine.run(None, {"image": np.zeros((1, *plane, 3), np.uint8)})
    # onnxruntime raises a dozen unrelated types here.
    except Exception as error:  # noqa: BLE001
        raise ModelError(
            f"model: does not run on an image of {plane[0]}x{plane[1]} pixels: {one_line(error)}"
        ) from None
    shapes = zip(names, (values.shape for values in found), strict=True)
    return {name.removeprefix(_OWN): shape for name, shape in shapes}


def _flat(
    nodes: Nodes,
    role: str,
    form: OutputForm,
    shapes: Mapping[str, tuple[int, ...]],
    counts: Sequence[int],
) -> str:
    """Return the output as float32 (1, n), where n must be one of ``counts``."""
    shape = shapes[form.name]
    count = int(np.prod(shape))
    if count not in counts:
        raise BundleMismatchError(
            f"--output {role}: expected {' or '.join(map(str, counts))} numbers in {form.name} "
            f"({form.form}), found shape {list(shape)}"
        )
    result = nodes("Cast", _OWN + form.name, to=TensorProto.FLOAT)
    return nodes("Reshape", result, nodes.constant(np.array([1, count])))


_ROTATION_COUNTS = {
    "quaternion_xyzw": (4,),
    "quaternion_wxyz": (4,),
    "matrix": (9, 16),
    "rotvec": (3,),
    "logq": (3,),
    "six": (6,),
    "six_rows": (6,),
}


def _pose_of(
    nodes: Nodes, outputs: Mapping[str, OutputForm], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, str]:
    """Return the name of the pose (1, 7)."""
    if "pose" in outputs:
        given = turned = outputs["pose"]
        matrix = given.form == "matrix"
        counts: tuple[int, ...] = (12, 16) if matrix else (3 + _ROTATION_COUNTS[given.form][0],)
        whole = _flat(nodes, "pose", given, shapes, counts)
        width = int(np.prod(shapes[given.name]))
        position = nodes.columns(whole, _MATRIX_POSITION if matrix else range(3))
        rotation = nodes.columns(whole, _MATRIX_ROTATION if matrix else range(3, width))
    else:
        given, turned = outputs["translation"], outputs["rotation"]
        position = _flat(nodes, "translation", given, shapes, (3,))
        counts = _ROTATION_COUNTS[turned.form]
        rotation = _flat(nodes, "rotation", turned, shapes, counts)
        if np.prod(shapes[turned.name]) == 16:
            rotation = nodes.columns(rotation, _MATRIX_ROTATION)
    if given.unit != "m":
        position = nodes("Mul", position, nodes.constant(_floats(_UNITS[given.unit])))
    rotation = nodes.quaternion(rotation, turned.form)
    if turned.direction == "world_to_camera":
        rotation = nodes("Mul", rotation, nodes.constant(_floats([-1, -1, -1, 1])))
        position = nodes("Neg", nodes.rotated(rotation, position))
    if turned.axes == "opengl":
        rotation = nodes.half_turn_about_x(rotation)
    return {"pose": nodes("Concat", position, rotation, axis=1)}


def _floats(values: float | Sequence[float]) -> Array:
    return np.asarray(values, np.float32)


def refuse_other_form(model: onnx.ModelProto) -> None:
    """Raise BundleMismatchError, with the options that may fit, if the input is not an image.

    Input ``image`` uint8 with fixed sizes passes; the outputs are not looked at.
    """
    form = [(v.name, v.type.tensor_type.elem_type, sizes(v)) for v in own_inputs(model)]
    for name, kind, dims in form[:1]:
        shaped = len(dims) == 4 and all(dims) and dims[0] == 1 and dims[3] == 3
        if len(form) == 1 and (name, kind, shaped) == ("image", TensorProto.UINT8, True):
            return
    raise other_form(model)


def other_form(model: onnx.ModelProto) -> BundleMismatchError:
    """Return the error for a graph that no options describe, but that is not in a bundle's form."""
    return BundleMismatchError(
        "model: expected the input image uint8 [1, height, width, 3] and the outputs pose [1, 7], "
        f"or pose, lower [1, 6] and upper [1, 6], found {tensors_text(model)}; {advice(model)}"
    )
