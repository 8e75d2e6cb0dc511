"""Regions of known shapes: ours, the paper's latent grid, and the box of one CQR a dimension.

    python bench/shapes.py OUT_FOLDER [--json FILE] [--seeds 3]

Responses in two and three dimensions whose shape is known and changes with x: a ring, a banana, two
pieces. Each: 4000 samples to train on, 500 of val, 1000 to calibrate, 2000 to test, 90 %. The box
is what one would build without a region: a pinball network for the outer quantiles of each
dimension, conformalised jointly by the largest score. Writes a picture of each shape (all regions
at one x, with samples) and prints coverage, its 99 % band and mean area.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import matplotlib as mpl
import numpy as np
import torch
from numpy.typing import NDArray
from provenance import write_result
from torch import Tensor, nn

from cvo_edge.conformal import conformal_quantile
from cvo_export.bundles.figures import coverage_band
from cvo_export.bundles.volume import union_log_volume
from cvo_export.networks.directional import (
    Choice,
    RegionConfig,
    RegionNetwork,
    best_choice,
    scaled_distances,
)
from cvo_export.networks.losses import pinball_loss

mpl.use("agg")
from matplotlib import pyplot as plt

Array = NDArray[np.float64]
M = TypeVar("M", bound=nn.Module)

CONFIDENCE = 0.9
ROLES = {"train": 4000, "val": 500, "cal": 1000, "test": 2000}
STEPS, BATCH, RATE = 6000, 256, 1e-3


def ring(x: Array, generator: np.random.Generator, d: int) -> Array:
    """Points about a circle of radius 1 + x, in three dimensions tilted with x."""
    angle = generator.uniform(0.0, 2.0 * np.pi, len(x))
    circle = (1.0 + x)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if d == 3:
        circle = np.column_stack([circle, x * circle[:, 0]])
    return np.asarray(circle + 0.1 * generator.standard_normal(circle.shape))


def banana(x: Array, generator: np.random.Generator, d: int) -> Array:
    """A parabola whose bend grows with x; in three dimensions a twisted one."""
    along = generator.standard_normal(len(x))
    curve = [along, (0.5 + x) * along**2]
    if d == 3:
        curve.append(x * along**3 / 3.0)
    return np.stack(curve, axis=1) + 0.1 * generator.standard_normal((len(x), d))


def bimodal(x: Array, generator: np.random.Generator, d: int) -> Array:
    """Two pieces, further apart the larger x is."""
    side = generator.choice([-1.0, 1.0], len(x))
    centre = (side * (0.5 + 2.0 * x))[:, None] * np.ones(d)
    return centre + 0.2 * generator.standard_normal((len(x), d))


SHAPES = {"ring": ring, "banana": banana, "bimodal": bimodal}


def trained(module: M, loss: Callable[[M, Tensor, Tensor], Tensor], x: Array, y: Array) -> M:
    """Adam with a cosine, on x (n, 1) and y (n, d)."""
    inputs, truths = torch.tensor(x).float(), torch.tensor(y).float()
    optimiser = torch.optim.Adam(module.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    module.train()
    for _ in range(STEPS):
        rows = torch.randint(len(x), (BATCH,))
        optimiser.zero_grad()
        loss(module, inputs[rows], truths[rows]).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    return module.eval()


class Regions:
    """Our calibrated regions, or with ``grid`` the paper's: points of a latent grid."""

    def __init__(self, network: RegionNetwork, choice: Choice, *, grid: bool) -> None:
        self.network, self.choice, self.grid = network, choice, grid
        self.radius = math.inf

    @torch.no_grad()
    def points(self, x: Array) -> tuple[Array, Array, list[Array]]:
        """Conditions (n, 1) -> codebook (n, J, d) before the scale, scale (n, d, d), its points."""
        c = torch.tensor(x).float()
        scale = self.network.scale(c).double().numpy()
        if self.grid:
            grid, inside = self.network.grid_codebook(c)
            codebook = grid.double().numpy()
            used = [p[use] for p, use in zip(codebook, inside.numpy(), strict=True)]
            return codebook, scale, used
        codebook = self.network.codebook(c, torch.tensor(self.choice.kappa)).double().numpy()
        codebook = codebook[:, self.choice.points]
        return codebook, scale, list(codebook)

    def scores(self, x: Array, y: Array) -> Array:
        """Scaled distances (n,) of y (n, d) at x (n, 1) or at one x (1, 1)."""
        at_one = self.points(x)[:2] if len(x) == 1 else None
        # In parts, as a grid has 4096 points.
        parts = np.array_split(np.arange(len(y)), math.ceil(len(y) / 200))
        return np.concatenate(
            [scaled_distances(*(at_one or self.points(x[rows])[:2]), y[rows]) for rows in parts]
        )

    def areas(self, x: Array) -> Array:
        """Area or volume of the region at each condition (n, 1)."""
        _, scale, used = self.points(x)
        areas = [
            math.exp(union_log_volume(p, self.radius, seed)) * np.diag(b).prod()
            for seed, (p, b) in enumerate(zip(used, scale, strict=True))
        ]
        return np.array(areas)


class Boxes:
    """The calibrated box: one CQR a dimension, jointly by the largest score."""

    def __init__(self, network: nn.Module) -> None:
        self.network = network
        self.radius = math.inf

    @torch.no_grad()
    def bounds(self, x: Array) -> tuple[Array, Array]:
        """Conditions (n, 1) -> raw lower and upper (n, d)."""
        found = self.network(torch.tensor(x).float()).double().numpy()
        lower, upper = np.split(found, 2, axis=1)
        return np.minimum(lower, upper), np.maximum(lower, upper)

    def scores(self, x: Array, y: Array) -> Array:
        """Largest CQR score over the dimensions, (n,)."""
        lower, upper = self.bounds(x)
        return np.asarray(np.maximum(lower - y, y - upper).max(axis=1))

    def areas(self, x: Array) -> Array:
        """Area or volume of the box at each condition (n, 1)."""
        lower, upper = self.bounds(x)
        return np.asarray(np.maximum(upper - lower + 2.0 * self.radius, 0.0).prod(axis=1))


def learned(x: Array, y: Array, val: tuple[Array, Array]) -> dict[str, Regions | Boxes]:
    """Train the region networks and the boxes' on x (n, 1), y (n, d)."""
    d = y.shape[1]
    network = trained(RegionNetwork(RegionConfig(d, 1)), lambda net, c, t: net.loss(c, t), x, y)
    choice = best_choice(
        network, (torch.tensor(x).float(), y), (torch.tensor(val[0]).float(), val[1])
    )

    def outer_quantiles(box: nn.Module, c: Tensor, t: Tensor) -> Tensor:
        lower, upper = box(c).chunk(2, dim=1)
        tail = (1.0 - CONFIDENCE) / (2 * d)
        return pinball_loss(lower, t, tail) + pinball_loss(upper, t, 1.0 - tail)

    box = nn.Sequential(
        *(nn.Linear(1, 64), nn.LeakyReLU(0.2), nn.Linear(64, 64), nn.LeakyReLU(0.2)),
        nn.Linear(64, 2 * d),
    )
    return {
        "region": Regions(network, choice, grid=False),
        "grid": Regions(network, choice, grid=True),
        "box": Boxes(trained(box, outer_quantiles, x, y)),
    }


def study(name: str, d: int, seed: int, picture: Path | None) -> dict[str, Any]:
    """Train, calibrate and test all three on one shape; returns coverage and mean area of each."""
    generator = np.random.default_rng((seed, d))
    torch.manual_seed(seed)
    data = {}
    for role, count in ROLES.items():
        x = generator.uniform(0.0, 1.0, count)
        data[role] = (x[:, None], SHAPES[name](x, generator, d))
    sets = learned(*data["train"], data["val"])
    found: dict[str, Any] = {"shape": name, "dimensions": d, "seed": seed}
    for kind, regions in sets.items():
        regions.radius = conformal_quantile(regions.scores(*data["cal"]), CONFIDENCE)
        x, y = data["test"]
        found[kind] = {
            "coverage": float((regions.scores(x, y) <= regions.radius).mean()),
            "mean_area": float(regions.areas(x[:200]).mean()),
        }
    choice = cast("Regions", sets["region"]).choice
    found["kappa"], found["points"] = choice.kappa, len(choice.points)
    found["area_ratio"] = found["box"]["mean_area"] / found["region"]["mean_area"]
    if picture is not None:
        draw(name, d, sets, picture)
    return found


def draw(name: str, d: int, sets: dict[str, Regions | Boxes], path: Path) -> None:
    """Draw the first two dimensions at three x: our region, the grid's, the box, and samples.

    Of a region in three dimensions the slice through the third dimension's median is drawn.
    """
    generator = np.random.default_rng(1)
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.5), layout="constrained")
    for axis, at in zip(axes, (0.1, 0.5, 0.9), strict=True):
        samples = SHAPES[name](np.full(20_000, at), generator, d)
        span = np.stack([samples[:, :2].min(axis=0), samples[:, :2].max(axis=0)]) * 1.25
        a, b = (np.linspace(span[0, k], span[1, k], 121) for k in range(2))
        plane = np.stack(np.meshgrid(a, b), axis=-1).reshape(-1, 2)
        if d == 3:
            third = float(np.median(samples[:, 2]))
            samples = samples[np.abs(samples[:, 2] - third) < 0.1]
            plane = np.column_stack([plane, np.full(len(plane), third)])
        for kind, colour in (("box", "tab:orange"), ("grid", "tab:green"), ("region", "tab:blue")):
            scores = sets[kind].scores(np.full((1, 1), at), plane)
            inside = (scores <= sets[kind].radius).reshape(len(b), len(a)).astype(float)
            if kind == "region":
                axis.contourf(a, b, inside, levels=(0.5, 1.5), colors=[colour], alpha=0.25)
            axis.contour(a, b, inside, levels=(0.5,), colors=[colour])
        axis.plot(*samples[:600, :2].T, "k.", markersize=2)
        axis.set(title=f"x = {at}", xlabel="y1", ylabel="y2")
    figure.suptitle(
        f"{name}, {d} dimensions, 90 %: region (blue), latent grid (green), box (orange)"
        + ("; slice at the median of y3" if d == 3 else "")
    )
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    """Print one line per shape; write pictures and, where asked, all figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    band = coverage_band(ROLES["cal"], ROLES["test"], CONFIDENCE)
    print(f"99 % band of coverage: {band}")
    results = []
    for d in (2, 3):
        for name in SHAPES:
            for seed in range(arguments.seeds):
                picture = None if seed else arguments.out / f"shape-{name}-{d}d.png"
                found = study(name, d, seed, picture)
                results.append(found)
                cells = "  ".join(
                    f"{kind} {found[kind]['coverage']:.3f} {found[kind]['mean_area']:.3f}"
                    for kind in ("region", "grid", "box")
                )
                print(
                    f"{name} {d}-D seed {seed}: coverage, mean area: {cells}; box / region "
                    f"{found['area_ratio']:.2f}; kappa {found['kappa']:g}, "
                    f"{found['points']} points",
                    flush=True,
                )
    if arguments.json:
        report = {"confidence": CONFIDENCE, "coverage_band": band, "results": results}
        write_result(arguments.json, report)


if __name__ == "__main__":
    main()
