"""Consistency rules between the keys of ``calibration.json``."""

from __future__ import annotations

import math
from itertools import pairwise

from cvo_edge.bundle.format import (
    CONFIDENCES,
    FAMILIARITY,
    Calibration,
    SixOrUnbounded,
    TensorSpec,
    Threshold,
    version_of,
)
from cvo_edge.bundle.quantiles import check_quantiles
from cvo_edge.documents import shown
from cvo_edge.errors import CalibrationFileError, UsageError


def check_rules(calibration: Calibration) -> None:
    """Raise CalibrationFileError, naming the key and the rule, if keys contradict each other."""
    pose = calibration.pose
    given = pose.reference_q_xyzw is not None
    # tangent_predicted needs no reference itself, but the pose limits may.
    if pose.rotation != "tangent_predicted" and given != (pose.rotation == "tangent_reference"):
        raise CalibrationFileError(
            "pose.reference_q_xyzw: expected a quaternion with tangent_reference and null with "
            f"euler_zyx, found {shown(pose.reference_q_xyzw)} with {pose.rotation}"
        )
    if pose.reference_q_xyzw is not None:
        norm = math.sqrt(sum(component**2 for component in pose.reference_q_xyzw))
        if abs(norm - 1.0) > 1e-6:
            raise CalibrationFileError(
                f"pose.reference_q_xyzw: expected norm 1 within 1e-6, found {norm:.9g}"
            )
    for index, (low, high) in enumerate(zip(pose.limits.lowest, pose.limits.highest, strict=True)):
        if not low < high:
            raise CalibrationFileError(
                f"pose.limits: expected lowest < highest, found {low} and {high} at [{index}]"
            )
    source = calibration.calibration
    if (source.cap is not None) != (source.rule == "capped"):
        raise CalibrationFileError(
            "calibration.cap: expected a number with the rule capped and null with the others, "
            f"found {'null' if source.cap is None else shown(source.cap)} with {source.rule}"
        )
    if source.n_sequences < 2 and any(entry.left_out for entry in calibration.thresholds):
        raise CalibrationFileError(
            "thresholds.left_out: expected null with a single calibration recording, found a "
            "coverage"
        )
    _check_version(calibration)
    _check_thresholds(calibration.thresholds)
    check_quantiles(calibration)
    _check_crossed(calibration)
    _check_model(calibration)
    _check_images(calibration)
    _check_statistics(calibration)


def _check_crossed(calibration: Calibration) -> None:
    """Check that folds of recordings are possible, and that the provenance tells of them.

    The provenance outlives the calibration: it keeps later ones from using the same recordings.
    """
    source, provenance = calibration.calibration, calibration.provenance
    if source.crossed is None:
        return
    if source.crossed > source.n_sequences:
        raise CalibrationFileError(
            f"calibration.crossed: expected at most one fold for each of the {source.n_sequences} "
            f"sequences, found {source.crossed}"
        )
    if source.split != provenance.training_split or source.split.kind != "sequence":
        raise CalibrationFileError(
            "calibration.crossed: expected the split by sequence that the network was trained on, "
            f"found {shown(source.split.kind)} of {source.dataset}"
        )
    if provenance.options.get("folds") != source.crossed:
        raise CalibrationFileError(
            f"calibration.crossed: expected provenance.options.folds {source.crossed}, found "
            f"{shown(provenance.options.get('folds'))}"
        )


def _check_thresholds(thresholds: tuple[Threshold, ...]) -> None:
    for scope in ("marginal", "joint"):
        stored = [entry.confidence for entry in thresholds if entry.scope == scope]
        missing = [c for c in CONFIDENCES if not any(abs(c - found) < 1e-9 for found in stored)]
        if missing:
            raise CalibrationFileError(
                f"thresholds: expected {', '.join(map(str, CONFIDENCES))} for scope {scope}, "
                f"missing {', '.join(map(str, missing))}"
            )
        entries = sorted(
            (entry for entry in thresholds if entry.scope == scope), key=lambda e: e.confidence
        )
        for before, after in pairwise(entries):
            if after.confidence - before.confidence < 1e-9:
                raise CalibrationFileError(
                    f"thresholds: expected each confidence once per scope, found "
                    f"{after.confidence} ({scope}) twice"
                )
            for side in ("q_hat", "q_hat_upper"):
                _check_monotone(getattr(before, side), getattr(after, side), side, after, scope)


def _check_monotone(
    smaller: SixOrUnbounded | None,
    larger: SixOrUnbounded | None,
    side: str,
    entry: Threshold,
    scope: str,
) -> None:
    if smaller is None or larger is None:
        if smaller is not larger:
            raise CalibrationFileError(
                f"thresholds.{side}: expected null in all thresholds of scope {scope} or in none"
            )
        return
    for index, (low, high) in enumerate(zip(smaller, larger, strict=True)):
        # None means unbounded, which exceeds every number.
        if high is not None and (low is None or low > high):
            raise CalibrationFileError(
                f"thresholds.{side}: expected values that grow with the confidence, found {low} "
                f"before {high} at [{index}], confidence {entry.confidence}, {scope}"
            )


def _check_model(calibration: Calibration) -> None:
    model, preprocess = calibration.model, calibration.preprocess
    image = TensorSpec(
        name="image", dtype="uint8", shape=(1, preprocess.height, preprocess.width, 3)
    )
    if image not in model.inputs:
        raise CalibrationFileError(
            f"model.inputs: expected image uint8 {list(image.shape)} (from preprocess), found "
            + shown([(spec.name, spec.dtype, list(spec.shape)) for spec in model.inputs])
        )
    for tensors in (model.inputs, model.outputs):
        names = [spec.name for spec in tensors]
        if len(set(names)) != len(names):
            raise CalibrationFileError(f"model: expected unique tensor names, found {shown(names)}")
    sizes = {spec.name: math.prod(spec.shape) for spec in model.outputs}
    given = {name: len(values) for name, values in calibration.selftest.outputs.items()}
    if sizes != given:
        raise CalibrationFileError(
            f"selftest.outputs: expected one value per element of model.outputs {shown(sizes)}, "
            f"found {shown(given)}"
        )


def _check_version(calibration: Calibration) -> None:
    expected = version_of(calibration.preprocess, calibration.quantiles)
    if calibration.schema_version != expected:
        kind = {1: "without quantiles", 2: "with quantiles", 3: "that decodes at half size"}
        raise CalibrationFileError(
            f"schema_version: expected {expected} for a bundle {kind[expected]}, found "
            f"{calibration.schema_version}"
        )


def _check_images(calibration: Calibration) -> None:
    images, camera = calibration.images, calibration.camera
    if calibration.preprocess.decode == "half":
        if images is None:
            raise CalibrationFileError("images: expected a size with decode half, found null")
        try:
            calibration.preprocess.check_halves(images.height, images.width)
        except UsageError as error:
            raise CalibrationFileError(f"preprocess.{error}") from None
    if images is None or camera is None:
        return
    if (images.width, images.height) != (camera.width, camera.height):
        raise CalibrationFileError(
            f"images: expected the size of camera, {camera.width}x{camera.height}, found "
            f"{images.width}x{images.height}"
        )


def _check_statistics(calibration: Calibration) -> None:
    """Check that the model tells what is needed, and how many recordings there were."""
    tells = {spec.name for spec in calibration.model.outputs} >= FAMILIARITY.keys()
    for key, found in (("alarm", "limits"), ("difficulty", "weights")):
        if getattr(calibration, key) is not None and not tells:
            raise CalibrationFileError(
                f"{key}: expected null for a model without outputs novelty and degradation, found "
                f"{found}"
            )
    alarm = calibration.alarm
    if alarm is None or alarm.recordings is None:
        return
    if alarm.kind != "recordings" or len(alarm.recordings) != alarm.n:
        raise CalibrationFileError(
            f"alarm.recordings: expected one number for each of the {alarm.n} recordings, and null "
            f"for single frames; found {len(alarm.recordings)} with {alarm.kind}"
        )
