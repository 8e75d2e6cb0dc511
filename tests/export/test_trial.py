"""A network of a wrong form is told apart from a bad one, and the form that fits is named."""

from dataclasses import replace

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from cvo_edge.geometry import quaternion_conjugate, quaternion_multiply, quaternion_to_matrix
from cvo_export.data.pose_errors import mean_pose_error, median_error
from cvo_export.datasets import open_dataset
from cvo_export.graph.adapt_options import read_input, read_outputs, read_size
from cvo_export.graph.trial import Form, tried

R = np.random.default_rng(5)
COUNT = 30
# Poses that a mean does not explain, and a colour for each, from which a network finds it again.
TURNS = [0.6, 0.1, -0.2, 0.7] + R.normal(size=(COUNT, 4)) / 4
POSES = np.hstack([R.uniform(-2, 2, (COUNT, 3)), TURNS])
POSES[:, 3:] /= np.linalg.norm(POSES[:, 3:], axis=1, keepdims=True)
COLOURS = np.array([(8 * k + 4, 255 - 8 * k, 4 * k) for k in range(COUNT)], np.uint8)  # RGB


@pytest.fixture(scope="module")
def dataset():
    some = open_dataset(f"synthetic:room,flights=1,frames={COUNT},size=64x48")

    def read_image(index):
        return np.tile(COLOURS[index][::-1], (48, 64, 1))

    return replace(some, poses=POSES, read_image=read_image)


def network(answers, size):
    """A network that answers with the row of the colour that is nearest to its input, 0 to 1."""
    table = COLOURS.astype(np.float32) / 255
    nodes = [
        helper.make_node("ReduceMean", ["x"], ["colour"], axes=[2, 3], keepdims=0),
        helper.make_node("Sub", ["table", "colour"], ["difference"]),
        helper.make_node("ReduceL2", ["difference"], ["distance"], axes=[1], keepdims=0),
        helper.make_node("ArgMin", ["distance"], ["row"], axis=0, keepdims=1),
        helper.make_node("Gather", ["answers", "row"], ["out"], axis=0),
    ]
    constants = {"table": table, "answers": answers.astype(np.float32)}
    graph = helper.make_graph(
        nodes,
        "own",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 3, *size])],
        [helper.make_tensor_value_info("out", TensorProto.FLOAT, [1, answers.shape[1]])],
        [numpy_helper.from_array(values, name) for name, values in constants.items()],
    )
    opsets = [helper.make_opsetid("", 13)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=8)


def say(dataset, answers, given="range=0-1", size=None):
    """Try a network of a fixed size, or one that takes every size and is said to have this one."""
    form = Form(read_input(given), read_outputs(["pose=out"]), read_size(size), "none")
    model = network(answers, ("h", "w") if size else (48, 64))
    return tried(model, form, dataset, np.arange(COUNT), None, stated=True)


def inverse(poses):
    back = quaternion_conjugate(poses[:, 3:])
    moved = [-quaternion_to_matrix(q) @ t for q, t in zip(back, poses[:, :3], strict=True)]
    return np.hstack([moved, back])


def opengl(poses):
    return np.hstack([poses[:, :3], quaternion_multiply(poses[:, 3:], np.array([1.0, 0, 0, 0]))])


@pytest.mark.parametrize(
    ("answers", "given", "option"),
    [
        (POSES[:, [0, 1, 2, 6, 3, 4, 5]], "range=0-1", "--output pose=out,form=quaternion_wxyz"),
        (POSES * ([1000] * 3 + [1] * 4), "range=0-1", "--output pose=out,unit=mm"),
        (inverse(POSES), "range=0-1", "--output pose=out,direction=world_to_camera"),
        (opengl(POSES), "range=0-1", "--output pose=out,axes=opengl"),
        (POSES, "range=0-1,order=bgr", "--input range=0-1"),
        (POSES, "range=0-255", "--input range=0-1"),
        (
            opengl(POSES)[:, [0, 1, 2, 6, 3, 4, 5]] * ([100] * 3 + [1] * 4),
            "range=0-1,mean=0.485/0.456/0.406,std=0.229/0.224/0.225",
            "--input range=0-1 --output pose=out,form=quaternion_wxyz,unit=cm,axes=opengl",
        ),
    ],
)
def test_the_form_that_fits_is_named(dataset, answers, given, option):
    warning, first, *_ = say(dataset, answers, given)
    assert warning.startswith("warning: the network is no better than the mean pose of 24 frames")
    assert first.startswith(f"with {option} the median error would be ")
    error_m = float(first.split(" would be ")[1].split()[0])
    assert error_m < 1e-3


def test_a_good_network_is_silent_and_a_bad_one_has_no_form_that_fits(dataset):
    assert say(dataset, POSES) == []
    lines = say(dataset, R.permutation(POSES) * ([1.5] * 3 + [5.0] * 4), size="48x64")
    assert "the quaternion in out has the length 5: is it one?" in lines[0]
    assert lines[1:] == [
        "no other quaternion order, direction, axes, unit, channel order, range, crop or size that "
        "was tried fits either; is it a network of this place and this world frame?"
    ]


def test_the_mean_pose_has_the_error_of_a_constant_answer():
    mean = mean_pose_error(POSES)
    distance = np.linalg.norm(POSES[:, :3] - POSES[:, :3].mean(axis=0), axis=1)
    assert mean.position_m == pytest.approx(np.median(distance))
    assert median_error(POSES, POSES).shares(mean) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert median_error(POSES * np.nan, POSES).position_m == np.inf
