"""Build the head of a calibration, and check ``calibration.json`` against its method."""

from __future__ import annotations

from cvo_edge.bundle.format import FAMILIARITY, Calibration, ModelSpec, Threshold
from cvo_edge.errors import BundleMismatchError, CalibrationFileError
from cvo_edge.heads import HEADS, Head

# Making scores comparable and mapping them back loses the last digits of a threshold.
_ROUNDING = 1e-9

_SIDES = ("q_hat", "q_hat_upper")


def checked_head(calibration: Calibration) -> Head:
    """Return the head of a calibration, after checking the calibration against the method.

    Raises
    ------
    BundleMismatchError
        The model does not have the tensors that the method needs.
    CalibrationFileError
        The method is unknown, its parameters are invalid, or a joint threshold is smaller than a
        marginal one.
    """
    if calibration.method not in HEADS:
        raise CalibrationFileError(
            f"method: expected one of {', '.join(HEADS)}, found {calibration.method}"
        )
    kind = HEADS[calibration.method]
    source = calibration.calibration
    head = kind(calibration.parameters(kind.parameters_type), source.score).scaled(
        calibration.difficulty
    )
    head.check(calibration.thresholds, source.joint)
    check_tensors(calibration.model, head)
    if head.solves and calibration.pose.rotation != "tangent_predicted":
        raise CalibrationFileError(
            f"pose.rotation: expected tangent_predicted for method {head.method}, found "
            f"{calibration.pose.rotation}"
        )
    if head.solves and calibration.camera is None:
        raise CalibrationFileError(
            f"camera: expected intrinsics for method {head.method}, found null"
        )
    if head.solves and head.difficulty is not None:
        raise CalibrationFileError(
            f"difficulty: expected null for method {head.method}, whose solver tells the errors of "
            "each frame, found weights"
        )
    if not head.one_joint_score:
        _check_joint(calibration.thresholds, head)
    return head


def check_tensors(model: ModelSpec, head: Head) -> None:
    """Raise BundleMismatchError if the model's inputs or outputs do not match the method."""
    # The image was checked before; all other inputs are float32.
    image = {spec.name: (spec.dtype, spec.shape) for spec in model.inputs if spec.name == "image"}
    extra = {name: ("float32", noise.shape) for name, noise in head.extra_inputs(0).items()}
    outputs = {name: ("float32", shape) for name, shape in head.outputs.items()}
    for kind, needed, specs in (
        ("inputs", image | extra, model.inputs),
        ("outputs", outputs, model.outputs),
    ):
        found = {spec.name: (spec.dtype, spec.shape) for spec in specs}
        if kind == "outputs" and found.keys() >= FAMILIARITY.keys():
            # Any graph may have these.
            needed = needed | {name: ("float32", shape) for name, shape in FAMILIARITY.items()}
        if found != needed:
            raise BundleMismatchError(
                f"model.{kind}: expected {needed} for method {head.method}, found {found}"
            )


def _check_joint(thresholds: tuple[Threshold, ...], head: Head) -> None:
    """Check that no joint threshold is smaller than a marginal one of at most the same level.

    A marginal threshold is a quantile of one side's scores. The joint threshold is the same
    quantile of the largest score, which is at least each single score.
    """
    marginal = [entry for entry in thresholds if entry.scope == "marginal"]
    for joint in (entry for entry in thresholds if entry.scope == "joint"):
        for number, side in enumerate(_SIDES[: len(head.side_confidences(joint.confidence))]):
            levels = [(head.side_confidences(m.confidence)[number], m) for m in marginal]
            below = [m for level, m in levels if level is not None and level <= _above(joint)]
            if below:
                # Thresholds grow with the confidence, as checked before: the last is the largest.
                _compare(side, joint, max(below, key=lambda m: m.confidence))


def _above(joint: Threshold) -> float:
    return joint.confidence + _ROUNDING


def _compare(side: str, joint: Threshold, marginal: Threshold) -> None:
    for dof, (large, small) in enumerate(
        zip(getattr(joint, side), getattr(marginal, side), strict=True)
    ):
        # None means unbounded, which exceeds every number.
        if large is None or (
            small is not None and large >= small - _ROUNDING * max(1.0, abs(small))
        ):
            continue
        raise CalibrationFileError(
            f"thresholds.{side}: expected scope joint at {joint.confidence:g} to be at least scope "
            f"marginal at {marginal.confidence:g}, found {large} and {small} at [{dof}]"
        )
