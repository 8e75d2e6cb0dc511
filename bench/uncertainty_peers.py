"""Other sources of uncertainty: MC-dropout with 30 passes, and an ensemble of five networks.

    python bench/uncertainty_peers.py

One frame of ours (CJP, an array of 640x480 to intervals) takes turns with both, from the same array
to mean and deviation, on onnxruntime with two threads in all. Each runs in several forms; the
fastest form that runs whole networks counts, beside the naive form and the form that computes the
backbone once. Weights are random, which does not change the time. Scores come from
``bench/results/compare``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from networks import BACKBONES, WORK, images, open_branches, whole_bundle
from numpy.typing import NDArray
from onnx import compose
from provenance import read_result, result_files
from rounds import Array, figures, interleaved, just_written, ratio, write_report
from torch import Tensor, nn

from cvo_edge.engine.session import Session
from cvo_edge.input import preprocess
from cvo_edge.odometer import Odometer
from cvo_export.graph.to_onnx import export_onnx
from cvo_export.networks.backbone import Backbone
from cvo_export.networks.baselines.base import IntervalHead, TrunkConfig, trunk
from cvo_export.networks.baselines.ensemble import MEMBERS, EnsembleConfig, EnsembleNetwork
from cvo_export.networks.baselines.gaussian import GaussianConfig, GaussianNetwork
from cvo_export.networks.baselines.mc_dropout import PASSES, McDropoutConfig, McDropoutNetwork
from cvo_export.networks.heads.base import DOF, Setting
from cvo_export.networks.standardised import PoseDecoder
from cvo_export.training.run import PoseGraph, Run, load_run

THREADS, ROUNDS, WARM_UP = 2, 30, 3
# Threads of the naive forms spin for milliseconds after a call.
PAUSE_S, WARM_CALLS = 0.01, 1
DROPOUT = 0.1
NAIVE, SHARED = "naive", "one backbone"

# One image -> poses (n, 7), in one array or several.
Call = Callable[[preprocess.Image], Sequence[NDArray[np.float32]]]


class RandomDropout(nn.Module):
    """Dropout that stays on: each pass zeroes channels or units drawn in the graph."""

    def __init__(self, passes: int) -> None:
        super().__init__()
        self.passes = passes

    def forward(self, x: Tensor) -> Tensor:
        """Shape (1 or passes, channels, ...) -> (passes, channels, ...)."""
        shape = (self.passes, x.shape[1], *[1] * (x.ndim - 2))
        return x * (torch.rand(shape) >= DROPOUT) / (1.0 - DROPOUT)


class DropoutGraph(nn.Module):
    """A whole network with dropout after every stage of the backbone and every hidden layer.

    After Kendall and Cipolla 2016, for camera poses. The layers before the first dropout are
    computed once for all passes.
    """

    def __init__(self, run: Run, passes: int) -> None:
        super().__init__()
        self.backbone = random_backbone(run)
        body = self.backbone.body
        for info in body.feature_info:
            stage = body.get_submodule(info["module"])
            body.set_submodule(info["module"], nn.Sequential(stage, RandomDropout(passes)))
        layers = trunk(self.backbone.size, TrunkConfig(), DOF, DROPOUT)
        dropped = (RandomDropout(passes) if isinstance(x, nn.Dropout) else x for x in layers)
        self.layers = nn.Sequential(*dropped)
        self.decoder = PoseDecoder(run.target)

    def forward(self, image: Tensor) -> Tensor:
        """Image (1, height, width, 3), uint8 -> pose of each pass, (passes, 7)."""
        pose: Tensor = self.decoder.pose(self.decoder(self.layers(self.backbone(image))))
        return pose


def random_backbone(run: Run) -> Backbone:
    """Return a backbone of the run's kind with new random weights."""
    config = run.config
    backbone = Backbone(config.backbone, config.height, config.width)
    open_branches(backbone.body)
    return backbone


def graphs(backbone: str) -> dict[str, bytes]:
    """Return every timed network as ONNX by name; the files are kept beside the bundles."""
    run = load_run(WORK / "runs" / f"cjp-{backbone}")
    setting = Setting(run.graph.backbone.size, run.target, 0)

    def member() -> nn.Module:
        head = IntervalHead(GaussianNetwork(setting, GaussianConfig()), setting)
        return PoseGraph(random_backbone(run), head)

    def heads(network: McDropoutNetwork | EnsembleNetwork) -> nn.Module:
        return PoseGraph(run.graph.backbone, IntervalHead(network, setting))

    made: dict[str, Callable[[], nn.Module]] = {
        "pass": partial(DropoutGraph, run, 1),
        "passes": partial(DropoutGraph, run, PASSES),
        "dropout-heads": lambda: heads(McDropoutNetwork(setting, McDropoutConfig())),
        "ensemble-heads": lambda: heads(EnsembleNetwork(setting, EnsembleConfig())),
        **{f"member{number}": member for number in range(MEMBERS)},
    }
    image = torch.zeros((1, run.config.height, run.config.width, 3), dtype=torch.uint8)
    folder = WORK / "peers"
    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for seed, (name, make) in enumerate(made.items()):
        path = folder / f"{backbone}-{name}.onnx"
        if not path.exists():
            torch.manual_seed(seed)
            names = ["pose"] if name.startswith("pass") else IntervalHead.output_names
            path.write_bytes(export_onnx(make(), [image], ["image"], names))
        found[name] = path.read_bytes()
    return found


def merged(members: Sequence[bytes]) -> bytes:
    """Return one graph of several networks with a common input and all their outputs."""
    whole, *others = (
        compose.add_prefix(onnx.load_from_string(content), f"{number}.", rename_inputs=False)
        for number, content in enumerate(members)
    )
    for other in others:
        for part in ("node", "initializer", "output", "value_info"):
            getattr(whole.graph, part).extend(getattr(other.graph, part))
    content: bytes = whole.SerializeToString()
    return content


def plain(content: bytes) -> Call:
    """Return a network on onnxruntime with default settings but for the number of threads."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = THREADS
    session = onnxruntime.InferenceSession(content, options)
    return lambda image: session.run(["pose"], {"image": image})


def resting(content: bytes, threads: int = THREADS, outputs: str = "pose") -> Call:
    """Return a network with our settings: its threads do not spin between calls."""
    session = Session(content, threads).engine
    names = [spec.name for spec in session.get_outputs() if spec.name.endswith(outputs)]
    return lambda image: session.run(names, {"image": image})


def in_turn(networks: Sequence[Call]) -> Call:
    """Call one after the other."""
    return lambda image: [poses for network in networks for poses in network(image)]


def in_workers(networks: Sequence[Call]) -> Call:
    """Call networks of one thread each, as many at a time as there are threads."""
    pool = ThreadPoolExecutor(THREADS)

    def call(image: preprocess.Image) -> list[NDArray[np.float32]]:
        found = pool.map(lambda network: network(image), networks)
        return [poses for several in found for poses in several]

    return call


def forms(found: dict[str, bytes]) -> dict[str, dict[str, Call]]:
    """Every form of both, by name."""
    members = [found[f"member{number}"] for number in range(MEMBERS)]
    return {
        "mc-dropout": {
            NAIVE: in_turn([plain(found["pass"])] * PASSES),
            "threads that rest": in_turn([resting(found["pass"])] * PASSES),
            "a worker for each core": in_workers([resting(found["pass"], 1)] * PASSES),
            "one batch": resting(found["passes"]),
            SHARED: resting(found["dropout-heads"]),
        },
        "ensemble": {
            NAIVE: in_turn([plain(content) for content in members]),
            "threads that rest": in_turn([resting(content) for content in members]),
            "a worker for each core": in_workers([resting(one, 1) for one in members]),
            # One thread pool for all five; onnxruntime's global one gives a process no other.
            "merged graph": resting(merged(members)),
            SHARED: resting(found["ensemble-heads"]),
        },
    }


def summary(call: Call, picture: preprocess.Image) -> tuple[Array, Array]:
    """Mean and deviation (7,) of the poses of one camera image."""
    poses = np.concatenate(call(preprocess.model_input(picture, 224, 224, "centre")))
    return poses.mean(axis=0), poses.std(axis=0)


def check(kind: str, calls: dict[str, Call], picture: preprocess.Image) -> None:
    """Refuse passes that are all equal, and forms of one ensemble that differ."""
    found = {name: summary(call, picture) for name, call in calls.items() if name != SHARED}
    expected, _ = found[NAIVE]
    for name, (mean, deviation) in found.items():
        if not deviation.any():
            raise SystemExit(f"{kind}, {name}: expected passes that differ, found equal ones")
        if kind == "ensemble" and not np.allclose(mean, expected, rtol=0.0, atol=1e-4):
            raise SystemExit(f"{kind}, {name}: expected {expected}, found {mean}")


def measured(backbone: str) -> dict[str, Any]:
    """Time one frame of ours and every form of both."""
    bundle = whole_bundle("cjp", backbone)
    kinds, pictures = forms(graphs(backbone)), images()
    with Odometer.load(bundle, threads=THREADS) as odometer:
        before: dict[str, Callable[[int], object]] = {}
        calls: dict[str, Callable[[int], object]] = {}
        before["ours"], calls["ours"] = just_written(pictures, odometer.step)
        for kind, named in kinds.items():
            check(kind, named, pictures[0])
            for name, call in named.items():
                key = f"{kind}, {name}"
                before[key], calls[key] = just_written(pictures, partial(summary, call))
        spent = interleaved(
            calls,
            rounds=ROUNDS,
            warmup=WARM_UP,
            pause_s=PAUSE_S,
            warm_calls=WARM_CALLS,
            before=before,
        )
    ours = spent["ours"]
    found: dict[str, Any] = {"ours": {"ms": figures(ours)}}
    for kind, named in kinds.items():
        times = {name: spent[f"{kind}, {name}"] for name in named}
        fastest = min(set(times) - {SHARED}, key=lambda name: float(np.median(times[name])))
        found[kind] = {
            "forms": {
                name: {"ms": figures(ms), "over_ours": ratio(ms, ours)}
                for name, ms in times.items()
            },
            "fastest": fastest,
            "fastest_over_ours": ratio(times[fastest], ours)["median"],
        }
    return found


def scores() -> dict[str, dict[str, float]]:
    """Return the median interval score by recording and method, from the comparison."""
    found: dict[str, dict[str, float]] = {}
    for path in result_files("compare"):
        cells = read_result("compare", path.stem)["cells"]
        row = found[path.stem] = {}
        for method in ("cjp", "mc-dropout", "ensemble"):
            for bounds, name in (("own", f"{method}, own bounds"), ("marginal", method)):
                found_scores = [
                    cell[bounds]["normalised_interval_score"]
                    for cell in cells
                    if cell["method"] == method and cell[bounds]
                ]
                if found_scores:
                    row[name] = round(float(np.median(found_scores)), 4)
    return found


def main() -> None:
    """Time both on both networks; print times and scores."""
    results: dict[str, Any] = {}
    for backbone in BACKBONES:
        found = results[backbone] = measured(backbone)
        print(f"{backbone}: ours {found['ours']['ms']['median']:.3f} ms")
        for kind in ("mc-dropout", "ensemble"):
            row = found[kind]
            for name, form in row["forms"].items():
                print(
                    f"  {kind:<10} {name:<22} {form['ms']['median']:9.3f} ms, "
                    f"{form['over_ours']['median']:6.2f} times ours"
                )
            print(f"  {kind:<10} fastest: {row['fastest']}", flush=True)
    results["interval_scores"] = scores()
    for recording, row in results["interval_scores"].items():
        print(f"scores, {recording}: {', '.join(f'{name} {x:.3f}' for name, x in row.items())}")
    write_report(
        "uncertainty_peers",
        results,
        threads=THREADS,
        rounds=ROUNDS,
        warmup=WARM_UP,
        pause_s=PAUSE_S,
        warm_calls=WARM_CALLS,
        passes=PASSES,
        members=MEMBERS,
    )


if __name__ == "__main__":
    main()
