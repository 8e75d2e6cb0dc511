"""Possible model outputs and their consequences, tested with small purpose-built models."""

import hashlib

import msgspec
import numpy as np
import pytest

from cvo_edge import Bundle, ModelError, Odometer, Reason, Status
from cvo_edge.bundle.format import CONFIDENCES, PoseLimits, Threshold
from cvo_edge.bundle.reading import decode_calibration, encode_calibration
from cvo_edge.engine.session import Session
from cvo_edge.geometry import euler_zyx_to_quaternion
from cvo_edge.input.preprocess import selftest_image

onnx = pytest.importorskip("onnx")


def constant_model(pose, lower, upper, height=192, width=256):
    """A model with constant outputs; it adds zero times the image so that the input is used."""
    helper = onnx.helper
    outputs = {"pose": pose, "lower": lower, "upper": upper}
    nodes = [
        helper.make_node("Cast", ["image"], ["real"], to=onnx.TensorProto.FLOAT),
        helper.make_node("ReduceMin", ["real"], ["least"], keepdims=0),
        helper.make_node("Mul", ["least", "zero"], ["nothing"]),
    ]
    constants = [onnx.numpy_helper.from_array(np.float32(0.0), "zero")]
    infos = []
    for name, values in outputs.items():
        array = np.array([values], dtype=np.float32)
        constants.append(onnx.numpy_helper.from_array(array, f"{name}_values"))
        nodes.append(helper.make_node("Add", [f"{name}_values", "nothing"], [name]))
        infos.append(helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, array.shape))
    image = helper.make_tensor_value_info("image", onnx.TensorProto.UINT8, [1, height, width, 3])
    graph = helper.make_graph(nodes, "constant", [image], infos, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    return model.SerializeToString()


IMAGE = selftest_image(240, 320)
EXPECTED = ("pose", "lower", "upper")
IDENTITY = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


def odometer(
    bundle,
    pose=IDENTITY,
    lower=(-1.0,) * 6,
    upper=(1.0,) * 6,
    q_hat=(0.5,) * 6,
    rotation="tangent_reference",
):
    model_bytes = constant_model(pose, lower, upper)
    calibration = bundle.calibration
    outputs = tuple(tensor for tensor in calibration.model.outputs if tensor.name in EXPECTED)
    model = msgspec.structs.replace(
        calibration.model, sha256=hashlib.sha256(model_bytes).hexdigest(), outputs=outputs
    )
    selftest = calibration.selftest
    expected = {name: values for name, values in selftest.outputs.items() if name in EXPECTED}
    limits = PoseLimits(lowest=(-4.0,) * 6, highest=(4.0,) * 6)
    changed = msgspec.structs.replace(
        calibration,
        model=model,
        pose=msgspec.structs.replace(
            calibration.pose,
            limits=limits,
            rotation=rotation,
            reference_q_xyzw=None if rotation == "euler_zyx" else (0.0, 0.0, 0.0, 1.0),
        ),
        calibration=msgspec.structs.replace(
            calibration.calibration, score="additive", rule="pooled", cap=None
        ),
        selftest=msgspec.structs.replace(selftest, outputs=expected),
        alarm=None,
        difficulty=None,
        thresholds=tuple(
            Threshold(confidence=confidence, scope=scope, q_hat=q_hat, q_hat_upper=None)
            for confidence in CONFIDENCES
            for scope in ("marginal", "joint")
        ),
    )
    return Odometer(Bundle.of(decode_calibration(encode_calibration(changed)), model_bytes))


def step(bundle, **outputs):
    with odometer(bundle, **outputs) as made:
        return made.step(IMAGE)


def test_the_additive_set_is_the_bounds_plus_and_minus_the_threshold(bundle):
    found = step(bundle)
    np.testing.assert_allclose(found.lower, -1.5)
    np.testing.assert_allclose(found.upper, 1.5)
    assert found.status is Status.OK


def test_a_set_is_exactly_where_the_score_is_at_most_the_threshold(bundle):
    with odometer(bundle) as made:
        seen = made.observe(IMAGE, 0)
        region = made.conformal_set(seen)
        for y in np.linspace(-3, 3, 61):
            truth = np.full((1, 6), y)
            score = made.head.scores(seen.outputs, seen.point[None], truth)[0, 0]
            np.testing.assert_array_equal(score <= 0.5, region.covers(truth[0]))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("output", ["pose", "lower", "upper"])
def test_one_value_that_is_not_finite_makes_the_frame_invalid(bundle, output, value):
    values = {"pose": list(IDENTITY), "lower": [-1.0] * 6, "upper": [1.0] * 6}
    values[output][2] = value
    found = step(bundle, **values)
    assert found.status is Status.INVALID
    assert found.reasons == (Reason.OUTPUT_NOT_FINITE,)
    assert found.pose is None
    assert not found.bounded


@pytest.mark.parametrize("pose", [[1e38, 0, 0, 0, 0, 0, 1], [5, 0, 0, 0, 0, 0, 1], [0] * 7])
def test_an_absurd_pose_makes_the_frame_invalid(bundle, pose):
    found = step(bundle, pose=pose)
    assert found.status is Status.INVALID
    assert found.reasons == (Reason.POSE_IMPLAUSIBLE,)


@pytest.mark.parametrize("output", ["lower", "upper"])
def test_an_absurd_bound_makes_the_frame_invalid(bundle, output):
    found = step(bundle, **{output: (0.0, 0.0, 3e38, 3e38, 0.0, 0.0)})
    assert found.status is Status.INVALID
    assert found.reasons == (Reason.OUTPUT_ABSURD,)
    assert not found.bounded


@pytest.mark.parametrize("degrees", [79.0, 81.0, 90.0, -85.0])
def test_steep_pitch_is_defined_and_told_of_where_angles_are_euler(bundle, degrees):
    quaternion = euler_zyx_to_quaternion(np.deg2rad([10.0, degrees, 20.0]))
    found = step(bundle, pose=[0.0, 0.0, 0.0, *quaternion], rotation="euler_zyx")
    assert found.status is Status.OK
    assert found.reasons == ((Reason.PITCH_NEAR_90,) if abs(degrees) > 80.0 else ())
    # Several triples of angles represent this rotation; the chosen one must, too.
    again = euler_zyx_to_quaternion(found.chart.point(found.pose.to_array())[3:])
    assert abs(again @ quaternion) == pytest.approx(1.0, abs=1e-6)


def test_bounds_across_half_a_turn_hold_the_rotation_from_both_sides(bundle):
    for yaw in (179.0, -179.0):
        quaternion = euler_zyx_to_quaternion(np.deg2rad([0.0, 0.0, yaw]))
        pose = [0.0, 0.0, 0.0, *quaternion]
        angles = np.deg2rad([0.0, 0.0, yaw])
        lower, upper = ([10.0 * by] * 3 + list(angles + by) for by in (-0.1, 0.1))
        found = step(
            bundle, pose=pose, lower=lower, upper=upper, q_hat=(0.0,) * 6, rotation="euler_zyx"
        )
        for other in (178.0, 179.9, -179.9, -178.0):
            truth = euler_zyx_to_quaternion(np.deg2rad([0.0, 0.0, other]))
            assert found.contains(np.array([0.0, 0.0, 0.0, *truth]))
        opposite = euler_zyx_to_quaternion([0.0, 0.0, 0.0])
        assert not found.contains(np.array([0.0, 0.0, 0.0, *opposite]))


def test_an_emptied_set_becomes_its_middle_and_says_so(bundle):
    found = step(bundle, lower=(-0.2,) * 6, upper=(0.4,) * 6, q_hat=(-0.5,) * 6)
    np.testing.assert_allclose(found.lower, 0.1)
    np.testing.assert_allclose(found.upper, 0.1)
    assert found.reasons == (Reason.BOUNDS_CROSSED,)


def test_too_few_scores_are_unbounded_and_stay_so_to_the_record(bundle):
    found = step(bundle, q_hat=(None, 0.5, 0.5, 0.5, 0.5, 0.5))
    record = found.to_dict()["interval"]
    assert record["lower"][0] is None
    assert record["upper"][0] is None
    assert record["bounded"] is False
    assert record["lower"][1] == pytest.approx(-1.5)


def test_a_quaternion_of_any_length_and_sign_is_the_same_rotation(bundle):
    found = step(bundle, pose=[0, 0, 0, 0, 0, 0, -3.0])
    np.testing.assert_allclose(found.pose.q_xyzw, [0, 0, 0, 1])


@pytest.mark.parametrize("found", [1, 3, 6])
def test_an_output_of_another_shape_than_declared_fails(bundle, found):
    """The output's shape is known only at run time: the end of a slice is a computed number."""
    model = onnx.load_from_string(constant_model(IDENTITY, (-1.0,) * 6, (1.0,) * 6))
    graph, helper = model.graph, onnx.helper
    (add,) = [node for node in graph.node if list(node.output) == ["lower"]]
    add.output[0] = "whole"
    names = {"begin": [0], "axis": [1], "wanted": [found]}
    graph.initializer.extend(
        onnx.numpy_helper.from_array(np.array(values, np.int64), name)
        for name, values in names.items()
    )
    graph.node.extend(
        [
            helper.make_node("Cast", ["nothing"], ["whole_nothing"], to=onnx.TensorProto.INT64),
            helper.make_node("Add", ["wanted", "whole_nothing"], ["end"]),
            helper.make_node("Slice", ["whole", "begin", "end", "axis"], ["lower"]),
        ]
    )
    outputs = tuple(each for each in bundle.calibration.model.outputs if each.name in EXPECTED)
    spec = msgspec.structs.replace(bundle.calibration.model, precision="fp32", outputs=outputs)
    session = Session(model.SerializeToString(), 1, spec)
    feeds = {"image": np.zeros((1, 192, 256, 3), np.uint8)}
    if found == 6:
        assert session.run(feeds)["lower"].shape == (1, 6)
    else:
        with pytest.raises(
            ModelError, match=r"expected the declared shape \[1, 6\] for lower, found"
        ):
            session.run(feeds)


def test_nothing_is_printed_of_a_model_that_is_refused(bundle, capfd):
    content = bundle.model_bytes.replace(b"Conv", b"Q\xff\xfeQ")
    with pytest.raises(ModelError, match="refused by onnxruntime"):
        Session(content, 1)
    assert capfd.readouterr() == ("", "")
