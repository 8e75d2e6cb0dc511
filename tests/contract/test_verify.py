"""Models that a matching digest does not make safe: ``verify`` terminates and reports them."""

import hashlib
import math
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest

from cvo_edge import BundleMismatchError, GateError, ModelCache, ModelError, Odometer
from cvo_edge.bundle.format import MODEL_FILE
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.programs.verify import verify_bundle

onnx = pytest.importorskip("onnx")

RUN = "from cvo_edge.__main__ import main; main()"


def model_with(pieces, constants, bundle):
    """A model whose outputs depend on ``huge``, which the pieces compute."""
    helper, proto = onnx.helper, onnx.TensorProto
    nodes = [
        helper.make_node("Cast", ["image"], ["real"], to=proto.FLOAT),
        helper.make_node("ReduceMin", ["real"], ["least"], keepdims=0),
        *pieces,
    ]
    outputs = []
    for spec in bundle.calibration.model.outputs:
        values = np.zeros(spec.shape, np.float32)
        constants.append(onnx.numpy_helper.from_array(values, f"{spec.name}_values"))
        nodes.append(helper.make_node("Add", [f"{spec.name}_values", "huge"], [spec.name]))
        outputs.append(helper.make_tensor_value_info(spec.name, proto.FLOAT, list(spec.shape)))
    image = bundle.calibration.model.inputs[0]
    inputs = [helper.make_tensor_value_info("image", proto.UINT8, list(image.shape))]
    graph = helper.make_graph(nodes, "hostile", inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    return model.SerializeToString()


def endless(bundle):
    """A loop of 2^62 iterations, in a few hundred bytes."""
    helper, proto = onnx.helper, onnx.TensorProto
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["going"], ["still_going"]),
            helper.make_node("Sin", ["value"], ["next_value"]),
        ],
        "body",
        [
            helper.make_tensor_value_info("turn", proto.INT64, []),
            helper.make_tensor_value_info("going", proto.BOOL, []),
            helper.make_tensor_value_info("value", proto.FLOAT, []),
        ],
        [
            helper.make_tensor_value_info("still_going", proto.BOOL, []),
            helper.make_tensor_value_info("next_value", proto.FLOAT, []),
        ],
    )
    constants = [
        onnx.numpy_helper.from_array(np.array(2**62), "turns"),
        onnx.numpy_helper.from_array(np.array(True), "yes"),
    ]
    pieces = [helper.make_node("Loop", ["turns", "yes", "least"], ["huge"], body=body)]
    return model_with(pieces, constants, bundle)


def enormous(bundle):
    """3 GiB of zeros, which the machine could allocate, in a few hundred bytes."""
    helper, proto = onnx.helper, onnx.TensorProto
    constants = [onnx.numpy_helper.from_array(np.array([3 * 2**28]), "elements")]
    pieces = [
        helper.make_node("Cast", ["least"], ["one"], to=proto.INT64),
        helper.make_node("Sub", ["one", "one"], ["none"]),
        helper.make_node("Add", ["elements", "none"], ["asked"]),
        helper.make_node("ConstantOfShape", ["asked"], ["zeros"]),
        helper.make_node("ReduceMax", ["zeros"], ["huge"], keepdims=0),
    ]
    return model_with(pieces, constants, bundle)


def different(bundle):
    """A model that loads and yields other outputs."""
    pieces = [onnx.helper.make_node("Identity", ["least"], ["huge"])]
    return model_with(pieces, [], bundle)


def damaged(bundle):
    """Half of the model's bytes."""
    return bundle.model_bytes[: len(bundle.model_bytes) // 2]


@pytest.fixture
def with_model(copied_bundle, rewrite, bundle):
    """Put a model into the copied bundle and update all digests."""

    def put(content):
        (copied_bundle / MODEL_FILE).write_bytes(content)
        digest = hashlib.sha256(content).hexdigest()
        model = msgspec.structs.replace(bundle.calibration.model, sha256=digest, precision="fp32")
        return rewrite(msgspec.structs.replace(bundle.calibration, model=model))

    return put


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (endless, ModelError, "did not end within 3 s"),
        (enormous, ModelError, "model.onnx: (inference failed|refused)"),
        (damaged, ModelError, "refused by onnxruntime"),
        (different, GateError, "self-test: expected outputs within"),
    ],
)
def test_whatever_the_model_does_verify_ends_and_says_so(with_model, bundle, make, error, words):
    folder = with_model(make(bundle))
    with pytest.raises(error, match=words) as caught:
        verify_bundle(folder, threads=1, timeout_s=3.0 if make is endless else 60.0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("provider", ["onnxruntime", "openvino"])
def test_a_model_that_reaches_for_files_is_refused(
    with_model, copied_bundle, rewrite, bundle, tmp_path, monkeypatch, provider
):
    """Otherwise, write access to the working folder would suffice to change a signed model."""
    if provider == "openvino":
        pytest.importorskip("openvino")
    model = onnx.load_from_string(bundle.model_bytes)
    weights = max(model.graph.initializer, key=lambda each: len(each.raw_data))
    for folder in (tmp_path, copied_bundle):
        (folder / "weights.bin").write_bytes(weights.raw_data)
    onnx.external_data_helper.set_external_data(weights, "weights.bin")
    weights.ClearField("raw_data")
    folder = with_model(model.SerializeToString())
    calibration = read_calibration(folder)
    spec = msgspec.structs.replace(calibration.model, provider=provider)
    rewrite(msgspec.structs.replace(calibration, model=spec))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError, match="refused by onnxruntime"):
        verify_bundle(folder, threads=1)
    for cache in (None, ModelCache(tmp_path / "cache")):
        with pytest.raises(ModelError, match="refused by onnxruntime"):
            Odometer.load(folder, cache=cache)


def test_the_good_one_passes_and_names_itself(bundle_dir, bundle):
    verdict = verify_bundle(bundle_dir, threads=1)
    assert verdict.name == bundle.calibration.name
    assert verdict.largest_difference <= verdict.tolerance


def test_modules_in_the_current_folder_are_not_taken(bundle_dir, tmp_path, monkeypatch):
    for name in ("numpy", "onnxruntime", "json", "cvo_edge"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(99)\n")
    monkeypatch.chdir(tmp_path)
    assert verify_bundle(bundle_dir, threads=1).tolerance > 0


def test_a_signal_while_the_process_starts_leaves_none_behind(with_model, bundle, tmp_path):
    folder = with_model(endless(bundle))
    started = tmp_path / "started"
    interrupted = f"""
import os, signal, subprocess
start = subprocess.Popen._execute_child

def start_and_signal(self, *rest):
    start(self, *rest)
    open({str(started)!r}, "w").write(str(self.pid))
    os.kill(os.getpid(), signal.SIGTERM)

subprocess.Popen._execute_child = start_and_signal
"""
    command = [sys.executable, "-P", "-c", interrupted + RUN, "verify", folder]
    assert subprocess.run(command, check=False).returncode == 143
    with pytest.raises(ProcessLookupError):
        os.kill(int(started.read_text()), 0)


def test_a_terminated_verify_leaves_no_process_behind(with_model, bundle):
    folder = with_model(endless(bundle))
    process = subprocess.Popen([sys.executable, "-P", "-c", RUN, "verify", folder])
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    while not (found := children.read_text("ascii").split()):
        assert process.poll() is None
        time.sleep(0.05)
    (child,) = map(int, found)
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 143
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_many_threads_have_room_for_their_stacks(bundle_dir):
    stack = 64 << 20
    command = [sys.executable, "-P", "-c", RUN, "verify", bundle_dir, "--threads", "32"]
    done = subprocess.run(
        [*map(str, command)],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_STACK, (stack, stack)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_what_is_said_has_a_bound(rewrite, bundle):
    """A message longer than a pipe's buffer would block the process until it is read."""
    model = bundle.calibration.model
    more = tuple(
        msgspec.structs.replace(model.outputs[0], name="\U0001f600" * 190 + str(number))
        for number in range(30)
    )
    outputs = {
        **bundle.calibration.selftest.outputs,
        **{spec.name: [0.0] * math.prod(spec.shape) for spec in more},
    }
    folder = rewrite(
        msgspec.structs.replace(
            bundle.calibration,
            model=msgspec.structs.replace(model, outputs=(*model.outputs, *more)),
            selftest=msgspec.structs.replace(bundle.calibration.selftest, outputs=outputs),
        )
    )
    with pytest.raises(BundleMismatchError, match="expected") as caught:
        verify_bundle(folder, threads=1)
    assert len(str(caught.value)) <= 1000
