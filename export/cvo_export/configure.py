"""Options of the command line -> a ``TrainConfig``, with what depends on the data filled in."""

from __future__ import annotations

import re
from typing import Any

from cvo_edge.errors import UsageError
from cvo_edge.preprocess import Crop
from cvo_export.augment import AugmentConfig
from cvo_export.backbone import NO_WEIGHTS, TIMM_WEIGHTS, BackboneConfig, Normalisation
from cvo_export.datasets import open_dataset
from cvo_export.heads.cjp import CjpConfig
from cvo_export.run import TrainConfig
from cvo_export.splits import Kind, default_kind


def configure(
    *,
    method: str,
    dataset: str,
    split: Kind | None,
    seed: int,
    size: str,
    crop: Crop,
    backbone: str,
    weights: str,
    stages: str,
    grid: str,
    normalisation: Normalisation | None,
    head: dict[str, Any],
    **given: float | None,
) -> TrainConfig:
    """Fill in the defaults; ``given`` are TrainConfig's numbers, None for its own default.

    Raises UsageError for texts that are not of their form.
    """
    width, height = _pair(size, "size", "WIDTHxHEIGHT")
    if min(width, height) < 32 or max(width, height) > 4096:
        raise UsageError(f"size: expected 32 to 4096 pixels, found {size}")
    if normalisation is None:
        normalisation = "timm" if weights in (TIMM_WEIGHTS, NO_WEIGHTS) else "half"
    numbers: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    augment = {key: numbers.pop(key) for key in ("rotation_deg", "light") if key in numbers}
    kind = split or default_kind(open_dataset(dataset))
    if method != "cjp":
        raise UsageError(f"method: expected cjp, found {method}")
    return TrainConfig(
        method="cjp",
        dataset=dataset,
        split=kind,
        seed=seed,
        height=height,
        width=width,
        crop=crop,
        backbone=BackboneConfig(
            backbone, tuple(stages.split(",")), _pair(grid, "grid", "ROWSxCOLUMNS"), normalisation
        ),
        weights=weights,
        augment=AugmentConfig(**augment),
        head=CjpConfig(**head),
        **numbers,
    )


def _pair(text: str, what: str, form: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if match is None:
        raise UsageError(f"{what}: expected {form}, found {text!r}")
    return int(match[1]), int(match[2])
