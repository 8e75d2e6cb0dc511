"""Convert command-line options to a ``TrainConfig`` and fill in data-dependent defaults."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import msgspec
from msgspec import Struct

from cvo_edge.errors import UsageError
from cvo_edge.vocabulary import Crop, SplitKind
from cvo_export.data.splits import SHARES, default_kind
from cvo_export.datasets import open_dataset
from cvo_export.networks.backbone import NO_WEIGHTS, TIMM_WEIGHTS, BackboneConfig
from cvo_export.networks.heads.base import Method
from cvo_export.networks.methods import TRAINABLE, options_of
from cvo_export.training.options import option_name
from cvo_export.training.run import TrainConfig
from cvo_export.vocabulary import Normalisation

# Pixels of all images and their copies, for methods with cells: 40,000 of 256x192, 6 GB of memory.
_PIXELS_OF_CELLS = 40_000 * 256 * 192


def configure(
    *,
    method: str,
    dataset: str,
    split: SplitKind | None,
    seed: int,
    size: str | None,
    crop: Crop,
    backbone: str,
    weights: str,
    stages: str,
    grid: str,
    normalisation: Normalisation | None,
    head: dict[str, Any],
    **given: float | None,
) -> TrainConfig:
    """Fill in the defaults; ``given`` are TrainConfig's numbers, ``head`` the method's options.

    None stands for the default. Raises UsageError for a malformed value or an option that the
    method does not have; these checks run before the data set is opened.
    """
    chosen, defaults = head_config(method, head), TRAINABLE[method]
    width, height = defaults.size if size is None else _pair(size, "size", "WIDTHxHEIGHT")
    if min(width, height) < 32 or max(width, height) > 4096:
        raise UsageError(f"size: expected 32 to 4096 pixels, found {size}")
    if normalisation is None:
        normalisation = "timm" if weights in (TIMM_WEIGHTS, NO_WEIGHTS) else "half"
    numbers: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if not numbers.get("noise", 1.0):
        del numbers["noise"]
    if "noise" in numbers and defaults.cells:
        known = ", ".join(name for name, each in TRAINABLE.items() if not each.cells)
        raise UsageError(
            f"noise: expected a method that trains a head on features ({known}), found {method}"
        )
    augment = {key: numbers.pop(key) for key in ("rotation_deg", "light") if key in numbers}
    if "copies" not in numbers:
        numbers["copies"] = _copies(defaults, dataset, width * height)
    numbers = {"steps": defaults.steps, **numbers}
    kind = split or default_kind(open_dataset(dataset))
    return TrainConfig(
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
        augment=replace(defaults.augment, **augment),
        head=chosen,
        **numbers,
    )


def _copies(defaults: Method, dataset: str, pixels: int) -> int:
    """Return the default number of copies of each training image."""
    if not defaults.cells:
        return defaults.copies
    shares = SHARES["training"]
    images = max(1.0, (shares["train"] + shares["fit"]) * len(open_dataset(dataset)))
    return min(defaults.copies, max(1, int(_PIXELS_OF_CELLS / pixels / images) - 1))


def head_config(method: str, options: dict[str, Any]) -> Struct:
    """Return a method's checked options; None stands for the default.

    Raises UsageError for an unknown method, an option that the method does not have, or a value out
    of range.
    """
    if method not in TRAINABLE:
        raise UsageError(f"method: expected one of {', '.join(TRAINABLE)}, found {method}")
    kind = TRAINABLE[method].config
    given = {name: value for name, value in options.items() if value is not None}
    for name, value in given.items():
        if name not in kind.__struct_fields__:
            known = ", ".join(option_name(field) for field in kind.__struct_fields__)
            raise UsageError(
                f"{option_name(name)} is not an option of {method}; its options are {known}"
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise UsageError(f"{option_name(name)}: expected a finite number, found {value}")
    try:
        return options_of({"method": method, **given})
    except msgspec.ValidationError as error:
        raise UsageError(_refusal(str(error), method, given)) from None


def _refusal(problem: str, method: str, given: dict[str, Any]) -> str:
    """Name the option and its value in the message about a field that is out of range."""
    found = re.fullmatch(r"E(.*) - at `\$\.(\w+)(?:\[\d+\])?`", problem)
    if found is None:
        return problem
    name = found[2]
    return f"{option_name(name)} of {method}: e{found[1]}, found {given[name]}"


def _pair(text: str, what: str, form: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if match is None:
        raise UsageError(f"{what}: expected {form}, found {text!r}")
    return int(match[1]), int(match[2])
