"""A backbone in two parts: a frozen stem, and the stages after it, which a method trains.

The first stages of a pretrained network know edges and textures of any image; running them once
per augmented copy and caching their map makes training the later stages several times as fast.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import torch
from torch import Tensor, nn

from cvo_edge.errors import UsageError
from cvo_export.networks.backbone import Backbone, BackboneConfig, load_weights

# Strides of the stem's map and of the cells.
STEM_STRIDE, CELL_STRIDE = 8, 16


class Stem(nn.Module):
    """Images (n, height, width, 3), uint8 RGB -> map (n, channels, height / 8, width / 8).

    Attributes
    ----------
    shape
        Channels, rows and columns of the map.
    size
        Number of channels.
    mean, std
        Pixel normalisation per channel, for values from 0 to 1.
    """

    def __init__(self, backbone: Backbone, layers: nn.Sequential) -> None:
        super().__init__()
        self.config = backbone.config
        self.mean, self.std = backbone.mean, backbone.std
        self.layers = layers
        self.register_buffer("_mean", backbone.get_buffer("_mean"))
        self.register_buffer("_std", backbone.get_buffer("_std"))
        self._mean: Tensor
        self._std: Tensor
        self.shape: tuple[int, int, int] = (0, 0, 0)

    @property
    def size(self) -> int:
        """Number of channels of the map."""
        return self.shape[0]

    def forward(self, image: Tensor) -> Tensor:
        """Images (n, height, width, 3) -> map (n, channels, rows, columns)."""
        x = (image.permute(0, 3, 1, 2).to(self._mean.dtype) - self._mean) / self._std
        found: Tensor = self.layers(x)
        return found


class Upper(nn.Module):
    """Map of the stem (n, channels, rows, columns) -> features of each cell (n, cells, size).

    A cell is a 2x2 block of the stem's map: its features are the block and the output of the stages
    after the stem. Batch normalisations keep their statistics: a batch of 16 images is too small.

    Attributes
    ----------
    size, stem_channels
        Features per cell, and channels of the stem's map.
    shape
        Channels, rows and columns of the last map.
    """

    def __init__(self, layers: nn.Sequential) -> None:
        super().__init__()
        self.layers = layers
        self.size = self.stem_channels = 0
        self.shape = (0, 0, 0)

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        return self.shape[1], self.shape[2]

    def train(self, mode: bool = True) -> Upper:  # noqa: ARG002 - as ``nn.Module``
        """Stay in evaluation mode."""
        return super().train(False)

    def deep(self, stem_map: Tensor) -> Tensor:
        """Return the map of the last stage, (n, channels, rows, columns)."""
        found: Tensor = self.layers(stem_map)
        return found

    def forward(self, stem_map: Tensor) -> Tensor:
        """Map of the stem -> features (n, cells, size)."""
        return self.cells(stem_map, self.deep(stem_map))

    def cells(self, stem_map: Tensor, deep: Tensor) -> Tensor:
        """Maps of the stem and of the last stage -> features (n, cells, size)."""
        fine = nn.functional.pixel_unshuffle(stem_map, CELL_STRIDE // STEM_STRIDE)
        return torch.cat([fine, deep.to(fine.dtype)], dim=1).flatten(2).transpose(1, 2)


def split_backbone(
    config: BackboneConfig, height: int, width: int, weights: str
) -> tuple[Stem, Upper, str | None]:
    """Load a backbone and cut it at stride 8; also return the sha256 of the loaded weights.

    Raises UsageError for images that are not a whole number of cells, weights that do not fit, or a
    network whose stages cannot run one after the other.
    """
    if height % CELL_STRIDE or width % CELL_STRIDE:
        raise UsageError(
            f"size: expected multiples of {CELL_STRIDE} for a method with cells, found "
            f"{width}x{height}"
        )
    config = replace(config, stages=(str(STEM_STRIDE), str(CELL_STRIDE)), grid=(1, 1))
    backbone = Backbone(config, height, width)
    sha256 = load_weights(backbone, weights)
    lower, upper = _parts(backbone)
    stem = Stem(backbone, deepcopy(lower))
    cells = Upper(deepcopy(upper))
    blank = torch.arange(height * width * 3, dtype=torch.int64).remainder(251).to(torch.uint8)
    image = blank.view(1, height, width, 3)
    stem.eval()
    with torch.no_grad():
        expected = backbone.eval().maps(image)
        found = stem(image)
        deep = cells.eval().deep(found)
        if not (torch.equal(found, expected[0]) and torch.equal(deep, expected[1])):
            raise UsageError(
                f"backbone: {config.name} cannot be cut at stride {STEM_STRIDE}; choose a network "
                "of plain stages, e.g. of the MobileNet, EfficientNet or ResNet families"
            )
        stem.shape = _three(found)
        cells.size, cells.stem_channels = int(cells(found).shape[2]), stem.size
        cells.shape = _three(deep)
    return stem, cells, sha256


def _three(found: Tensor) -> tuple[int, int, int]:
    _, channels, rows, columns = found.shape
    return int(channels), int(rows), int(columns)


def _parts(backbone: Backbone) -> tuple[nn.Sequential, nn.Sequential]:
    """Return the layers up to stride 8 and those from there to stride 16, in order of execution."""
    modules: list[tuple[str, nn.Module]] = []
    for name, child in backbone.body.named_children():
        if isinstance(child, nn.Sequential | nn.ModuleList) and name in ("blocks", "stages"):
            modules += [(f"{name}.{number}", block) for number, block in enumerate(child)]
        else:
            modules.append((name, child))
    ends = {str(info["reduction"]): info["module"] for info in backbone.body.feature_info}
    names = [name for name, _ in modules]
    first, last = ends[str(STEM_STRIDE)], ends[str(CELL_STRIDE)]
    if first not in names or last not in names:
        raise UsageError(
            f"backbone: expected a network of plain stages, found {backbone.config.name}"
        )
    border, end = names.index(first) + 1, names.index(last) + 1
    parts = [module for _, module in modules]
    return nn.Sequential(*parts[:border]), nn.Sequential(*parts[border:end])
