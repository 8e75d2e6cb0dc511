"""Publish a run as a bundle: export, parity check, calibration, self-test and atomic write."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, cast

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from cvo_edge.bundle.format import Calibration, PoseSpec, PreprocessSpec, Provenance
from cvo_edge.engine.session import Session
from cvo_edge.errors import GateError
from cvo_edge.given import given_path
from cvo_edge.input import preprocess
from cvo_edge.input.frame_checks import SAMPLE_STEP
from cvo_edge.vocabulary import Decode, Joint, Precision, Provider, Rule, Sides
from cvo_export.bundles.candidates import selected
from cvo_export.bundles.crossed import Fold, calibrated_crossed
from cvo_export.bundles.draft import (
    CAMERA_FRAME,
    WORLD_FRAME,
    Draft,
    four,
    model_spec,
    plausible,
    six,
    versions,
    with_any_rotation,
)
from cvo_export.bundles.rule import chosen_rule
from cvo_export.bundles.thresholds import calibrated
from cvo_export.bundles.writing import check_target, write_bundle
from cvo_export.datasets.base import remembered
from cvo_export.datasets.sizes import one_size
from cvo_export.graph.familiarise import familiarised
from cvo_export.graph.familiarity_nodes import CELLS, PIXELS
from cvo_export.graph.quantise import quantised
from cvo_export.graph.to_onnx import OPSET, check_parity, export_onnx
from cvo_export.networks.backbone import Backbone, Pooled
from cvo_export.networks.heads import ExportedHead
from cvo_export.networks.stem import Stem
from cvo_export.training.run import PoseGraph, Run

Array = NDArray[np.float64]

_PACKAGES = ("cvo-edge", "cvo-export", "torch", "timm", "onnx", "onnxruntime", "numpy")
_PARITY_FRAMES = 32
# Frames that give the value ranges of the feature maps for quantisation.
_RANGE_FRAMES = 128
# Limits of a degree of freedom that stands still, in units of its floor on either side.
_STILL_MARGIN = 10.0


def publish(
    run: Run,
    bundle_dir: str | os.PathLike[str],
    name: str,
    *,
    rule: Rule | None = None,
    cap: float | None = None,
    joint: Joint = "max",
    score: str | None = None,
    sides: Sides | None = None,
    precision: Precision = "fp32",
    provider: Provider = "onnxruntime",
    decode: Decode = "full",
) -> Calibration:
    """Export and calibrate a finished run, write its bundle and return the calibration.

    ``rule`` and ``cap`` None mean the default of the run's split (see ``chosen_rule``); ``score``
    None chooses the score on the val frames. ``int8`` quantises the backbone before calibration.
    Scores and thresholds always come from the exported graph, run by ``provider``; in a crossed
    run, from the graphs of its folds, which are exported in the same way. ``half`` decodes the JPEG
    files of the data set, and those that the bundle will run on, at half size.

    Raises
    ------
    GateError
        torch and onnxruntime disagree, or the written bundle fails its own self-test.
    SinkError
        The folder cannot be written, or contains files that do not belong to a bundle.
    UsageError
        The method does not have the requested score or sides, or the rule the cap; ``half`` with
        images that are no JPEG files, have odd sides or fewer pixels than twice the model's input.
    SourceError
        The images of the data set have several sizes.
    ModelError
        The provider is not installed, or cannot run the graph.
    """
    bundle_dir = given_path(bundle_dir, "bundle")
    check_target(bundle_dir)
    size = one_size(run.dataset)
    inputs = _preprocess(run, decode)
    if decode == "half":
        inputs.check_halves(size[1], size[0])
    run = replace(run, dataset=remembered(run.dataset.decoded(decode)))
    candidates = selected(run.graph.head.candidates(), score, sides)
    rule, cap = chosen_rule(rule, cap, run.split.kind)
    model_bytes, parity = _export(run, run.graph.head, run.training_frames, precision, provider)
    draft = _draft(run, model_bytes, inputs, name, (rule, cap), joint, parity, provider)
    if run.folds:
        folds = [
            _fold(run, head, indices, draft, precision, score, sides)
            for head, indices in zip(run.folds, run.fold_frames, strict=True)
        ]
        val = run.split.roles["val"]
        calibration = calibrated_crossed(draft, model_bytes, run.dataset, val, candidates, folds)
    else:
        calibration = calibrated(draft, model_bytes, run.dataset, run.split.roles, candidates)
    return write_bundle(bundle_dir, calibration, model_bytes)


def _fold(
    run: Run,
    head: ExportedHead,
    indices: NDArray[np.int64],
    draft: Draft,
    precision: Precision,
    score: str | None,
    sides: Sides | None,
) -> Fold:
    """Export the network that was trained without these frames."""
    others = run.training_frames[~np.isin(run.training_frames, indices)]
    model_bytes, _ = _export(run, head, others, precision, draft.model.provider)
    model = model_spec(model_bytes, OPSET, draft.model.provider)
    candidates = selected(head.candidates(), score, sides)
    return Fold(replace(draft, model=model), model_bytes, candidates, indices)


class _Deployed(nn.Module):
    """The method's outputs, then the features by cell and some pixels, for familiarity.

    The features are those of the last stage, (1, cells, channels), the pixels those of the frame
    checks.
    """

    backbone: Backbone | Stem

    def __init__(self, graph: PoseGraph, image: torch.Tensor) -> None:
        super().__init__()
        self.backbone, self.head = graph.backbone, graph.head.deployed()
        self.pooled = None
        if isinstance(self.backbone, Stem):
            with torch.no_grad():
                _, channels, rows, columns = self.head(self.backbone(image))[-1].shape
            self.pooled = Pooled((channels, rows, columns))

    def forward(self, image: torch.Tensor, *extra: torch.Tensor) -> tuple[torch.Tensor, ...]:
        features = self.backbone(image)
        outputs = self.head(features, *extra)
        if self.pooled is None:
            cells = cast("Backbone", self.backbone).cells(features)
        else:
            *outputs, deep = outputs
            cells = self.pooled.cells(deep)
        some = slice(SAMPLE_STEP // 2, None, SAMPLE_STEP)
        return *outputs, cells, image[:, some, some]


def _export(
    run: Run,
    head: ExportedHead,
    training: NDArray[np.int64],
    precision: Precision,
    provider: Provider,
) -> tuple[bytes, float]:
    """Return the model bytes and the largest difference between torch and onnxruntime on val.

    The difference is measured on the float32 graph, before any quantisation. ``training`` are the
    frames that the head was trained on; some give the value ranges for 8 bits and the statistics of
    familiarity.
    """
    config = run.config
    image = torch.zeros((1, config.height, config.width, 3), dtype=torch.uint8)
    names = ["image", *head.extra_inputs]
    inputs = [image, *head.extra_inputs.values()]
    trained = PoseGraph(run.graph.backbone, head).eval()
    graph = _Deployed(trained, image).eval()
    content = export_onnx(graph, inputs, names, (*head.output_names, CELLS, PIXELS))
    feeds = _feeds(run, run.split.roles["val"][:_PARITY_FRAMES])
    session = Session(content)
    parity = check_parity(trained, session, feeds, names, head.output_names, head.point_outputs)
    if precision == "int8":
        spread = np.linspace(0, training.size - 1, min(_RANGE_FRAMES, training.size)).astype(int)
        content = quantised(content, _feeds(run, training[spread]), provider)
        session = Session(content)
    completed = head.completed(content)
    if completed != content:
        after = Session(completed)
        for feed in feeds:
            _compare(head.completed_outputs(session.run(feed)), after.run(feed))
    return familiarised(completed, run.dataset, training, _feed_of(run), config.seed), parity


def _feeds(run: Run, indices: NDArray[np.int64]) -> list[dict[str, NDArray[Any]]]:
    """Return the model inputs for these frames."""
    feed = _feed_of(run)
    return [feed(run.dataset.read_image(index)) for index in indices.tolist()]


def _feed_of(run: Run) -> Callable[[NDArray[np.uint8]], dict[str, NDArray[Any]]]:
    """Return the function image -> model inputs; extra inputs are standard normal noise."""
    config, generator = run.config, np.random.default_rng(0)

    def feed(bgr: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        image = preprocess.model_input(bgr, config.height, config.width, config.crop)
        extras = {
            name: generator.standard_normal(example.shape).astype(np.float32)
            for name, example in run.graph.head.extra_inputs.items()
        }
        return {"image": image, **extras}

    return feed


def _compare(
    expected: Mapping[str, NDArray[np.float32]], found: Mapping[str, NDArray[np.float32]]
) -> None:
    """Raise GateError if the completed graph is not bit-identical to its reference."""
    for name, values in expected.items():
        if not np.array_equal(values, found[name]):
            worst = float(np.abs(values - found[name]).max())
            raise GateError(
                f"export: expected output {name} of the graph to equal its reference, found a "
                f"difference of {worst:.3g}"
            )


def _draft(
    run: Run,
    model_bytes: bytes,
    inputs: PreprocessSpec,
    name: str,
    rule: tuple[Rule, float | None],
    joint: Joint,
    parity: float,
    provider: Provider,
) -> Draft:
    """Return the bundle's content except its score, thresholds and self-test."""
    config, target = run.config, run.target
    model = model_spec(model_bytes, OPSET, provider)
    # The score's unit and the limits.
    known = target.coordinates(run.dataset.local_poses[run.training_frames])
    limits = plausible(known, np.where(target.still, _STILL_MARGIN * target.deviation, 0.0))
    if target.turns:
        limits = with_any_rotation(limits)
    return Draft(
        name=name,
        method=run.graph.head.runtime_method,
        model=model,
        preprocess=inputs,
        pose=PoseSpec(
            target="absolute",
            frame_id=WORLD_FRAME,
            child_frame_id=CAMERA_FRAME,
            rotation=run.graph.head.rotation,
            reference_q_xyzw=None if target.turns else four(target.reference_q_xyzw),
            units=("m", "rad"),
            limits=limits,
            standard_deviation=six(np.where(target.still, target.deviation, known.std(axis=0))),
            still=target.still_dof,
            origin_m=run.dataset.origin_m,
        ),
        provenance=Provenance(
            created_with=versions((*_PACKAGES, provider)),
            seed=config.seed,
            backbone=config.backbone.name,
            weights_sha256=run.weights_sha256,
            dataset=run.dataset.name,
            training_split=run.split.spec(run.dataset),
            options={
                **_options(run),
                "network": config.method,
                "lesson": run.best.lesson,
                **{f"chosen.{key}": value for key, value in run.graph.head.choices().items()},
                "parity": float(f"{parity:.3g}"),
            },
        ),
        camera=run.dataset.camera(),
        rule=rule[0],
        cap=rule[1],
        joint=joint,
        split=run.split.spec(run.dataset),
        dataset=run.dataset.name,
        crossed=run.config.crossed or None,
    )


def _preprocess(run: Run, decode: Decode) -> PreprocessSpec:
    return PreprocessSpec(
        height=run.config.height,
        width=run.config.width,
        colour_order="rgb",
        interpolation="halve_then_linear_exact",
        crop=run.config.crop,
        mean=_three(run.graph.backbone.mean),
        std=_three(run.graph.backbone.std),
        layout="nhwc",
        in_graph=("cast", "transpose", "normalise"),
        decode=decode,
    )


def _options(run: Run) -> Mapping[str, str | int | float | bool | None]:
    """Flatten the run's configuration, without the entries that the bundle stores elsewhere."""
    flat: dict[str, str | int | float | bool | None] = {}

    def add(prefix: str, values: Mapping[str, object]) -> None:
        for key, value in values.items():
            if key in ("dataset", "weights", "method", "seed"):
                continue
            if isinstance(value, Mapping):
                add(f"{key}.", value)
            elif isinstance(value, list | tuple):
                flat[prefix + key] = "x".join(str(item) for item in value)
            elif isinstance(value, str | int | float | bool | None):
                flat[prefix + key] = value

    add("", msgspec.to_builtins(run.config))
    return flat


def _three(values: list[float]) -> tuple[float, float, float]:
    a, b, c = values
    return (a, b, c)
