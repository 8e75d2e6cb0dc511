"""Adapters: a network in another form, with nodes before and after it, gives the same numbers."""

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from cvo_edge.errors import BundleMismatchError, ModelError, UsageError
from cvo_export.graph.adapt import adapted, refuse_other_form
from cvo_export.graph.adapt_options import (
    input_text,
    output_text,
    read_input,
    read_outputs,
    read_size,
)
from cvo_export.graph.external import read_onnx
from cvo_export.graph.tensors import advice

R = np.random.default_rng(3)
IMAGE = R.integers(0, 256, (1, 16, 20, 3), dtype=np.uint8)


def network(counts, shape=("n", 3, "h", "w"), kind=TensorProto.FLOAT, bias=None):
    """A network that maps the mean colour to outputs of these sizes, linearly."""
    dtype = helper.tensor_dtype_to_np_dtype(kind)
    axes = [1, 2] if shape[3] == 3 else [2, 3]
    nodes = [helper.make_node("ReduceMean", ["x"], ["colour"], axes=axes, keepdims=0)]
    constants, outputs = [], []
    for name, count in counts.items():
        weight = R.normal(size=(3, count)).astype(dtype)
        offset = np.zeros(count) if bias is None else bias
        constants += [
            numpy_helper.from_array(weight if bias is None else weight * 0, f"{name}_w"),
            numpy_helper.from_array(offset.astype(dtype), f"{name}_b"),
        ]
        nodes += [
            helper.make_node("MatMul", ["colour", f"{name}_w"], [f"{name}_m"]),
            helper.make_node("Add", [f"{name}_m", f"{name}_b"], [name]),
        ]
        outputs.append(helper.make_tensor_value_info(name, kind, ["n", count]))
    inputs = [helper.make_tensor_value_info("x", kind, list(shape))]
    graph = helper.make_graph(nodes, "own", inputs, outputs, constants)
    opset = [helper.make_opsetid("", 13)]
    return helper.make_model(graph, opset_imports=opset, ir_version=8)


def run(content, feeds):
    providers = ["CPUExecutionProvider"]
    engine = onnxruntime.InferenceSession(content, providers=providers)
    names = [port.name for port in engine.get_outputs()]
    return dict(zip(names, engine.run(None, feeds), strict=True))


def adapt(model, given, outputs, size="16x20"):
    return adapted(model, read_input(given), read_outputs(outputs), read_size(size))


@pytest.mark.parametrize("kind", [TensorProto.FLOAT, TensorProto.FLOAT16])
@pytest.mark.parametrize("layout", ["nchw", "nhwc"])
def test_the_image_is_prepared_as_by_hand(layout, kind):
    shape = ("n", 3, "h", "w") if layout == "nchw" else ("n", "h", "w", 3)
    model = network({"out": 7, "extra": 5}, shape, kind)
    given = "name=x,range=0-1,mean=0.4/0.5/0.6,std=0.2/0.3/0.25,order=bgr"
    content, left_out = adapt(model, given, ["pose=out"])
    assert left_out == ("extra",)
    mean, std = np.float32([0.4, 0.5, 0.6]), np.float32([0.2, 0.3, 0.25])
    x = (IMAGE[..., ::-1].astype(np.float32) / np.float32(255) - mean) / std
    x = x.transpose(0, 3, 1, 2) if layout == "nchw" else x
    dtype = helper.tensor_dtype_to_np_dtype(kind)
    expected = run(model.SerializeToString(), {"x": x.astype(dtype)})["out"]
    found = run(content, {"image": IMAGE})
    assert list(found) == ["pose"]
    # A float16 output is rounded once; the adapter's float32 pose need not be.
    ulp = float(np.spacing(np.abs(expected).max())) if kind == TensorProto.FLOAT16 else 0.0
    np.testing.assert_allclose(found["pose"], expected.astype(np.float32), atol=1e-6 + ulp)


def rotation_matrix(q):
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def written(q, form):
    matrix = rotation_matrix(q)
    angle = 2 * np.arctan2(np.linalg.norm(q[:3]), q[3])
    axis = q[:3] / np.linalg.norm(q[:3])
    return {
        "quaternion_xyzw": q,
        "quaternion_wxyz": q[[3, 0, 1, 2]],
        "matrix": matrix.ravel(),
        "rotvec": axis * angle,
        "logq": axis * angle / 2,
        "six": matrix[:, :2].T.ravel(),
        "six_rows": matrix[:2].ravel(),
    }[form]


@pytest.mark.parametrize(
    "form",
    ["quaternion_xyzw", "quaternion_wxyz", "matrix", "rotvec", "logq", "six", "six_rows"],
)
@pytest.mark.parametrize("turn", range(4))
def test_every_form_of_a_rotation_is_read(form, turn):
    # Each component is the largest once, which takes another row of 4 q qT.
    q = np.roll([0.8, 0.3, -0.4, np.sqrt(0.11)], turn)
    position = np.array([1.5, -2.0, 0.5])
    bias = np.concatenate([1000 * position, written(q, form)])
    if form == "matrix":
        bias = np.column_stack([rotation_matrix(q), 1000 * position]).ravel()
    model = network({"out": len(bias)}, bias=bias)
    content, _ = adapt(model, "range=0-255", [f"pose=out,form={form},unit=mm"])
    (pose,) = run(content, {"image": IMAGE})["pose"]
    np.testing.assert_allclose(pose[:3], position, atol=1e-6)
    assert abs(pose[3:] @ q) == pytest.approx(1.0, abs=1e-6)


def test_world_to_camera_and_opengl_axes_are_turned():
    q, position = np.array([0.8, 0.3, -0.4, np.sqrt(0.11)]), np.array([1.5, -2.0, 0.5])
    bias = np.concatenate([position, q])
    options = "pose=out,direction=world_to_camera,axes=opengl"
    content, _ = adapt(network({"out": 7}, bias=bias), "range=0-255", [options])
    (pose,) = run(content, {"image": IMAGE})["pose"]
    inverse = rotation_matrix(q).T
    np.testing.assert_allclose(pose[:3], -inverse @ position, atol=1e-6)
    expected = inverse @ np.diag([1, -1, -1])
    np.testing.assert_allclose(rotation_matrix(pose[3:]), expected, atol=1e-6)


def test_separate_outputs_and_bounds_are_joined():
    model = network({"t": 3, "r": 4, "a": 6, "b": 6})
    outputs = ["translation=t,unit=cm", "rotation=r,form=quaternion_wxyz", "lower=a", "upper=b"]
    content, left_out = adapt(model, "range=0-255", outputs)
    x = IMAGE.astype(np.float32).transpose(0, 3, 1, 2)
    own, found = run(model.SerializeToString(), {"x": x}), run(content, {"image": IMAGE})
    expected = np.hstack([own["t"] * np.float32(0.01), own["r"][:, [1, 2, 3, 0]]])
    np.testing.assert_allclose(found["pose"], expected, rtol=1e-6)
    np.testing.assert_array_equal(found["upper"], own["b"])
    assert left_out == ()


def test_weights_beside_the_file_are_read_into_it(tmp_path):
    model = network({"out": 7})
    before = model.SerializeToString()
    onnx.save(
        *(model, tmp_path / "mine.onnx"),
        save_as_external_data=True,
        location="mine.onnx.data",
        size_threshold=0,
    )
    x = {"x": np.ones((1, 3, 16, 20), np.float32)}
    content = read_onnx(tmp_path / "mine.onnx").SerializeToString()
    np.testing.assert_array_equal(run(content, x)["out"], run(before, x)["out"])
    (tmp_path / "mine.onnx.data").unlink()
    missing = f"expected its weights in {tmp_path / 'mine.onnx.data'}, found no such file"
    with pytest.raises(ModelError, match=missing):
        read_onnx(tmp_path / "mine.onnx")
    outside = onnx.load(tmp_path / "mine.onnx", load_external_data=False)
    outside.graph.initializer[0].external_data[0].value = "../other.data"
    (tmp_path / "mine.onnx").write_bytes(outside.SerializeToString())
    with pytest.raises(ModelError, match=r"in a file in its folder, found the path '../other"):
        read_onnx(tmp_path / "mine.onnx")


@pytest.mark.parametrize(
    ("counts", "shape", "advice"),
    [
        (
            {"out": 7},
            (1, 3, 224, 224),
            "state them, e.g. --input layout=nchw,range=0-1 --output pose=out",
        ),
        (
            {"q": 4, "feature": 64, "xyz": 3, "lower": 6, "upper": 6},
            ("n", "h", "w", 3),
            "state them, e.g. --input layout=nhwc,range=0-1 --size HEIGHTxWIDTH --output "
            "translation=xyz --output rotation=q --output lower=lower --output upper=upper",
        ),
        (
            {"turn": 3, "position": 3},
            (1, 3, 64, 64),
            "state them, e.g. --input layout=nchw,range=0-1 --output translation=position --output "
            "rotation=turn,form=rotvec",
        ),
        ({"out": 5}, (1, 3, 64, 64), "no output has the size of a pose; export it with outputs"),
        ({"out": 7}, (8, 3, 64, 64), "export it for one image, [1, 3, H, W] or [1, H, W, 3]"),
    ],
)
def test_without_options_the_message_names_those_that_may_fit(counts, shape, advice):
    with pytest.raises(BundleMismatchError) as caught:
        refuse_other_form(network(counts, shape))
    text = str(caught.value)
    sizes = ", ".join("?" if isinstance(size, str) else str(size) for size in shape)
    outputs = ", ".join(f"{name} float32 [?, {count}]" for name, count in counts.items())
    assert f"found inputs x float32 [{sizes}]; outputs {outputs}; {advice}" in text


def test_an_image_with_other_outputs_needs_only_their_names():
    model = network({"out": 7}, (1, 16, 20, 3), TensorProto.UINT8)
    model.graph.input[0].name = "image"
    assert advice(model) == "state them, e.g. --output pose=out"
    with pytest.raises(UsageError, match="expected layout or order alone for image uint8"):
        adapt(model, "range=0-1", ["pose=out"])


@pytest.mark.parametrize(
    ("inputs", "named"),
    [
        ({"x": (1, 3, 16, 20), "state": (1, 8)}, "x float32 [1, 3, 16, 20], state float32 [1, 8]"),
        ({"x": (1, 5, 3, 16, 20)}, "x float32 [1, 5, 3, 16, 20]"),
    ],
)
def test_sequences_and_states_are_refused_with_a_way_out(inputs, named):
    model = network({"out": 7})
    del model.graph.input[:]
    for name, shape in inputs.items():
        value = helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape))
        model.graph.input.append(value)
    for refused in (
        lambda: adapt(model, "range=0-1", ["pose=out"]),
        lambda: refuse_other_form(model),
    ):
        with pytest.raises(BundleMismatchError) as caught:
            refused()
        assert f"found inputs {named}; outputs out float32 [?, 7]; export it" in str(caught.value)


@pytest.mark.parametrize(
    ("given", "outputs", "size", "message"),
    [
        ("range=0-1", ["pose=out"], None, "--size: expected HEIGHTxWIDTH, as the graph"),
        (None, ["pose=out"], "16x20", "--input: expected range=0-1 or range=0-255 for x"),
        ("range=0-1", ["pose=no"], "16x20", "--output pose: expected one of out, found no"),
        ("range=0-1", [], "16x20", "--output: expected pose, or translation and rotation"),
        ("range=2", ["pose=out"], "16x20", "--input: expected range= one of 0-1, 0-255, found 2"),
        ("range=0-1,mean=a", ["pose=out"], "16x20", "--input: expected mean= one number or"),
        ("range=0-1,std=inf", ["pose=out"], "16x20", "--input: expected std= one number or"),
        ("range=0-1", ["pose=out"], "16", "--size: expected HEIGHTxWIDTH such as 224x320"),
    ],
)
def test_options_that_do_not_fit_are_refused(given, outputs, size, message):
    with pytest.raises(UsageError) as caught:
        adapt(network({"out": 7}), given, outputs, size)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("text", ["", "name=x,layout=nchw,range=0-1,order=bgr,mean=0.5/0.4/0.3"])
def test_forms_are_written_as_they_are_read(text):
    assert input_text(read_input(text)) == text
    outputs = ["translation=t,unit=mm", "rotation=r,form=matrix,direction=world_to_camera"]
    assert [output_text(role, form) for role, form in read_outputs(outputs).items()] == outputs


def test_an_output_of_another_length_is_refused():
    with pytest.raises(BundleMismatchError, match=r"expected 6 numbers in out \(logq\), found"):
        adapt(network({"out": 7}), "range=0-1", ["pose=out,form=logq"])
