"""Calibrate an existing network: an ONNX model with suitable outputs, or the model of a bundle.

Does not need torch. A model whose only output is ``pose`` gets the residual score; a model that
also has ``lower`` and ``upper`` gets the scores of conformalized quantile regression. A bundle
keeps its method and gets thresholds from new data: a new site, another camera, other lighting.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace

import msgspec
import numpy as np
import onnx
from numpy.typing import NDArray

from cvo_edge.bundle.format import (
    FAMILIARITY,
    MAX_NUMBER,
    Calibration,
    PoseLimits,
    PoseSpec,
    Position,
    PreprocessSpec,
    Provenance,
    TensorSpec,
)
from cvo_edge.camera import Camera
from cvo_edge.engine.loading import read_bundle
from cvo_edge.errors import BundleMismatchError, SourceError, UsageError
from cvo_edge.geometry import mean_rotation
from cvo_edge.given import given_path
from cvo_edge.heads import HEADS, Candidate
from cvo_edge.heads.cqr import CqrParameters
from cvo_edge.pose import about
from cvo_edge.vocabulary import Crop, Decode, Joint, Provider, Rule, Sides, SplitKind
from cvo_export.bundles.candidates import selected
from cvo_export.bundles.draft import (
    CAMERA_FRAME,
    FEW_POSES_MARGIN,
    HALF_WIDTH_FLOOR,
    WORLD_FRAME,
    Draft,
    known_coordinates,
    known_space,
    model_spec,
    plausible,
    six,
    versions,
    with_any_rotation,
)
from cvo_export.bundles.observed import Observed
from cvo_export.bundles.rule import chosen_rule
from cvo_export.bundles.thresholds import calibrated
from cvo_export.bundles.writing import check_target, write_bundle
from cvo_export.data.pose_errors import mean_pose_error, median_error
from cvo_export.data.splits import Split, default_kind, make_split, same_split
from cvo_export.datasets import PoseDataset
from cvo_export.datasets.sizes import Size, one_size
from cvo_export.graph.adapt import adapted, other_form, refuse_other_form
from cvo_export.graph.adapt_options import OutputForm, read_input, read_outputs, read_size
from cvo_export.graph.external import read_onnx
from cvo_export.graph.trial import Form, tried
from cvo_export.vocabulary import GivenRotation

Array = NDArray[np.float64]

_FORMS = ({"pose": (1, 7)}, {"pose": (1, 7), "lower": (1, 6), "upper": (1, 6)})
_LEAST_INPUT = 16
_PACKAGES = ("cvo-edge", "cvo-export", "onnx", "onnxruntime", "numpy")


def calibrate(
    model: str | os.PathLike[str],
    dataset: PoseDataset,
    bundle_dir: str | os.PathLike[str],
    name: str,
    *,
    kind: SplitKind | None = None,
    seed: int | None = None,
    rule: Rule | None = None,
    cap: float | None = None,
    joint: Joint = "max",
    score: str | None = None,
    sides: Sides | None = None,
    rotation: GivenRotation | None = None,
    crop: Crop | None = None,
    origin_m: Position | None = None,
    given_input: str | None = None,
    given_outputs: Sequence[str] = (),
    size_text: str | None = None,
    new_data: bool = False,
    provider: Provider | None = None,
    decode: Decode | None = None,
) -> Calibration:
    """Calibrate a model file or the model of a bundle on a data set and write the new bundle.

    The network must not have been trained on the data set. A tenth of the frames (role ``val``)
    chooses the score and compares degrees of freedom, a fifth (``test``) is reserved for
    ``evaluate``, and the rest gives the thresholds. If the data set has its own test list, only
    the sequences on that list are used. If the bundle's run was split from this data set, the
    ``val`` and ``cal`` roles of that run are used.

    ``rotation`` (None: ``tangent_predicted``), ``crop`` (None: ``none``) and ``origin_m`` (None:
    the world's own) describe a model file; its positions are relative to that origin.
    ``given_input``, ``given_outputs`` and ``size_text`` are the texts of ``--input``, ``--output``
    and ``--size``, which adapt a model file of another form (see ``graph.adapt``).
    ``new_data`` states that a data set with the name of the training data contains none of its
    frames. ``provider`` (None: the bundle's provider, or ``onnxruntime`` for a model file) is the
    inference engine that the new bundle is made for, and ``decode`` (None: the bundle's, or
    ``full``) how it decodes JPEG files.

    Raises
    ------
    ModelError, BundleMismatchError
        The file is not a model, or its inputs and outputs do not fit.
    CalibrationFileError
        The folder is not a bundle.
    SourceError, UsageError
        The data set is too small, its images have several sizes, its frames do not pass the checks
        or may have been used for training, or an option does not apply.
    SinkError
        The new folder cannot be written.
    """
    model = given_path(model, "model")
    bundle_dir = given_path(bundle_dir, "bundle")
    check_target(bundle_dir)
    size = one_size(dataset)
    if model.is_dir():
        if (rotation, crop, origin_m) != (None, None, None):
            raise UsageError(
                "rotation, crop, origin: expected only with an ONNX file; a bundle states its own"
            )
        if given_input is not None or given_outputs or size_text is not None:
            raise UsageError(
                "input, output, size: expected only with an ONNX file; a bundle states its own"
            )
        bundle = read_bundle(model)
        split = _split_of(bundle.calibration, dataset, kind, seed, new_data)
        draft = Draft.of(bundle.calibration)
        if split.purpose == "calibration":
            draft = _with_wider_limits(draft, dataset.poses[split.roles["val"]])
        model_bytes = bundle.model_bytes
        candidates = bundle.head.candidates()
    else:
        network = read_onnx(model)
        form = Form(
            read_input(given_input),
            read_outputs(given_outputs) or {"pose": OutputForm("pose")},
            read_size(size_text),
            crop or "none",
        )
        model_bytes = network.SerializeToString()
        if given_input is not None or given_outputs or size_text is not None:
            outputs = form.outputs if given_outputs else {}
            model_bytes, left_out = adapted(network, form.given, outputs, form.size)
            if left_out:
                _say([f"outputs left out: {', '.join(left_out)}"])
        split = _new_split(dataset, kind, seed)
        if not all(abs(value) < MAX_NUMBER for value in origin_m or ()):
            raise UsageError(f"origin: expected metres below {MAX_NUMBER:g}, found {origin_m}")
        draft = _from_model(
            *(model_bytes, dataset, split, name),
            rotation or "tangent_predicted",
            crop or "none",
            origin_m,
        )
        candidates = _given_candidates(draft)
        val = split.roles["val"]
        _say(tried(network, form, dataset, val, origin_m, stated=bool(given_outputs)))
    rule, cap = chosen_rule(rule, cap, split.kind)
    inputs = msgspec.structs.replace(draft.preprocess, decode=decode or draft.preprocess.decode)
    if inputs.decode == "half":
        inputs.check_halves(size[1], size[0])
    dataset = dataset.decoded(inputs.decode)
    own = provider or draft.model.provider
    # A solver's network recognises the place as the camera of its training shows it.
    solves = HEADS[draft.method].solves
    made = {**draft.provenance.created_with, **versions((*_PACKAGES, own))}
    draft = replace(
        draft,
        name=name,
        rule=rule,
        cap=cap,
        joint=joint,
        split=split.spec(dataset),
        dataset=dataset.name,
        camera=draft.camera if solves else dataset.camera() or _of_size(draft.camera, size),
        running=dataset.camera() if solves else None,
        model=msgspec.structs.replace(draft.model, provider=own),
        preprocess=inputs,
        provenance=msgspec.structs.replace(draft.provenance, created_with=made),
    )
    chosen_from = selected(candidates, score, sides)
    calibration = calibrated(draft, model_bytes, dataset, split.roles, chosen_from, _tell_errors)
    return write_bundle(bundle_dir, calibration, model_bytes)


def _say(lines: Iterable[str]) -> None:
    for line in lines:
        print(line, file=sys.stderr, flush=True)


def _tell_errors(*observed: Observed) -> None:
    """Say which frames were refused, and compare the point error with the mean pose's."""
    roles = zip(("val", "cal"), observed, strict=True)
    _say(f"refused in {role}: {seen.refused}" for role, seen in roles if seen.refused)
    poses, true_poses = (
        np.concatenate([getattr(seen, name) for seen in observed]) for name in ("pose", "true_pose")
    )
    error, mean = median_error(poses, true_poses), mean_pose_error(true_poses)
    _say([f"point error: median {error} of {len(poses)} frames; their mean pose's {mean}"])
    if max(error.shares(mean)) >= 1.0:
        _say(["warning: the network is no better than the mean pose, and its intervals are wide"])


def _of_size(camera: Camera | None, size: Size) -> Camera | None:
    """Return the camera, unless the images of the new data have another size than its own."""
    same = camera is not None and (camera.width, camera.height) == size
    return camera if same else None


def _split_of(
    calibration: Calibration,
    dataset: PoseDataset,
    kind: SplitKind | None,
    seed: int | None,
    new_data: bool,
) -> Split:
    """Return the run's split if the data set is the run's, otherwise a new split."""
    trained_on, name = calibration.provenance.training_split, calibration.provenance.dataset
    if trained_on is None:
        return _new_split(dataset, kind, seed)
    try:
        split = same_split(dataset, trained_on)
    except (SourceError, UsageError):
        if dataset.name == name and not new_data:
            raise UsageError(
                f"data set: expected frames that the network was not trained on, found other "
                f"frames under the name of the training data, {name}; pass --new-data if none of "
                "them was used for training"
            ) from None
        return _new_split(dataset, kind, seed)
    if "folds" in calibration.provenance.options:
        raise UsageError(
            "data set: expected frames that the network was not trained on, found the recordings "
            "of its crossed calibration, which trained it; publish the run again"
        )
    if kind is not None or seed is not None:
        raise UsageError(
            "split, seed: cannot be chosen for the data set that the bundle was trained on; "
            "its recorded split is used"
        )
    return split


def _new_split(dataset: PoseDataset, kind: SplitKind | None, seed: int | None) -> Split:
    kind = kind or default_kind(dataset, "calibration")
    return make_split(dataset, kind, seed or 0, "calibration")


def _opset(model: onnx.ModelProto) -> int:
    versions = [entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx")]
    return int(max(versions, default=1))


def _from_model(
    model_bytes: bytes,
    dataset: PoseDataset,
    split: Split,
    name: str,
    rotation: GivenRotation,
    crop: Crop,
    origin_m: Position | None,
) -> Draft:
    """Return a draft for a model of which only the tensors and the data's poses are known."""
    model = onnx.load_from_string(model_bytes)
    refuse_other_form(model)
    spec = model_spec(model_bytes, _opset(model))
    outputs = {tensor.name: tensor.shape for tensor in spec.outputs}
    shape = spec.inputs[0].shape if len(spec.inputs) == 1 else ()
    image = {"name": "image", "dtype": "uint8", "shape": (1, *shape[1:3], 3)}
    # A graph may also tell how familiar an image is.
    statistics = {name: shape for name, shape in outputs.items() if name in FAMILIARITY}
    form = {name: shape for name, shape in outputs.items() if name not in FAMILIARITY}
    if (
        form not in _FORMS
        or statistics not in ({}, FAMILIARITY)
        or [_fields(tensor) for tensor in spec.inputs] != [image]
    ):
        raise other_form(model)
    if min(shape[1:3]) < _LEAST_INPUT:
        raise BundleMismatchError(
            f"model: expected an input of at least {_LEAST_INPUT}x{_LEAST_INPUT} pixels, found "
            f"{shape[2]}x{shape[1]}"
        )
    reference, limits, deviation = known_space(about(dataset.poses[split.roles["val"]], origin_m))
    if rotation == "euler_zyx" or reference is None:
        reference, limits = None, with_any_rotation(limits)
    return Draft(
        name=name,
        method="cqr",
        model=spec,
        preprocess=PreprocessSpec(
            height=shape[1],
            width=shape[2],
            colour_order="rgb",
            interpolation="halve_then_linear_exact",
            crop=crop,
            mean=None,
            std=None,
            layout="nhwc",
            in_graph=("cast", "transpose", "normalise"),
        ),
        pose=PoseSpec(
            target="absolute",
            frame_id=WORLD_FRAME,
            child_frame_id=CAMERA_FRAME,
            rotation=rotation,
            reference_q_xyzw=reference,
            units=("m", "rad"),
            limits=limits,
            standard_deviation=deviation,
            origin_m=origin_m,
        ),
        camera=dataset.camera(),
        provenance=Provenance(
            created_with=versions(_PACKAGES),
            seed=split.seed,
            backbone=None,
            weights_sha256=None,
            dataset=dataset.name,
            training_split=None,
            options={},
        ),
        rule="pooled",
        joint="max",
        split=split.spec(dataset),
        dataset=dataset.name,
    )


def _fields(tensor: TensorSpec) -> dict[str, object]:
    return {"name": tensor.name, "dtype": tensor.dtype, "shape": tensor.shape}


def _with_wider_limits(draft: Draft, poses: Array) -> Draft:
    """Widen a bundle's limits to include the poses (n, 7) of the new data."""
    pose = draft.pose
    poses = about(poses, pose.origin_m)
    if pose.reference_q_xyzw is None:
        coordinates = known_coordinates(poses, mean_rotation(poses[:, 3:]))
        found = with_any_rotation(plausible(coordinates, FEW_POSES_MARGIN))
    else:
        coordinates = known_coordinates(poses, np.array(pose.reference_q_xyzw))
        found = plausible(coordinates, FEW_POSES_MARGIN)
    limits = PoseLimits(
        lowest=six(np.minimum(pose.limits.lowest, found.lowest)),
        highest=six(np.maximum(pose.limits.highest, found.highest)),
    )
    return replace(draft, pose=msgspec.structs.replace(pose, limits=limits))


def _given_candidates(draft: Draft) -> tuple[Candidate, ...]:
    floor = six(HALF_WIDTH_FLOOR * np.array(draft.pose.standard_deviation))
    parameters = CqrParameters(half_width_floor=floor, sides="symmetric")
    bounds = any(tensor.name == "lower" for tensor in draft.model.outputs)
    scores = ("normalised", "additive") if bounds else ("residual",)
    return tuple(Candidate(score, parameters) for score in scores)
