"""Whether a network that sees two frames beats the geometric front end on their relative motion.

    python bench/two_frames.py DATASET WORK [--network stacked|correlated] [--steps N]

Trains on the data set's own training sequences (without a list: the first three quarters) and
compares rotation and direction of translation on the neighbouring frames of the others with those
of ``cvo-edge odometry``. ``stacked`` learns from both grey images, as in DeepVO (Wang et al. 2017);
``correlated`` from the correlation of MobileNetV2's features at stride 4 within four cells, as in
FlowNetC (Dosovitskiy et al. 2015). WORK keeps features and the network, so that a run goes on.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from provenance import RESULTS, write_result
from torch import Tensor, nn
from torch.nn import functional

from cvo_edge import geometry
from cvo_edge.frontend.odometry import FrontEnd
from cvo_edge.motion.relative import motion
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.networks.backbone import Backbone, BackboneConfig, load_weights

Array = NDArray[np.float64]

HEIGHT, WIDTH = 120, 160
# Training also sees every second and third frame, forwards and backwards in time, and mirrored.
STRIDES = (1, 2, 3, -1, -2, -3)
BATCH, RATE, SHARE = 32, 1e-3, 0.75
# Rotation that is added to the second image, standard deviation in rad, and change of brightness.
TURN, LIGHT = 0.01, 0.1
REACH = 4
MIRRORED = np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0])


class Stacked(nn.Module):
    """Two grey images (n, 2, HEIGHT, WIDTH) -> standardised t and rotation vector (n, 6)."""

    def __init__(self) -> None:
        super().__init__()
        self.net = _head(((2, 32, 7, 2), (32, 64, 5, 2), (64, 128, 3, 2), (128, 128, 3, 1)), 64)

    def forward(self, pair: Tensor) -> Tensor:
        """Return the standardised motion."""
        return self.net(pair)


class Correlated(nn.Module):
    """Features (n, 2, c, h, w) of both frames -> standardised t and rotation vector (n, 6)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        cells = (2 * REACH + 1) ** 2
        self.net = _head(((cells + channels, 96, 3, 2), (96, 128, 3, 2), (128, 128, 3, 1)), 64)

    def forward(self, pair: Tensor) -> Tensor:
        """Return the standardised motion."""
        # The features are constants, and their correlation is most of the work.
        with torch.no_grad():
            first, second = functional.normalize(pair, dim=2).to(torch.bfloat16).unbind(1)
            height, width = first.shape[-2:]
            wide = functional.pad(second, [REACH] * 4)
            found = [
                (first * wide[..., row : row + height, column : column + width]).sum(1)
                for row in range(2 * REACH + 1)
                for column in range(2 * REACH + 1)
            ]
            seen = torch.cat([torch.stack(found, dim=1), first], dim=1)
        return self.net(seen)


def _head(layers: tuple[tuple[int, int, int, int], ...], last: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for inputs, outputs, size, stride in (*layers, (layers[-1][1], last, 3, 2)):
        parts += [
            nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(),
        ]
    # Where in the image something moves tells turning from moving: keep the place.
    return nn.Sequential(
        *parts, nn.Flatten(), nn.LazyLinear(256), nn.ReLU(), nn.Dropout(0.1), nn.Linear(256, 6)
    )


class Pairs:
    """The frames of a data set as a network sees them, and the motions between them."""

    def __init__(self, data: PoseDataset, network: str, work: Path) -> None:
        self.data, self.network = data, network
        if data.intrinsics is None:
            raise SystemExit(f"{data.name}: expected a camera with intrinsics")
        kept = work / f"{data.name}.{network}.npy"
        if not kept.is_file():
            read = self._grey if network == "stacked" else _features(*data.read_image(0).shape[:2])
            np.save(kept, np.stack([read(data.read_image(row)) for row in range(len(data))]))
        # (frames, ...) for stacked, (frames, 2, ...) with the mirrored image for correlated.
        self.seen = np.load(kept)
        height, width = data.read_image(0).shape[:2]
        scale = np.array([WIDTH / width, HEIGHT / height, 1.0])[:, np.newaxis]
        fx, fy, cx, cy = data.intrinsics
        self.K = scale * np.array([[fx, 0.0, cx + 0.5], [0.0, fy, cy + 0.5], [0.0, 0.0, 1.0]])
        self.K[:2, 2] -= 0.5

    @staticmethod
    def _grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return cv2.resize(grey, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(np.uint8)

    def motions(self, first: NDArray[np.int64], second: NDArray[np.int64]) -> Array:
        """Return t in metres and rotation vectors (n, 6) in the axes of the first frame."""
        found = motion(self.data.poses[first], self.data.poses[second])
        return np.concatenate([found[:, :3], geometry.quaternion_log(found[:, 3:])], axis=1)

    def whole(self, first: NDArray[np.int64], second: NDArray[np.int64]) -> Tensor:
        """Return the network's input for pairs as they are."""
        if self.network == "stacked":
            pair = np.stack([self.seen[first], self.seen[second]], axis=1)
            return torch.from_numpy(pair.astype(np.float32) / 255.0 - 0.5)
        pair = np.stack([self.seen[first, 0], self.seen[second, 0]], axis=1)
        return torch.from_numpy(pair.astype(np.float32))

    def drawn(self, rows: NDArray[np.int64], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Return a batch of altered pairs that begin at frames of ``rows``, and their motions."""
        first = rng.choice(rows, BATCH)
        second = np.clip(first + rng.choice(STRIDES, BATCH), 0, len(self.data) - 1)
        other = self.data.sequence[first] != self.data.sequence[second]
        second[other] = first[other]
        truth = self.motions(first, second)
        mirrored = rng.random(BATCH) < 0.5
        truth[mirrored] *= MIRRORED
        if self.network == "correlated":
            side = mirrored.astype(int)
            pair = np.stack([self.seen[first, side], self.seen[second, side]], axis=1)
            return torch.from_numpy(pair.astype(np.float32)), torch.from_numpy(truth).float()
        pair = np.stack([self.seen[first], self.seen[second]], axis=1).astype(np.float32)
        pair[mirrored] = pair[mirrored, :, :, ::-1]
        turned = rng.normal(0.0, TURN, (BATCH, 3))
        for each, turn in zip(pair, turned, strict=True):
            R = geometry.quaternion_to_matrix(geometry.quaternion_exp(turn))
            # The second camera turned by R sees pixel K R^T K^-1 p.
            H = self.K @ R.T @ np.linalg.inv(self.K)
            each[1] = cv2.warpPerspective(each[1], H, (WIDTH, HEIGHT), borderValue=127.0)
        rotation = geometry.quaternion_multiply(
            geometry.quaternion_exp(truth[:, 3:]), geometry.quaternion_exp(turned)
        )
        truth[:, 3:] = geometry.quaternion_log(rotation)
        light = 1.0 + rng.normal(0.0, LIGHT, (BATCH, 2, 1, 1))
        pair = (pair / 255.0 - 0.5) * light + rng.normal(0.0, LIGHT / 2, (BATCH, 2, 1, 1))
        return torch.from_numpy(pair).float(), torch.from_numpy(truth).float()


Reader = Callable[[NDArray[np.uint8]], NDArray[Any]]


def _features(height: int, width: int) -> Reader:
    """Return a function from an image to features (2, c, h, w) of it and of its mirror image."""
    backbone = Backbone(BackboneConfig(stages=("4",), grid=(1, 1)), height, width)
    load_weights(
        backbone, str(Path(os.environ["CVO_WEIGHTS"]) / "mobilenetv2_100_imagenet.safetensors")
    )

    def read(image: NDArray[np.uint8]) -> NDArray[np.float16]:
        rgb = image[:, :, ::-1]
        both = torch.from_numpy(np.stack([rgb, rgb[:, ::-1]]))
        with torch.no_grad():
            (found,) = backbone.maps(both)
        return found.numpy().astype(np.float16)

    return read


def split(data: PoseDataset) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows of training, and the first rows of the pairs of neighbours to test on."""
    count = len(data.sequence_names)
    test = data.own_test or frozenset(range(int(SHARE * count), count))
    tested = np.isin(data.sequence, list(test))
    followed = np.append(data.sequence[1:] == data.sequence[:-1], False)
    return np.flatnonzero(~tested), np.flatnonzero(tested & followed)


def train(pairs: Pairs, rows: NDArray[np.int64], steps: int, kept: Path) -> tuple[nn.Module, Array]:
    """Train a network or go on where a run ended; returns it and the motions' deviations (6,)."""
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    spread = pairs.motions(rows[:-1], rows[1:])[np.diff(pairs.data.sequence[rows]) == 0].std(axis=0)
    channels = 0 if pairs.network == "stacked" else pairs.seen.shape[2]
    net: nn.Module = Correlated(channels) if channels else Stacked()
    with torch.autocast("cpu", torch.bfloat16):
        net(pairs.whole(rows[:2], rows[1:3]))
    optimiser = torch.optim.AdamW(net.parameters(), RATE, weight_decay=1e-2)
    plan = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps + 1)
    begun = 0
    if kept.is_file():
        state = torch.load(kept, weights_only=True)
        begun = state["step"]
        net.load_state_dict(state["net"])
        optimiser.load_state_dict(state["optimiser"])
        plan.load_state_dict(state["plan"])
    unit = torch.from_numpy(spread).float()
    for step in range(begun, steps):
        rng = np.random.default_rng(step)
        seen, truth = pairs.drawn(rows, rng)
        with torch.autocast("cpu", torch.bfloat16):
            predicted = net(seen)
        loss = functional.smooth_l1_loss(predicted.float(), truth / unit, beta=0.1)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        plan.step()
        if (step + 1) % 500 == 0 or step + 1 == steps:
            print(f"{step + 1} of {steps}, loss {float(loss.detach()):.4f}", flush=True)
            states = {"net": net, "optimiser": optimiser, "plan": plan}
            torch.save({"step": step + 1, **{k: v.state_dict() for k, v in states.items()}}, kept)
    return net.eval(), spread


def predicted_by(net: nn.Module, spread: Array, pairs: Pairs, first: NDArray[np.int64]) -> Array:
    """Return predicted t and rotation vectors (n, 6) from frames to their successors."""
    found = []
    with torch.no_grad():
        for part in np.array_split(first, max(1, len(first) // BATCH)):
            with torch.autocast("cpu", torch.bfloat16):
                found.append(net(pairs.whole(part, part + 1)).float().numpy())
    return np.concatenate(found).astype(np.float64) * spread


def errors(predicted: Array, truth: Array) -> tuple[Array, Array]:
    """Motions (n, 6) -> rotation and direction errors (n,) in degrees."""
    q, true_q = (geometry.quaternion_exp(each[:, 3:]) for each in (predicted, truth))
    off = geometry.quaternion_multiply(geometry.quaternion_conjugate(true_q), q)
    a, b = (
        each[:, :3] / np.maximum(np.linalg.norm(each[:, :3], axis=1, keepdims=True), 1e-12)
        for each in (predicted, truth)
    )
    sine, cosine = np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)
    angle = np.linalg.norm(geometry.quaternion_log(off), axis=1)
    return np.degrees(angle), np.degrees(np.arctan2(sine, cosine))


def by_front_end(data: PoseDataset, first: NDArray[np.int64]) -> Array:
    """Return the front end's motions (n, 6): t of length 1, or NaN without a direction."""
    camera = data.camera()
    if camera is None:
        raise SystemExit(f"{data.name}: expected a camera with intrinsics")
    found = {}
    for number in np.unique(data.sequence[first]).tolist():
        front = FrontEnd(camera)
        for row in np.flatnonzero(data.sequence == number).tolist():
            found[row] = front.step(data.read_image(row)).motion
    result = np.full((len(first), 6), np.nan)
    for place, row in enumerate(first.tolist()):
        step = found[row + 1]
        if step is None:
            continue
        turn = geometry.quaternion_log(geometry.matrix_to_quaternion(step.R))
        result[place, 3:] = turn
        if step.direction is not None:
            result[place, :3] = step.direction
    return result


def figures(found: Array, truth: Array, known: NDArray[np.bool_]) -> dict[str, float]:
    """Return errors of motions (n, 6); of directions where ``known``, of rotations everywhere."""
    rotation, direction = errors(found, truth)
    rotation, direction = rotation[np.isfinite(rotation)], direction[known]
    return {
        "rotation_median_deg": float(np.median(rotation)),
        "rotation_p90_deg": float(np.quantile(rotation, 0.9)),
        "direction_median_deg": float(np.median(direction)),
        "direction_p90_deg": float(np.quantile(direction, 0.9)),
    }


def main() -> None:
    """Train, compare on the test pairs, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset")
    parser.add_argument("work", type=Path)
    parser.add_argument("--network", choices=("stacked", "correlated"), default="stacked")
    parser.add_argument("--steps", type=int, default=5000)
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    data = open_dataset(given.dataset)
    rows, first = split(data)
    pairs = Pairs(data, given.network, given.work)
    net, spread = train(pairs, rows, given.steps, given.work / f"{data.name}.{given.network}.pt")
    truth = pairs.motions(first, first + 1)
    front = by_front_end(data, first)
    known = np.isfinite(front[:, 0])
    report = {
        "dataset": data.name,
        "training_frames": len(rows),
        "test_pairs": len(first),
        "network": given.network,
        "steps": given.steps,
        "two_frames": figures(predicted_by(net, spread, pairs, first), truth, known),
        "front_end": {
            **figures(front, truth, known),
            "lost": float(np.isnan(front[:, 3]).mean()),
            "without_direction": float(np.mean(~known)),
        },
    }
    for name in ("two_frames", "front_end"):
        print(name, report[name])
    write_result(RESULTS / "two_frames" / f"{data.name}-{given.network}.json", report)


if __name__ == "__main__":
    main()
