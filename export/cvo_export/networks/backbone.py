"""A pretrained image network, cut after a chosen stage, pooled to a small grid.

Takes any timm model by name. Cutting at the stage of stride 16 and keeping a coarse grid (image
position carries information about the camera pose) halves the error of the last layer's global mean
at a quarter of the parameters; stage ``final`` with grid 1x1 selects that global mean.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import timm
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from cvo_edge.errors import UsageError
from cvo_export.vocabulary import Normalisation

FINAL = "final"
TIMM_WEIGHTS = "timm"
NO_WEIGHTS = "none"
_GRID = (3, 4)


@dataclass(frozen=True)
class BackboneConfig:
    """Which network to use, where to cut it, and how to pool its features.

    Attributes
    ----------
    name
        Any timm model name.
    stages
        Strides of the stages whose features are used, e.g. ("16",), or ("final",) for the network's
        last features.
    grid
        Rows and columns that each stage is averaged to.
    normalisation
        ``half``: (pixel - 127.5) / 127.5; ``timm``: mean and deviation from the model's timm
        configuration.
    """

    name: str = "mobilenetv2_100"
    stages: tuple[str, ...] = ("16",)
    grid: tuple[int, int] = (3, 4)
    normalisation: Normalisation = "half"


class Backbone(nn.Module):
    """Images (n, height, width, 3), uint8 RGB -> features (n, ``size``), float32.

    Casting, transposing and normalising are part of the exported graph, where they are exact and
    free.
    """

    def __init__(self, config: BackboneConfig, height: int, width: int) -> None:
        super().__init__()
        self.config = config
        try:
            # nn.Module does not declare the methods that timm's models share.
            self.body: Any = timm.create_model(config.name, pretrained=False, num_classes=0)
        # A name may point to a folder or a server, each with its own errors.
        except (RuntimeError, ValueError, OSError) as error:
            line = next(iter(str(error).splitlines()), type(error).__name__)
            raise UsageError(
                f"backbone: expected a timm model, found {config.name}: {line}"
            ) from None
        if not hasattr(self.body, "prune_intermediate_layers"):
            raise UsageError(f"backbone: {config.name} has no stages; choose another model")
        mean, std = _mean_std(self.body, config.normalisation)
        self.mean, self.std = mean, std
        self.register_buffer("_mean", torch.tensor(mean).view(1, 3, 1, 1) * 255.0)
        self.register_buffer("_std", torch.tensor(std).view(1, 3, 1, 1) * 255.0)
        self._mean: Tensor
        self._std: Tensor
        self._indices = self._cut()
        blank = torch.zeros((1, height, width, 3), dtype=torch.uint8)
        try:
            with torch.no_grad():
                maps = self.eval().maps(blank)
        except (AssertionError, RuntimeError) as error:
            raise UsageError(
                f"backbone: {config.name} does not accept {width}x{height} images: {error}"
            ) from None
        self.map_shapes = [tuple(int(size) for size in m.shape[1:]) for m in maps]
        for number, (_, map_height, map_width) in enumerate(self.map_shapes):
            rows, columns = config.grid
            if map_height < rows or map_width < columns:
                raise UsageError(
                    f"grid: expected at most {map_height}x{map_width} for stage "
                    f"{config.stages[number]} of {config.name}, found {rows}x{columns}"
                )
            self.register_buffer(f"_rows{number}", averaging(map_height, rows))
            self.register_buffer(f"_columns{number}", averaging(map_width, columns).T)
        self.channels = sum(shape[0] for shape in self.map_shapes)
        self.size = self.channels * config.grid[0] * config.grid[1]

    def _cut(self) -> list[int]:
        """Drop the layers after the last stage used; returns timm's indices of the stages."""
        if self.config.stages == (FINAL,):
            return []
        strides = [str(info["reduction"]) for info in self.body.feature_info]
        unknown = [stage for stage in self.config.stages if stage not in strides]
        if unknown or not self.config.stages:
            raise UsageError(
                f"stages: expected some of {', '.join(dict.fromkeys(strides))} for "
                f"{self.config.name}, or {FINAL} alone, found {', '.join(unknown) or 'no stage'}"
            )
        # If several stages have the same stride, use the deepest one.
        last = {stride: index for index, stride in enumerate(strides)}
        indices = sorted(last[stage] for stage in self.config.stages)
        self.body.prune_intermediate_layers(indices=indices, prune_head=True)
        return indices

    def maps(self, image: Tensor) -> list[Tensor]:
        """Feature maps (n, channels, rows, columns) of the stages used."""
        x = (image.permute(0, 3, 1, 2).to(self._mean.dtype) - self._mean) / self._std
        if not self._indices:
            return [self.body.forward_features(x)]
        found: list[Tensor] = self.body.forward_intermediates(
            x, indices=self._indices, intermediates_only=True, stop_early=True
        )
        return found

    def forward(self, image: Tensor) -> Tensor:
        """Images (n, height, width, 3), uint8 -> features (n, size)."""
        pooled = []
        for number, feature_map in enumerate(self.maps(image)):
            if self.config.grid == (1, 1):
                # One matrix product per channel takes ten times as long.
                pooled.append(feature_map.mean(dim=(2, 3)))
                continue
            rows = getattr(self, f"_rows{number}")
            columns = getattr(self, f"_columns{number}")
            # One product for all channels takes half the time of two for each of them.
            pooled.append((feature_map.flatten(2) @ torch.kron(rows, columns.T).T).flatten(1))
        return torch.cat(pooled, dim=1)

    def cells(self, features: Tensor) -> Tensor:
        """Features (n, size) -> the same numbers by cell of the grid, (n, cells, channels)."""
        count = self.config.grid[0] * self.config.grid[1]
        sizes = [shape[0] * count for shape in self.map_shapes]
        parts = [part.reshape(len(part), -1, count) for part in torch.split(features, sizes, dim=1)]
        return torch.cat(parts, dim=1).transpose(1, 2)


class Pooled(nn.Module):
    """A map (n, channels, rows, columns) -> its means over a 3x4 grid, (n, size)."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        super().__init__()
        channels, rows, columns = shape
        self.register_buffer("rows", averaging(rows, min(_GRID[0], rows)))
        self.register_buffer("columns", averaging(columns, min(_GRID[1], columns)).T)
        self.rows: Tensor
        self.columns: Tensor
        self.size = channels * self.rows.shape[0] * self.columns.shape[1]

    def forward(self, deep: Tensor) -> Tensor:
        """Shape (n, channels, rows, columns) -> (n, size)."""
        return (self.rows @ deep @ self.columns).flatten(1)

    def cells(self, deep: Tensor) -> Tensor:
        """Shape (n, channels, rows, columns) -> (n, cells, channels)."""
        return (self.rows @ deep @ self.columns).flatten(2).transpose(1, 2)


def load_weights(backbone: Backbone, weights: str) -> str | None:
    """Fill the backbone from a safetensors file, ``timm`` (downloads), or ``none`` (random).

    Returns the sha256 of the loaded weights, None for random weights. Keys are those of the timm
    model without classifier; weights of layers after the cut are ignored, missing ones rejected.

    Raises UsageError.
    """
    if weights == NO_WEIGHTS:
        return None
    if weights == TIMM_WEIGHTS:
        try:
            whole = timm.create_model(backbone.config.name, pretrained=True, num_classes=0)
        except (RuntimeError, OSError) as error:
            line = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UsageError(
                f"weights: cannot download those of {backbone.config.name}: {line}; "
                "give --weights FILE"
            ) from None
        state = whole.state_dict()
        digest = hashlib.sha256()
        for name in sorted(state):
            digest.update(name.encode() + state[name].cpu().numpy().tobytes())
        sha256 = digest.hexdigest()
    else:
        path = Path(weights)
        if not path.is_file():
            raise UsageError(f"weights: expected a safetensors file, found no file at {path}")
        try:
            state = load_file(path)
        except Exception as error:  # noqa: BLE001 - safetensors raises its own untyped errors
            raise UsageError(f"weights: {path}: not a valid safetensors file: {error}") from None
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    wanted = backbone.body.state_dict()
    missing = [name for name in wanted if name not in state]
    wrong = [n for n in wanted if n in state and state[n].shape != wanted[n].shape]
    if missing or wrong:
        raise UsageError(
            f"weights: expected those of {backbone.config.name}, found "
            f"{len(missing)} tensors missing and {len(wrong)} of another shape, "
            f"the first is {(missing + wrong)[0]}"
        )
    backbone.body.load_state_dict({name: state[name] for name in wanted})
    return sha256


def _mean_std(body: nn.Module, normalisation: Normalisation) -> tuple[list[float], list[float]]:
    if normalisation == "half":
        return [0.5] * 3, [0.5] * 3
    config = cast("Mapping[str, Sequence[float]]", body.pretrained_cfg)
    return list(config["mean"]), list(config["std"])


def averaging(size: int, cells: int) -> Tensor:
    """Matrix (cells, size) of the means over ``cells`` equal spans; spans may share a pixel.

    A product with a constant matrix exports to any runtime for all sizes; adaptive pooling does so
    only for sizes that ``cells`` divides.
    """
    edges = np.linspace(0.0, size, cells + 1)
    pixel = np.arange(size)
    overlap = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    matrix = np.clip(overlap, 0.0, None)
    return torch.tensor(matrix / matrix.sum(axis=1, keepdims=True), dtype=torch.float32)
