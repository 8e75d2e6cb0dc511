"""A network that is already there -> a bundle: any ONNX model of the right form, or a bundle.

Needs no torch. A model with the output ``pose`` alone gets the residual score; one with ``lower``
and ``upper`` besides the scores of conformalized quantile regression. A bundle keeps its method and
gets thresholds of other data: a new site, another camera, another light.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import onnx
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from cvo_edge.bundle.format import (
    Calibration,
    Joint,
    PoseLimits,
    PoseSpec,
    PreprocessSpec,
    Provenance,
    Provider,
    Rule,
    TensorSpec,
)
from cvo_edge.engine.loading import read_bundle
from cvo_edge.errors import BundleMismatchError, ModelError, SourceError, UsageError
from cvo_edge.geometry import mean_rotation
from cvo_edge.heads import Candidate
from cvo_edge.heads.cqr import CqrParameters, Sides
from cvo_edge.input.preprocess import Crop
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
)
from cvo_export.bundles.thresholds import calibrated, selected
from cvo_export.bundles.writing import check_target, write_bundle
from cvo_export.data.splits import Kind, Split, default_kind, make_split, same_split
from cvo_export.datasets import PoseDataset

Array = NDArray[np.float64]
GivenRotation = Literal["tangent_predicted", "euler_zyx"]

_FORMS = ({"pose": (1, 7)}, {"pose": (1, 7), "lower": (1, 6), "upper": (1, 6)})
_FULL_TURN = float(np.pi)
_LEAST_INPUT = 16
_PACKAGES = ("cvo-edge", "cvo-export", "onnx", "onnxruntime", "numpy")


def calibrate(
    model: Path,
    dataset: PoseDataset,
    bundle_dir: Path,
    name: str,
    *,
    kind: Kind | None = None,
    seed: int | None = None,
    rule: Rule | None = None,
    joint: Joint = "max",
    score: str | None = None,
    sides: Sides | None = None,
    rotation: GivenRotation | None = None,
    crop: Crop | None = None,
    new_data: bool = False,
    provider: Provider | None = None,
) -> Calibration:
    """Calibrate a model file or the model of a bundle on a data set and write the new bundle.

    The data set is one that the network has not been trained on: a tenth of it (role ``val``)
    decides between scores and compares degrees of freedom, a fifth (``test``) is left for
    ``evaluate``, the rest gives the thresholds; of a data set with a test list of its own that
    list alone is taken. Where it is the very data set that the bundle's run was split from, that
    run's own ``val`` and ``cal`` are used. ``rotation`` (None: ``tangent_predicted``) and ``crop``
    (None: ``none``) describe a model file. ``new_data`` says that a data set of the training data's
    name holds none of its frames. ``provider`` (None: the bundle's own, else ``onnxruntime``) is
    the engine that the new bundle is for.

    Raises
    ------
    ModelError, BundleMismatchError
        The file is no model, or has other inputs and outputs.
    CalibrationFileError
        The folder is no bundle.
    SourceError, UsageError
        The data set is too small, its frames do not pass the checks, or they may be those that the
        network was trained on; or an option that has no meaning here.
    SinkError
        The new folder cannot be written.
    """
    check_target(bundle_dir)
    if model.is_dir():
        if rotation is not None or crop is not None:
            raise UsageError("rotation, crop: expected with an ONNX file, found with a bundle")
        bundle = read_bundle(model)
        split = _split_of(bundle.calibration, dataset, kind, seed, new_data)
        draft = Draft.of(bundle.calibration)
        if split.purpose == "calibration":
            draft = _with_wider_limits(draft, dataset.poses[split.roles["val"]])
        model_bytes = bundle.model_bytes
        candidates = bundle.head.candidates()
    else:
        model_bytes = _read_model(model)
        split = _new_split(dataset, kind, seed)
        draft = _from_model(
            model_bytes, dataset, split, name, rotation or "tangent_predicted", crop or "none"
        )
        candidates = _given_candidates(draft)
    if rule is None:
        rule = "hierarchical" if split.kind == "sequence" else "pooled"
    own = provider or draft.model.provider
    made = {**draft.provenance.created_with, **versions((*_PACKAGES, own))}
    draft = replace(
        draft,
        name=name,
        rule=rule,
        joint=joint,
        split=split.spec(dataset),
        dataset=dataset.name,
        model=msgspec.structs.replace(draft.model, provider=own),
        provenance=msgspec.structs.replace(draft.provenance, created_with=made),
    )
    chosen_from = selected(candidates, score, sides)
    calibration = calibrated(draft, model_bytes, dataset, split.roles, chosen_from)
    return write_bundle(bundle_dir, calibration, model_bytes)


def _split_of(
    calibration: Calibration,
    dataset: PoseDataset,
    kind: Kind | None,
    seed: int | None,
    new_data: bool,
) -> Split:
    """The run's own split where the data set is the run's, else one of frames new to it."""
    trained_on, name = calibration.provenance.training_split, calibration.provenance.dataset
    if trained_on is None:
        return _new_split(dataset, kind, seed)
    try:
        split = same_split(dataset, trained_on)
    except (SourceError, UsageError):
        if dataset.name == name and not new_data:
            raise UsageError(
                f"data set: expected frames that the network was not trained on, found other "
                f"frames of the training data's name, {name}; --new-data says that they are new"
            ) from None
        return _new_split(dataset, kind, seed)
    if kind is not None or seed is not None:
        raise UsageError(
            "split, seed: expected none on the data set that the bundle was trained on, whose own "
            "roles are used, found some"
        )
    return split


def _new_split(dataset: PoseDataset, kind: Kind | None, seed: int | None) -> Split:
    kind = kind or default_kind(dataset, "calibration")
    return make_split(dataset, kind, seed or 0, "calibration")


def _read_model(path: Path) -> bytes:
    if not path.is_file():
        raise ModelError(f"{path}: expected an ONNX file or a bundle folder, found none")
    try:
        return path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}") from None


def _opset(model_bytes: bytes) -> int:
    try:
        model = onnx.load_from_string(model_bytes)
    except DecodeError:
        raise ModelError("model: expected an ONNX file, found something else") from None
    versions = [entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx")]
    return int(max(versions, default=1))


def _from_model(
    model_bytes: bytes,
    dataset: PoseDataset,
    split: Split,
    name: str,
    rotation: GivenRotation,
    crop: Crop,
) -> Draft:
    """Draft for a model that nothing is known of but its tensors and the data's poses."""
    spec = model_spec(model_bytes, _opset(model_bytes))
    outputs = {tensor.name: tensor.shape for tensor in spec.outputs}
    shape = spec.inputs[0].shape if len(spec.inputs) == 1 else ()
    image = {"name": "image", "dtype": "uint8", "shape": (1, *shape[1:3], 3)}
    if outputs not in _FORMS or [_fields(tensor) for tensor in spec.inputs] != [image]:
        raise BundleMismatchError(
            "model: expected the input image uint8 [1, height, width, 3] and the outputs pose "
            "[1, 7] or pose, lower, upper [1, 6], found "
            + ", ".join(
                f"{t.name} {t.dtype} {list(t.shape)}" for t in (*spec.inputs, *spec.outputs)
            )
        )
    if min(shape[1:3]) < _LEAST_INPUT:
        raise BundleMismatchError(
            f"model: expected an input of at least {_LEAST_INPUT}x{_LEAST_INPUT} pixels, found "
            f"{shape[2]}x{shape[1]}"
        )
    reference, limits, deviation = known_space(dataset.poses[split.roles["val"]])
    if rotation == "euler_zyx" or reference is None:
        reference, limits = None, _with_any_rotation(limits)
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
        ),
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


def _with_any_rotation(limits: PoseLimits) -> PoseLimits:
    """Keep the limits of the position; any rotation is plausible."""
    return PoseLimits(
        lowest=(*limits.lowest[:3], *(-_FULL_TURN,) * 3),
        highest=(*limits.highest[:3], *(_FULL_TURN,) * 3),
    )


def _with_wider_limits(draft: Draft, poses: Array) -> Draft:
    """Let a bundle's limits hold the poses (n, 7) of the new data, too."""
    pose = draft.pose
    if pose.reference_q_xyzw is None:
        coordinates = known_coordinates(poses, mean_rotation(poses[:, 3:]))
        found = _with_any_rotation(plausible(coordinates, FEW_POSES_MARGIN))
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
    scores = ("residual",) if len(draft.model.outputs) == 1 else ("normalised", "additive")
    return tuple(Candidate(score, parameters) for score in scores)
