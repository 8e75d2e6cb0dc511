"""Other engines on the same two cores: the network of a CJP bundle, in turns with ours.

    pip install -e ".[peers]"
    python bench/peers.py

Whole MobileNetV2 and ResNet34 at 224x224, one frame, two threads for each engine. Ours is timed
from an array of 640x480 to intervals; a peer from a prepared input to pose and bounds, without the
work around the network. A peer that is not installed is reported in one line. A float32 peer whose
outputs differ from ours is not timed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnxruntime
import torch
from networks import BACKBONES, WORK, images, whole_bundle
from numpy.typing import NDArray
from rounds import Array, figures, interleaved, just_written, ratio, write_report

from cvo_edge.input import preprocess
from cvo_edge.odometer import Odometer
from cvo_export.training.run import PoseGraph, load_run

THREADS, ROUNDS, WARM_UP = 2, 40, 5
# OpenMP's threads spin for a fifth of a second after a call.
PAUSE_S, WARM_CALLS = 0.25, 3
# Largest difference of a float32 peer from ours: in metres, radians and quaternion units, and in
# standard deviations of that output over the compared images.
LARGEST_DIFFERENCE, LARGEST_SHARE = 1e-3, 0.1
# How much more than our own 8 bits another reduced precision may change the outputs.
LARGEST_ROUNDING = 5.0

# What is compared. Graphs of bundles have an alarm, too, which other forms of the network lack.
OUTPUTS = ("pose", "lower", "upper")

Outputs = list[NDArray[np.float32]]
Call = Callable[[preprocess.Image], Outputs]


class Network:
    """One backbone's CJP network in every form that an engine loads."""

    def __init__(self, backbone: str) -> None:
        self.backbone = backbone
        self.frames = [model_input(image) for image in images()]
        self.converted = WORK / "peers"
        self.converted.mkdir(parents=True, exist_ok=True)

    def onnx(self, precision: str, provider: str = "onnxruntime") -> str:
        """Path of the bundle's graph."""
        return str(self.bundle(precision, provider) / "model.onnx")

    def bundle(self, precision: str, provider: str = "onnxruntime") -> Path:
        """Folder of the bundle."""
        return whole_bundle("cjp", self.backbone, precision, provider=provider)

    @cached_property
    def graph(self) -> PoseGraph:
        """The network before its export."""
        self.bundle("fp32")
        return load_run(WORK / "runs" / f"cjp-{self.backbone}").graph


class Normalised(torch.nn.Module):
    """The network after its normalisation, for engines that do not take 8-bit pixels."""

    def __init__(self, graph: PoseGraph) -> None:
        super().__init__()
        self.graph = graph

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Image (1, 3, height, width), normalised -> pose, lower, upper."""
        backbone = self.graph.backbone
        feature_map = backbone.body.forward_features(image)
        outputs: tuple[torch.Tensor, ...] = self.graph.head(feature_map.mean(dim=(2, 3)))
        return outputs


class Peer(NamedTuple):
    """An engine: the precision it computes in, its packages, and how it loads a network."""

    precision: str
    packages: tuple[str, ...]
    load: Callable[[Network], Call]


def model_input(image_bgr: preprocess.Image) -> preprocess.Image:
    """Return the bundles' input, (1, 224, 224, 3) uint8 RGB."""
    return preprocess.model_input(image_bgr, 224, 224, "centre")


def onnxruntime_defaults(network: Network, precision: str) -> Call:
    """Load the graph with default settings but for the number of threads."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = THREADS
    session = onnxruntime.InferenceSession(network.onnx(precision), options)
    return lambda image: session.run(OUTPUTS, {"image": image})


def torch_eager(network: Network) -> Call:
    """Run the graph as it was trained."""
    torch.set_num_threads(THREADS)
    graph = network.graph

    def call(image: preprocess.Image) -> Outputs:
        with torch.inference_mode():
            return [values.numpy() for values in graph(torch.from_numpy(image))]

    return call


def openvino(network: Network, precision: str, hint: str = "f32") -> Call:
    """Compile our graph for latency, with this inference precision as a hint."""
    import openvino as ov

    settings = {
        "PERFORMANCE_HINT": "LATENCY",
        "NUM_STREAMS": 1,
        "INFERENCE_NUM_THREADS": THREADS,
        "INFERENCE_PRECISION_HINT": hint,
    }
    # In 8 bits, the graph of the other engine has another first convolution.
    graph = network.onnx(precision, "openvino" if precision == "int8" else "onnxruntime")
    request = ov.Core().compile_model(graph, "CPU", settings).create_infer_request()

    def call(image: preprocess.Image) -> Outputs:
        found = request.infer([image], share_inputs=True, share_outputs=True)
        return [found[index] for index in range(3)]

    return call


def openvino_own_choice() -> str:
    """Return the precision in which OpenVINO computes float32 graphs here by default."""
    import openvino as ov

    return str(ov.Core().get_property("CPU", "INFERENCE_PRECISION_HINT").get_type_name())


def litert(network: Network) -> Call:
    """Convert the torch graph, 8-bit pixels and all; its kernels on x86-64 are XNNPACK's."""
    from ai_edge_litert.interpreter import Interpreter

    path = network.converted / f"{network.backbone}.tflite"
    if not path.exists():
        import litert_torch

        example = torch.from_numpy(network.frames[0])
        litert_torch.convert(network.graph, (example,)).export(str(path))
    interpreter = Interpreter(str(path), num_threads=THREADS)
    interpreter.allocate_tensors()
    target = interpreter.get_input_details()[0]["index"]
    sources = [detail["index"] for detail in interpreter.get_output_details()]

    def call(image: preprocess.Image) -> Outputs:
        interpreter.set_tensor(target, image)
        interpreter.invoke()
        return [interpreter.get_tensor(source) for source in sources]

    return call


def ncnn(network: Network) -> Call:
    """Convert the torch graph; pixels are cast and normalised by ncnn's own functions."""
    import ncnn as engine

    path = network.converted / f"{network.backbone}.ncnn.param"
    if not path.exists():
        import pnnx

        example = torch.zeros((1, 3, *network.frames[0].shape[1:3]))
        stem = network.converted / f"{network.backbone}.pt"
        # By default it keeps weights in 16 bits.
        pnnx.export(Normalised(network.graph), str(stem), (example,), fp16=False)
    net = engine.Net()
    net.opt.num_threads = THREADS
    # Otherwise weights and feature maps are rounded to 16 bits on processors that support it.
    net.opt.use_fp16_packed = net.opt.use_fp16_storage = net.opt.use_fp16_arithmetic = False
    net.opt.use_bf16_storage = False
    net.load_param(str(path))
    net.load_model(str(path.with_suffix(".bin")))
    backbone = network.graph.backbone
    mean = [255.0 * value for value in backbone.mean]
    scale = [1.0 / (255.0 * value) for value in backbone.std]

    def call(image: preprocess.Image) -> Outputs:
        height, width = image.shape[1:3]
        pixels = engine.Mat.from_pixels(image[0], engine.Mat.PixelType.PIXEL_RGB, width, height)
        pixels.substract_mean_normalize(mean, scale)
        with net.create_extractor() as extractor:
            extractor.input("in0", pixels)
            return [np.array(extractor.extract(f"out{index}")[1]) for index in range(3)]

    return call


PEERS = {
    "onnxruntime defaults": Peer("fp32", (), partial(onnxruntime_defaults, precision="fp32")),
    "torch eager": Peer("fp32", (), torch_eager),
    "openvino": Peer("fp32", ("openvino",), partial(openvino, precision="fp32")),
    "litert": Peer("fp32", ("ai-edge-litert", "litert-torch"), litert),
    "ncnn": Peer("fp32", ("ncnn", "pnnx"), ncnn),
    "onnxruntime defaults int8": Peer("int8", (), partial(onnxruntime_defaults, precision="int8")),
    "openvino int8": Peer("int8", ("openvino",), partial(openvino, precision="int8")),
}


def missing(peer: Peer) -> list[str]:
    """Return which of a peer's packages are not installed."""
    modules = {name: name.replace("-", "_") for name in peer.packages}
    return [name for name, module in modules.items() if find_spec(module) is None]


def compared_images(network: Network) -> list[preprocess.Image]:
    """Return inputs on which outputs differ: frames, the self-test's rings, noise, black, white."""
    noise = np.random.default_rng(0).integers(0, 256, network.frames[0].shape, dtype=np.uint8)
    rings = model_input(preprocess.selftest_image(480, 640))
    return [*network.frames[::10], rings, noise, np.zeros_like(noise), np.full_like(noise, 255)]


def numbers(call: Call, inputs: list[preprocess.Image]) -> Array:
    """Pose, lower and upper of every input in one row, (inputs, 19)."""
    return np.array([np.concatenate([out.ravel() for out in call(one)]) for one in inputs], float)


def network_of(odometer: Odometer) -> Call:
    """Return our call of the network alone."""
    if odometer.session is None:
        raise SystemExit("expected an open odometer, found a closed one")
    engine = odometer.session.engine
    return lambda image: engine.run(OUTPUTS, {"image": image})


def measured(backbone: str, peers: dict[str, Peer]) -> dict[str, Any]:
    """Compare and time all engines on one network."""
    network = Network(backbone)
    pictures, inputs = images(), compared_images(network)
    ours = {p: Odometer.load(network.bundle(p), threads=THREADS) for p in ("fp32", "int8")}
    exact, rounded = (numbers(network_of(odometer), inputs) for odometer in ours.values())
    rounding = float(np.abs(rounded - exact).max())
    found: dict[str, Any] = {}
    calls: dict[str, Callable[[int], object]] = {}
    before: dict[str, Callable[[int], object]] = {}
    steps = {f"ours {precision}": odometer.step for precision, odometer in ours.items()}
    if "openvino" in peers:
        odometer = Odometer.load(network.bundle("int8", "openvino"), threads=THREADS)
        steps["ours int8, calibrated on openvino"] = odometer.step
    for name, step in steps.items():
        before[name], calls[name] = just_written(pictures, step)
    for name, peer in peers.items():
        call = peer.load(network)
        off = np.abs(numbers(call, inputs) - exact)
        difference, share = float(off.max()), float((off / exact.std(axis=0)).max())
        found[name] = {
            "precision": peer.precision,
            "largest_difference": float(f"{difference:.3g}"),
            "largest_difference_in_deviations": float(f"{share:.3g}"),
            "versions": {package: version(package) for package in peer.packages},
        }
        if peer.precision == "fp32":
            right = difference <= LARGEST_DIFFERENCE and share <= LARGEST_SHARE
        else:
            right = difference <= LARGEST_ROUNDING * rounding
        # In this form NaN is refused.
        if right:
            before[name], calls[name] = just_written(network.frames, call)
    spent = interleaved(
        calls,
        rounds=ROUNDS,
        warmup=WARM_UP,
        pause_s=PAUSE_S,
        warm_calls=WARM_CALLS,
        before=before,
    )
    for name, ms in spent.items():
        row = found.setdefault(name, {"precision": name.removeprefix("ours ").partition(",")[0]})
        against = "int8" if row["precision"] == "int8" else "fp32"
        row |= {"ms": figures(ms), "over_ours": ratio(ms, spent[f"ours {against}"])}
    found["ours int8"]["largest_difference"] = float(f"{rounding:.3g}")
    plain, ours_there = "openvino int8", "ours int8, calibrated on openvino"
    for name in ("ours int8", ours_there):
        if plain in spent and name in spent:
            found[name]["over_openvino"] = ratio(spent[name], spent[plain])
    return found


def line(name: str, row: dict[str, Any]) -> str:
    """Return one engine's figures as text."""
    start = f"  {name:<34} {row['precision']:<5}"
    difference = "ours"
    if "largest_difference" in row:
        difference = f"difference {row['largest_difference']:.1e}"
    if "over_openvino" in row:
        difference += f", {row['over_openvino']['median']:.2f} times plain OpenVINO"
    if "ms" not in row:
        return f"{start} not timed: other numbers than ours, {difference}"
    return (
        f"{start} {row['ms']['median']:8.3f} ms (p95 {row['ms']['p95']:8.3f}), "
        f"{row['over_ours']['median']:6.2f} times ours, {difference}"
    )


def main() -> None:
    """Time all engines that are installed on both networks."""
    absent = {name: missing(peer) for name, peer in PEERS.items()}
    for name, packages in absent.items():
        if packages:
            print(f"{name}: {', '.join(packages)} not installed, left out")
    present = {name: peer for name, peer in PEERS.items() if not absent[name]}
    results: dict[str, Any] = {}
    if "openvino" in present:
        own = results["openvino_own_choice"] = openvino_own_choice()
        print(f"OpenVINO computes float32 graphs in {own} here unless it is told otherwise")
        if own != "f32":
            load = partial(openvino, precision="fp32", hint=own)
            present[f"openvino {own}"] = Peer(own, ("openvino",), load)
    for backbone in BACKBONES:
        results[backbone] = measured(backbone, present)
        print(f"{backbone}, {THREADS} threads")
        for name, row in results[backbone].items():
            print(line(name, row), flush=True)
    results["left_out"] = {name: packages for name, packages in absent.items() if packages}
    write_report(
        "peers",
        results,
        threads=THREADS,
        rounds=ROUNDS,
        warmup=WARM_UP,
        pause_s=PAUSE_S,
        warm_calls=WARM_CALLS,
    )


if __name__ == "__main__":
    main()
