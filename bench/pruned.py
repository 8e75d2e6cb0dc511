"""A pretrained MobileNetV2 with fewer expansion channels, as models of timm.

``mobilenetv2_kept_75`` and ``mobilenetv2_kept_50`` keep three quarters and a half of the channels
between the first and the last convolution of each inverted residual block, those that contribute
most to its output: by |scale of the second batch normalisation| times the L1 norm of the weights
that read the channel. Widths are multiples of 16, the block of onnxruntime's convolutions.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import timm
import torch
from safetensors.torch import load_file, save_file
from timm.models import register_model
from torch import Tensor, nn

_BLOCK = 16


def pruned_weights(weights: Path, kept: int, path: Path) -> Path:
    """Write the weights of ``mobilenetv2_kept_KEPT``; ``kept`` is a percentage."""
    body = timm.create_model("mobilenetv2_100", pretrained=False, num_classes=0)
    body.load_state_dict(load_file(weights), strict=False)
    save_file(_pruned(body, kept).state_dict(), path)
    return path


@register_model
def mobilenetv2_kept_75(pretrained: bool = False, **options: Any) -> nn.Module:  # noqa: ANN401
    """Three quarters of the expansion channels."""
    return _pruned(timm.create_model("mobilenetv2_100", pretrained=pretrained, **options), 75)


@register_model
def mobilenetv2_kept_50(pretrained: bool = False, **options: Any) -> nn.Module:  # noqa: ANN401
    """Half of the expansion channels."""
    return _pruned(timm.create_model("mobilenetv2_100", pretrained=pretrained, **options), 50)


def _pruned(body: nn.Module, kept: int) -> nn.Module:
    """Drop the expansion channels that contribute least."""
    for block in _inverted(body):
        importance = block.bn2.weight.abs() * block.conv_pwl.weight.abs().sum(dim=(0, 2, 3))
        width = max(_BLOCK, round(len(importance) * kept / 100 / _BLOCK) * _BLOCK)
        rows = importance.argsort(descending=True)[:width].sort().values
        block.conv_pw = _selected(block.conv_pw, rows, 0)
        block.conv_dw = _selected(block.conv_dw, rows, 0)
        block.conv_pwl = _selected(block.conv_pwl, rows, 1)
        for norm in (block.bn1, block.bn2):
            norm.num_features = width
            norm.weight, norm.bias = (nn.Parameter(p.data[rows]) for p in (norm.weight, norm.bias))
            norm.running_mean, norm.running_var = norm.running_mean[rows], norm.running_var[rows]
    return body


def _inverted(body: nn.Module) -> Iterator[Any]:
    return (module for module in body.modules() if hasattr(module, "conv_pwl"))


def _selected(layer: nn.Conv2d, rows: Tensor, axis: int) -> nn.Conv2d:
    """Return the convolution with these outputs (axis 0) or inputs (axis 1)."""
    weight = layer.weight.data.index_select(axis, rows)
    depthwise = layer.groups > 1
    inputs = len(rows) if depthwise else weight.shape[1]
    found = nn.Conv2d(
        inputs,
        weight.shape[0],
        layer.kernel_size,
        layer.stride,
        layer.padding,
        groups=inputs if depthwise else 1,
        bias=False,
    )
    with torch.no_grad():
        found.weight.copy_(weight)
    return found
