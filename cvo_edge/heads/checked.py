"""Building the head of a calibration, and the rules between ``calibration.json`` and its method."""

from __future__ import annotations

from cvo_edge.bundle.format import Calibration, ModelSpec, Threshold
from cvo_edge.errors import BundleMismatchError, CalibrationFileError
from cvo_edge.heads import HEADS, Head

# Thresholds are stored with all digits; comparing scores and back again costs the last ones.
_ROUNDING = 1e-9

_SIDES = ("q_hat", "q_hat_upper")


def checked_head(calibration: Calibration) -> Head:
    """Return the head of a calibration, after checking what the method says about its numbers.

    Raises
    ------
    BundleMismatchError
        The model does not have the tensors that the method works with.
    CalibrationFileError
        There is no such method, its parameters do not fit it, or a threshold of the joint scope is
        smaller than it can be.
    """
    if calibration.method not in HEADS:
        raise CalibrationFileError(
            f"method: expected one of {', '.join(HEADS)}, found {calibration.method}"
        )
    kind = HEADS[calibration.method]
    source = calibration.calibration
    head = kind(calibration.parameters(kind.parameters_type), source.score)
    head.check(calibration.thresholds, source.joint)
    check_tensors(calibration.model, head)
    if not head.one_joint_score:
        _check_joint(calibration.thresholds, head)
    return head


def check_tensors(model: ModelSpec, head: Head) -> None:
    """Raise BundleMismatchError where a model has other inputs or outputs than its method."""
    # The image alone is of bytes, as was checked.
    image = {spec.name: (spec.dtype, spec.shape) for spec in model.inputs if spec.name == "image"}
    extra = {name: ("float32", noise.shape) for name, noise in head.extra_inputs(0).items()}
    outputs = {name: ("float32", shape) for name, shape in head.outputs.items()}
    for kind, needed, specs in (
        ("inputs", image | extra, model.inputs),
        ("outputs", outputs, model.outputs),
    ):
        found = {spec.name: (spec.dtype, spec.shape) for spec in specs}
        if found != needed:
            raise BundleMismatchError(
                f"model.{kind}: expected {needed} for method {head.method}, found {found}"
            )


def _check_joint(thresholds: tuple[Threshold, ...], head: Head) -> None:
    """All six together hold with a confidence: so does each of them, with no smaller threshold.

    A side's own threshold at a level is the level's quantile of its scores; the joint one is at
    least that of the same level, as the largest of all scores is at least each of them.
    """
    marginal = [entry for entry in thresholds if entry.scope == "marginal"]
    for joint in (entry for entry in thresholds if entry.scope == "joint"):
        for number, side in enumerate(_SIDES[: len(head.side_confidences(joint.confidence))]):
            levels = [(head.side_confidences(m.confidence)[number], m) for m in marginal]
            below = [m for level, m in levels if level is not None and level <= _above(joint)]
            if below:
                # They grow with the confidence, as was checked: the last one is the largest.
                _compare(side, joint, max(below, key=lambda m: m.confidence))


def _above(joint: Threshold) -> float:
    return joint.confidence + _ROUNDING


def _compare(side: str, joint: Threshold, marginal: Threshold) -> None:
    for dof, (large, small) in enumerate(
        zip(getattr(joint, side), getattr(marginal, side), strict=True)
    ):
        # None is unbounded, the largest of all.
        if large is None or (
            small is not None and large >= small - _ROUNDING * max(1.0, abs(small))
        ):
            continue
        raise CalibrationFileError(
            f"thresholds.{side}: expected in scope joint at {joint.confidence:g} at least that of "
            f"scope marginal at {marginal.confidence:g}, found {large} and {small} at [{dof}]"
        )
