"""A study: grids of methods, backbones, data, noise, options and seeds; every cell runs once.

The configuration is a TOML list of grids; see ``Grid``. A cell that two grids share runs once. One
folder stores all cells: an interrupted study resumes, and an extended one runs only its new cells.
"""

from __future__ import annotations

import hashlib
import os
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from cvo_edge.errors import UsageError
from cvo_edge.vocabulary import SplitKind
from cvo_export.bundles.draft import versions
from cvo_export.data.noise import parse_noise
from cvo_export.data.splits import default_kind
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.datasets.describe import summary
from cvo_export.files import write_json
from cvo_export.networks.backbone import TIMM_WEIGHTS
from cvo_export.progress import Progress
from cvo_export.study.cell import CONFIDENCE, Cell
from cvo_export.study.cells import CellFolder, Say
from cvo_export.study.frame_times import Timing, timed
from cvo_export.study.workers import Engine
from cvo_export.training.configure import configure
from cvo_export.training.loop import check_roles
from cvo_export.training.run import TrainConfig, loaded_backbone

RESULTS_FILE = "results.json"

Value = str | int | float
# Options of the backbone and of the data; all others belong to the method.
_OF_THE_NETWORK = ("stages", "grid", "share")


class Grid(Struct, frozen=True, forbid_unknown_fields=True):
    """All combinations of the values in its lists.

    Attributes
    ----------
    name
        Title of the grid in the report.
    data
        Each ``FORMAT:PATH``; ``$NAME`` and ``${NAME}`` are environment variables.
    split
        Split of all data sets; default: ``sequence`` for data of five or more sequences, otherwise
        ``block``.
    methods, backbones
        Names.
    weights
        ``timm``, ``none`` or a file, as for ``train``; variables as in ``data``.
    seeds
        Number of seeds, starting at 0.
    noises
        Each ``NAME`` or ``NAME:STRENGTH``; every cell is also evaluated with each of them.
    vary
        Option -> its values: ``stages``, ``grid``, ``share`` (of the training frames) or an option
        of the methods.
    size, stages, grid, copies, steps, fine_tune
        As for ``train``.
    """

    name: Annotated[str, Meta(min_length=1, max_length=60)]
    data: Annotated[list[str], Meta(min_length=1)]
    methods: Annotated[list[str], Meta(min_length=1)]
    split: SplitKind | None = None
    backbones: Annotated[list[str], Meta(min_length=1)] = msgspec.field(
        default_factory=lambda: ["mobilenetv2_100"]
    )
    weights: str = "timm"
    seeds: Annotated[int, Meta(ge=1)] = 3
    noises: list[str] = []
    vary: dict[str, Annotated[list[Value], Meta(min_length=1)]] = {}
    size: str | None = None
    stages: str = "16"
    grid: str = "3x4"
    copies: Annotated[int, Meta(ge=0)] | None = None
    steps: Annotated[int, Meta(ge=1)] | None = None
    fine_tune: Annotated[int, Meta(ge=0)] | None = None


class Study(Struct, frozen=True, forbid_unknown_fields=True):
    """The content of a configuration file."""

    title: str
    grids: Annotated[list[Grid], Meta(min_length=1)]


class Place(Struct, frozen=True, forbid_unknown_fields=True):
    """A cell's position in a grid.

    ``data`` is a key of ``Results.data``; ``varied`` holds the values of the varied options.
    """

    grid: str
    cell: str
    data: str
    split: SplitKind
    backbone: str
    method: str
    seed: int
    varied: dict[str, Value]


class Results(Struct, frozen=True, forbid_unknown_fields=True):
    """Content of ``results.json``; its only paths are those written in the configuration.

    Seconds and milliseconds depend on the machine; all other figures do not. ``data`` maps the
    label of each data set to its text in the configuration; labels of data sets with the same name
    include that text. ``timing`` maps the name of a grid to milliseconds per cell, on its first
    data set.
    """

    title: str
    confidence: float
    study: Study
    data: dict[str, str]
    places: list[Place]
    cells: dict[str, Cell]
    timing: dict[str, Timing]
    versions: dict[str, str]


class Plan(Struct):
    """The cells of a study by name: their configurations and the noises of their evaluation.

    ``data`` holds the opened data sets and ``labels`` their labels, both by text.
    """

    data: dict[str, PoseDataset]
    labels: dict[str, str]
    places: list[Place]
    configs: dict[str, TrainConfig]
    noises: dict[str, list[str]]


def read_study(path: Path) -> Study:
    """Read a configuration; raises UsageError if it is invalid."""
    try:
        return msgspec.convert(tomllib.loads(path.read_text("utf-8-sig")), Study)
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        # Invalid encoding, TOML or content.
        raise UsageError(f"{path}: not a valid study: {error}") from None


def run_study(
    study: Study, folder: CellFolder, engine: Engine, progress: Progress, say: Say
) -> Results:
    """Run the missing cells, time the bundles, and write ``results.json``.

    Before any run, raises UsageError for an invalid grid and for finished cells with other data or
    weights; afterwards, raises what ``CellFolder.fill`` raises.
    """
    plan = plan_study(study)
    for dataset in plan.data.values():
        say(summary(dataset))
    _check_networks(plan.configs.values())
    folder.check_data(plan.configs)
    cells = folder.fill(plan.configs, plan.noises, engine, progress, say)
    results = Results(
        title=study.title,
        confidence=CONFIDENCE,
        study=study,
        data={label: text for text, label in plan.labels.items()},
        places=plan.places,
        cells=cells,
        timing={
            grid.name: _timing(grid, plan, cells, folder) for grid in study.grids if not grid.vary
        },
        versions=versions(("cvo-edge", "cvo-export", "torch", "timm", "onnx", "scikit-learn")),
    )
    write_json(folder.out / RESULTS_FILE, results)
    return results


def expanded(text: str) -> str:
    """Replace environment variables; raises UsageError if one is not set."""
    found = os.path.expandvars(text)
    if (unset := re.search(r"\$\{?(\w+)", found)) is not None:
        raise UsageError(f"{text}: the environment variable {unset[1]} is not set")
    return found


def plan_study(study: Study) -> Plan:
    """Open the data and name all cells of a study; raises UsageError for an invalid grid."""
    opened = {text: open_dataset(expanded(text)) for grid in study.grids for text in grid.data}
    plan = Plan(opened, _labels(opened), [], {}, {})
    names = [_file_safe(grid.name).lower() for grid in study.grids]
    if len(set(names)) < len(names):
        raise UsageError(
            "study: grid names must differ in their letters and digits, found "
            + ", ".join(grid.name for grid in study.grids)
        )
    for grid in study.grids:
        try:
            _add(plan, grid)
        except UsageError as error:
            raise UsageError(f"grid {grid.name}: {error}") from None
    return plan


def _add(plan: Plan, grid: Grid) -> None:
    """Add the cells of a grid."""
    noises = [str(parse_noise(text)) for text in grid.noises]
    lists: dict[str, Sequence[Value]] = {
        "data": grid.data,
        "methods": grid.methods,
        "backbones": grid.backbones,
        "noises": noises,
        **grid.vary,
    }
    for name, values in lists.items():
        if len(set(values)) < len(values):
            raise UsageError(f"{name}: expected each value once, found {values}")
    combinations = [dict(zip(grid.vary, v, strict=True)) for v in product(*grid.vary.values())]
    for data, backbone, method, varied, seed in product(
        grid.data, grid.backbones, grid.methods, combinations, range(grid.seeds)
    ):
        dataset = plan.data[data]
        split = grid.split or default_kind(dataset)
        config = _config(grid, data, split, backbone, method, varied, seed)
        check_roles(config, dataset)
        name = _cell_name(config, data, grid.weights, dataset.name)
        plan.configs[name] = config
        known = plan.noises.setdefault(name, [])
        known += [noise for noise in noises if noise not in known]
        plan.places.append(
            Place(grid.name, name, plan.labels[data], split, backbone, method, seed, varied)
        )


def _check_networks(configs: Iterable[TrainConfig]) -> None:
    """Raise UsageError if a backbone cannot be built, or if the weights do not fit it."""
    distinct = {
        msgspec.json.encode((c.backbone, c.height, c.width, c.weights, c.cells)): c
        for c in configs
        # Weights from timm would have to be downloaded.
        if c.weights != TIMM_WEIGHTS
    }
    for config in distinct.values():
        loaded_backbone(config, config.weights)


def _labels(opened: Mapping[str, PoseDataset]) -> dict[str, str]:
    names = [dataset.name for dataset in opened.values()]
    return {
        text: dataset.name if names.count(dataset.name) == 1 else f"{dataset.name} ({text})"
        for text, dataset in opened.items()
    }


def _config(
    grid: Grid,
    data: str,
    split: SplitKind,
    backbone: str,
    method: str,
    varied: Mapping[str, Value],
    seed: int,
) -> TrainConfig:
    network: dict[str, Any] = {"stages": grid.stages, "grid": grid.grid, "share": None}
    network |= {key: value for key, value in varied.items() if key in _OF_THE_NETWORK}
    for name in ("stages", "grid"):
        if not isinstance(network[name], str):
            raise UsageError(f"{name}: expected text, found {network[name]!r}")
    share = network["share"]
    if share is not None:
        if isinstance(share, str) or not 0.0 < share <= 1.0:
            raise UsageError(f"share: expected above 0, at most 1, found {share!r}")
        network["share"] = float(share)
    return configure(
        method=method,
        dataset=expanded(data),
        split=split,
        seed=seed,
        size=grid.size,
        crop="none",
        backbone=backbone,
        weights=expanded(grid.weights),
        normalisation=None,
        head={key: value for key, value in varied.items() if key not in _OF_THE_NETWORK},
        copies=grid.copies,
        steps=grid.steps,
        fine_tune=grid.fine_tune,
        **network,
    )


def _cell_name(config: TrainConfig, data: str, weights: str, dataset_name: str) -> str:
    """Return the name of a cell, which does not depend on the paths of its data and weights."""
    decisive = {**msgspec.to_builtins(config), "dataset": data, "weights": weights}
    digest = hashlib.sha256(msgspec.json.encode(decisive)).hexdigest()[:8]
    words = (dataset_name, config.split, config.backbone.name, config.method, str(config.seed))
    return "-".join(_file_safe(word) for word in (*words, digest))


def _timing(
    grid: Grid,
    plan: Plan,
    cells: Mapping[str, Cell],
    folder: CellFolder,
) -> Timing:
    """Time a grid's bundles of seed 0 on its first data set."""
    first = (grid.name, plan.labels[grid.data[0]], 0)
    names = [p.cell for p in plan.places if (p.grid, p.data, p.seed) == first]
    bundles = {name: (cells[name].bundle, folder.bundle(name)) for name in names}
    return timed(
        folder.out / f"timing-{_file_safe(grid.name)}.json", bundles, plan.data[grid.data[0]]
    )


def _file_safe(text: str) -> str:
    return re.sub(r"[^\w.]+", "_", text)
