"""Scene coordinate regression: cells of the image -> points of the world, and their scales.

Each cell of stride 16 sees the stem's map and the stages after it and predicts the world point that
it shows, as a homogeneous vector (Brachmann et al. 2023, ACE, section 3.3), with the scale of its
reprojection error. Training needs poses and intrinsics, no depth: the loss is the negative log
likelihood of the reprojection error under a bivariate Student's t distribution, and triangulated
points (``cvo_export.data.sparse_map``) give a prior of the depth. ``cvo_edge.pose_solver`` uses the
same likelihood to find the pose.

First the cells' head learns alone, from features of the pretrained network; then it learns together
with the stages after the stem.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta, Struct
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import softplus

from cvo_edge import geometry
from cvo_edge.conformal import conformal_quantile, interval_score
from cvo_edge.heads import Candidate
from cvo_edge.heads.scr import ScrParameters
from cvo_edge.pose import Chart
from cvo_edge.pose_solver import PoseSolver
from cvo_edge.reprojection import NU
from cvo_export.bundles.draft import six
from cvo_export.data.augment import AugmentConfig
from cvo_export.data.place import (
    COLUMNS,
    DEPTH_WEIGHT,
    LOG_DEPTH,
    POSITION,
    RAY,
    ROTATION,
    SHOWN,
)
from cvo_export.networks.heads.base import (
    Examples,
    ExportedHead,
    Learner,
    Lessons,
    Method,
    Schedule,
    Setting,
    Standardise,
)
from cvo_export.networks.stem import CELL_STRIDE, STEM_STRIDE, Upper

Array = NDArray[np.float64]

# Log scales in pixels: where training starts, and their range.
_FIRST_LOG_SCALE, _LOG_SCALES = 1.5, (-2.5, 5.0)
# Range of the homogeneous coordinate, and its value at 0: softplus(0.5413) = 1.
_HOMOGENEOUS, _ONE = (0.02, 20.0), 0.5413
# A point nearer than this share of the typical depth, or further off than this share of the focal
# length, is pulled to the prior instead: there the reprojection error has no useful gradient.
_NEAR, _FAR = 0.05, 1.0
# Poses that the solver starts from; the deviation that damps its steps, in deviations of the
# training poses; least deviation of the scores, in the same unit.
_STARTS, _DAMPING, _FLOOR = 16, 3.0, 0.002


class ScrConfig(Struct, frozen=True, tag="scr", tag_field="method", forbid_unknown_fields=True):
    """Options of the network and its training."""

    width: Annotated[
        int, Meta(ge=8, le=4096, description="Width of the layers that read a cell.")
    ] = 256
    blocks: Annotated[int, Meta(ge=0, le=16, description="Residual blocks of two layers.")] = 2
    cell_steps: Annotated[
        int, Meta(ge=0, description="Steps that train the cells' head alone, 4096 cells each.")
    ] = 4000
    upper_rate: Annotated[
        float,
        Meta(ge=0, description="Learning rate of the stages after the stem, as a share."),
    ] = 0.6


class CellNetwork(nn.Module):
    """Features of cells (..., size) -> world points (..., 3), m, and log scales (...), log px."""

    def __init__(self, size: int, config: ScrConfig, centre: Array, spread: float) -> None:
        super().__init__()
        self.standardise = Standardise(size, 0.0)
        self.first = nn.Linear(size, config.width)
        self.blocks = nn.ModuleList(
            _Residual(nn.Linear(config.width, config.width), nn.Linear(config.width, config.width))
            for _ in range(config.blocks)
        )
        self.last = nn.Linear(config.width, 5)
        # Training starts from the middle of the known points.
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.register_buffer("centre", torch.tensor(centre, dtype=torch.float32))
        self.register_buffer("spread", torch.tensor(spread, dtype=torch.float32))
        self.centre: Tensor
        self.spread: Tensor

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return points and log scales."""
        # Matrix products in bfloat16 take a third of the time in training; the last one stays in
        # float32, as its outputs are metres.
        with torch.autocast("cpu", torch.bfloat16, enabled=self.training):
            hidden = self.first(self.standardise(features))
            for block in self.blocks:
                hidden = block(hidden)
        return self.read(hidden.float())

    def read(self, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Values of the last block (..., width) -> points and log scales."""
        output = self.last(torch.relu(hidden))
        homogeneous = softplus(output[..., 3:4] + _ONE).clamp(*_HOMOGENEOUS)
        points = self.centre + self.spread * output[..., :3] / homogeneous
        return points, (output[..., 4] + _FIRST_LOG_SCALE).clamp(*_LOG_SCALES)


class CellMaps(nn.Module):
    """A ``CellNetwork`` on maps: the stem's and the last stage's -> (n, cells, 3) and (n, cells).

    Its layers are the same numbers as convolutions. They need no rearranged maps, and can be
    quantised like a backbone's; the last layer, whose outputs are metres, stays as it is.
    """

    def __init__(self, network: CellNetwork, channels: int) -> None:
        super().__init__()
        scale = 1.0 / network.standardise.std
        weight = network.first.weight * scale
        bias = network.first.bias - weight @ network.standardise.mean
        # The features of a cell begin with a block of the stem's map, channel by channel.
        side = CELL_STRIDE // STEM_STRIDE
        fine, deep = weight[:, : channels * side**2], weight[:, channels * side**2 :]
        self.fine = _convolution(fine.reshape(-1, channels, side, side), None)
        self.deep = _convolution(deep[..., None, None], bias)
        self.blocks = nn.ModuleList(
            _Residual(_pointwise(block.inner), _pointwise(block.outer))
            for block in network.blocks
            if isinstance(block, _Residual)
        )
        self.read = network.read

    def forward(self, stem_map: Tensor, deep: Tensor) -> tuple[Tensor, Tensor]:
        """Return points and log scales."""
        hidden = self.deep(deep) + self.fine(stem_map)
        for block in self.blocks:
            hidden = block(hidden)
        found: tuple[Tensor, Tensor] = self.read(hidden.flatten(2).transpose(1, 2))
        return found


def _convolution(weight: Tensor, bias: Tensor | None) -> nn.Conv2d:
    """Return the convolution with these weights, whose kernels do not overlap."""
    outputs, inputs, side, _ = weight.shape
    found = nn.Conv2d(inputs, outputs, side, stride=side, bias=bias is not None)
    with torch.no_grad():
        found.weight.copy_(weight)
        if found.bias is not None and bias is not None:
            found.bias.copy_(bias)
    return found


def _pointwise(layer: nn.Linear | nn.Conv2d) -> nn.Conv2d:
    """Return a linear layer as a convolution."""
    return _convolution(layer.weight[..., None, None], layer.bias)


class _Residual(nn.Module):
    def __init__(self, inner: nn.Linear | nn.Conv2d, outer: nn.Linear | nn.Conv2d) -> None:
        super().__init__()
        self.inner, self.outer = inner, outer

    def forward(self, x: Tensor) -> Tensor:
        found: Tensor = x + self.outer(torch.relu(self.inner(torch.relu(x))))
        return found


def cell_loss(
    points: Tensor, log_scale: Tensor, y: Tensor, focal_px: float, typical_depth: float
) -> Tensor:
    """Points (m, 3), log scales (m,) and targets (m, 17) -> scalar, the mean over shown cells.

    Student's t (nu = 3) negative log likelihood of the reprojection error in pixels, without its
    constant, plus |log depth - prior| with the prior's weight.
    """
    ray, shown = y[:, RAY], y[:, SHOWN]
    in_camera = torch.einsum("nij,ni->nj", y[:, ROTATION].view(-1, 3, 3), points - y[:, POSITION])
    near = _NEAR * typical_depth
    depth = in_camera[:, 2].clamp(min=near)
    squared = (focal_px * (in_camera[:, :2] / depth[:, None] - ray)).square().sum(dim=1)
    usable = (in_camera[:, 2] > near) & (squared < (_FAR * focal_px) ** 2)
    likelihood = 2.0 * log_scale + 0.5 * (NU + 2.0) * torch.log1p(
        torch.where(usable, squared, 0.0) * torch.exp(-2.0 * log_scale) / NU
    )
    prior = y[:, DEPTH_WEIGHT] * (torch.log(depth) - y[:, LOG_DEPTH]).abs()
    target = torch.cat([ray, torch.ones_like(ray[:, :1])], 1) * torch.exp(y[:, LOG_DEPTH, None])
    distance = (in_camera - target).norm(dim=1) / typical_depth
    # As large as the loss of a usable cell that is vague; it pulls the point to where it is seen.
    lost = 2.0 * np.log(focal_px) + 4.0 * distance
    value = shown * torch.where(usable, likelihood + prior, lost)
    return value.sum() / shown.sum().clamp(min=1.0)


class _Judge:
    """Solves the poses of val frames: the val score of a network."""

    def __init__(self, solver: PoseSolver, focal_px: float, deviation: Array) -> None:
        self._solver, self._focal_px, self._deviation = solver, focal_px, deviation

    def score(self, points: Tensor, log_scale: Tensor, poses: Array) -> float:
        """Points (n, cells, 3), log scales (n, cells), poses (n, 7) -> mean interval score.

        At 90 %, in standard deviations of the poses, with thresholds from the same frames.
        """
        errors, deviations = [], []
        scale = np.exp(log_scale.double().numpy()) / self._focal_px
        chart = Chart("tangent_predicted")
        for x, s, pose in zip(points.double().numpy(), scale, poses, strict=True):
            found = self._solver.solve(x, s)
            predicted = chart.coordinates(found.pose, found.pose)
            errors.append(chart.coordinates(pose, found.pose) - predicted)
            deviations.append(np.sqrt(np.diag(np.linalg.inv(found.information))))
        error, deviation = np.abs(errors), np.array(deviations)
        q_hat = [conformal_quantile(column, 0.9) for column in (error / deviation).T]
        half = np.array(q_hat) * deviation
        value = interval_score(2.0 * half, np.maximum(error - half, 0.0), 0.1)
        return float((value / self._deviation).mean())


class _CellLearner(Learner):
    """The cells' head alone, on cells (m, size) drawn from all frames."""

    def __init__(self, network: CellNetwork, judge: _Judge, focal_px: float, depth: float) -> None:
        super().__init__()
        self.network, self.standardise = network, network.standardise
        self._judge, self._focal_px, self._depth = judge, focal_px, depth

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Features (m, size), targets (m, 17) -> scalar."""
        points, log_scale = self.network(features)
        return cell_loss(points, log_scale, y, self._focal_px, self._depth)

    def val_score(self, features: Tensor, y: Array) -> float:
        """Features of val frames (n, cells, size), poses (n, 7) -> see ``Learner``."""
        points, log_scale = self.network(features)
        return self._judge.score(points, log_scale, y)


class _FrameLearner(_CellLearner):
    """The stages after the stem and the cells' head, on maps of whole frames."""

    def __init__(
        self,
        upper: Upper,
        network: CellNetwork,
        judge: _Judge,
        focal_px: float,
        depth: float,
        upper_rate: float,
    ) -> None:
        super().__init__(network, judge, focal_px, depth)
        # Convolutions take two thirds of the time if the channels are innermost.
        self.upper = upper.to(memory_format=torch.channels_last)
        self._upper_rate = upper_rate

    def fit_inputs(self, inputs: NDArray[Any]) -> None:
        """Keep the standardisation of the cells' head."""

    def groups(self, rate: float) -> list[dict[str, Any]]:
        """As ``Learner``; the pretrained stages learn more slowly."""
        return [
            {"params": list(self.network.parameters()), "peak": rate},
            {"params": list(self.upper.parameters()), "peak": self._upper_rate * rate},
        ]

    def loss(self, features: Tensor, y: Tensor, warm_up: bool) -> Tensor:
        """Maps (n, channels, rows, columns), targets (n, cells * 17) -> scalar."""
        features = features.contiguous(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16):
            cells = self.upper(features)
        points, log_scale = self.network(cells)
        y = y.view(-1, COLUMNS)
        return cell_loss(points.flatten(0, 1), log_scale.flatten(), y, self._focal_px, self._depth)

    def val_score(self, features: Tensor, y: Array) -> float:
        """Maps of val frames, poses (n, 7) -> see ``Learner``."""
        found = [self.network(self.upper(part)) for part in torch.split(features, 32)]
        points, log_scale = (torch.cat(values) for values in zip(*found, strict=True))
        return self._judge.score(points, log_scale, y)


class ScrHead(ExportedHead):
    """Map of the stem -> coordinates (n, cells, 3), m, and log_scale_px (n, cells)."""

    output_names = ("coordinates", "log_scale_px")
    point_outputs = ("coordinates",)
    runtime_method = "scr"
    rotation = "tangent_predicted"

    def __init__(self, upper: Upper, network: CellNetwork, starts: Array, deviation: Array) -> None:
        super().__init__()
        self.upper, self.network = upper, network
        self.register_buffer("starts", torch.tensor(starts, dtype=torch.float64))
        self.register_buffer("deviation", torch.tensor(deviation, dtype=torch.float64))
        self.starts: Tensor
        self.deviation: Tensor

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return coordinates and the logarithms of their scales."""
        points, log_scale = self.network(self.upper(features))
        return points, log_scale

    def deployed(self) -> nn.Module:
        """As ``ExportedHead``."""
        return DeployedScr(self)

    def candidates(self) -> tuple[Candidate, ...]:
        """Return the only score."""
        deviation = self.deviation.numpy()
        starts = [tuple(pose) for pose in self.starts.tolist()]
        parameters = ScrParameters(
            grid=self.upper.grid,
            starts=tuple(starts),
            damping=six(_DAMPING * deviation),
            deviation_floor=six(_FLOOR * deviation),
            limits=None,
            camera_limits=None,
        )
        return (Candidate("normalised", parameters),)


class DeployedScr(nn.Module):
    """``ScrHead`` for the exported graph."""

    def __init__(self, head: ScrHead) -> None:
        super().__init__()
        self.upper = head.upper
        self.network = CellMaps(head.network, head.upper.stem_channels)

    def forward(self, stem_map: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return coordinates, the logarithms of their scales and the map of the last stage."""
        deep = self.upper.deep(stem_map)
        points, log_scale = self.network(stem_map, deep)
        return points, log_scale, deep


def spread_poses(poses: Array, count: int) -> Array:
    """Return ``count`` of the poses (n, 7) that cover all of them, (count, 7).

    The first is the nearest to the mean; each further one is farthest from those chosen
    (Gonzalez 1985), in deviations of the position and in radians.
    """
    t = poses[:, :3] / max(float(poses[:, :3].std(axis=0).mean()), 1e-9)
    R = geometry.quaternion_to_matrix(poses[:, 3:])

    def distance(position: Array, rotation: Array) -> Array:
        cosine = (np.einsum("nij,ij->n", R, rotation) - 1.0) / 2.0
        turn = np.arccos(np.clip(cosine, -1.0, 1.0))
        return np.asarray(np.linalg.norm(t - position, axis=1) + turn)

    middle = geometry.quaternion_to_matrix(geometry.mean_rotation(poses[:, 3:]))
    chosen = [int(distance(t.mean(axis=0), middle).argmin())]
    nearest = distance(t[chosen[0]], R[chosen[0]])
    while len(chosen) < min(count, len(poses)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, distance(t[chosen[-1]], R[chosen[-1]]))
    return poses[chosen]


def trained_scr(lessons: Lessons, config: ScrConfig) -> ScrHead:
    """Train the cells' network alone, then with the stages after the stem."""
    upper = lessons.setting.cells()
    place = lessons.place()
    maps, poses = lessons.features()
    val_maps, val_poses = lessons.val()
    targets = place.targets(poses)
    originals = poses[0]
    # A place that was only seen without moving along an axis still has a scale.
    deviation = np.maximum(lessons.setting.target.deviation, 1e-3)
    starts = spread_poses(originals, _STARTS)
    judge = _Judge(PoseSolver(place.rays, starts, _DAMPING * deviation), place.focal_px, deviation)
    points = place.map.points
    spread = float(points.std(axis=0).mean())
    problem = judge, place.focal_px, place.typical_depth
    network: CellNetwork | None = None

    def fresh() -> CellNetwork:
        return CellNetwork(upper.size, config, np.median(points, axis=0), spread)

    if config.cell_steps:
        with torch.no_grad():
            cells = np.empty((*targets.shape[:3], upper.size), np.float16)
            for number, copy in enumerate(maps):
                cells[number] = _cells(upper, copy)
            val_cells = torch.from_numpy(_cells(upper, val_maps.numpy())).float()
        copies = len(maps)
        network = lessons.learn(
            "scr-cells",
            lambda: _CellLearner(fresh(), *problem),
            examples=Examples(
                cells.reshape(copies, -1, upper.size),
                targets.reshape(copies, -1, COLUMNS),
                val_cells,
                val_poses,
            ),
            schedule=Schedule(config.cell_steps, 4096, 3e-3),
            candidate=False,
        ).network
    trained = lessons.learn(
        "scr",
        lambda: _FrameLearner(upper, network or fresh(), *problem, config.upper_rate),
        examples=Examples(
            maps, targets.reshape(len(maps), len(originals), -1), val_maps, val_poses
        ),
        schedule=Schedule(None, 16, 1e-3, threads=None),
    )
    return ScrHead(trained.upper, trained.network, starts, deviation)


def _cells(upper: Upper, maps: NDArray[Any]) -> NDArray[np.float16]:
    """Maps (n, channels, rows, columns) -> features of their cells (n, cells, size)."""
    found = [upper(part.float()).half() for part in torch.split(torch.from_numpy(maps), 64)]
    return torch.cat(found).numpy()


def restored_scr(setting: Setting, config: ScrConfig, state: Mapping[str, Tensor]) -> ScrHead:
    """Rebuild a head from its state."""
    network = CellNetwork(setting.cells().size, config, np.zeros(3), 1.0)
    starts, deviation = state["starts"].numpy(), state["deviation"].numpy()
    head = ScrHead(setting.cells(), network, starts, deviation)
    head.load_state_dict(state)
    return head


METHOD = Method(
    ScrConfig,
    trained_scr,
    restored_scr,
    cells=True,
    size=(256, 192),
    copies=16,
    steps=4000,
    augment=AugmentConfig(rotation_deg=8.0, motion_blur=0.3, zoom=0.15),
    turns=True,
)
