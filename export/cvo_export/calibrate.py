"""Scores by running the exported model through the runtime -> thresholds.

Coverage then depends on no fidelity of the export: whatever the graph computes (8-bit included) is
what was calibrated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cvo_edge.artifact import CONFIDENCES, SixOrUnbounded, Threshold
from cvo_edge.conformal import (
    conformal_quantile,
    effective_sample_size,
    hierarchical_quantile,
    joint_scores,
)
from cvo_edge.errors import SourceError
from cvo_edge.odometer import Observation, Odometer
from cvo_export.datasets import PoseDataset

Array = NDArray[np.float64]
Rule = Literal["pooled", "hierarchical"]

# The joint scope compares degrees of freedom by this quantile of their scores on val.
_SCALE_LEVEL = 0.9
_LEAST_SCALE = 1e-6


@dataclass(frozen=True)
class Observed:
    """Frames that passed the frame checks, as the runtime sees them, stacked over n frames.

    ``outputs`` by name (n, ...); ``point`` (n, 6) and ``truth`` (n, 6) in the bundle's chart;
    ``pose`` (n, 7) and ``true_pose`` (n, 7); ``sequence`` (n,) the sequence number; ``flagged``
    counts frames that a check left out.
    """

    indices: NDArray[np.int64]
    outputs: dict[str, NDArray[np.float32]]
    point: Array
    truth: Array
    pose: Array
    true_pose: Array
    sequence: NDArray[np.int64]
    flagged: int


def observe(odometer: Odometer, dataset: PoseDataset, indices: NDArray[np.int64]) -> Observed:
    """Run frames of a data set through the odometer's network, in order.

    Raises SourceError where no frame passes the checks.
    """
    kept: list[int] = []
    seen: list[Observation] = []
    for index in indices.tolist():
        try:
            image = dataset.read_image(index)
        except SourceError:
            image = None  # the odometer flags it as it would on the device
        observation = odometer.observe(image, seq=index)
        if observation.fault is None:
            kept.append(index)
            seen.append(observation)
    if not seen:
        raise SourceError(
            f"{dataset.name}: expected frames that pass the checks, found none of {len(indices)}"
        )
    pose = np.array([observation.pose for observation in seen])
    true_pose = dataset.poses[kept]
    return Observed(
        indices=np.array(kept),
        outputs={
            name: np.concatenate([observation.outputs[name] for observation in seen])
            for name in seen[0].outputs
        },
        point=np.array([observation.point for observation in seen]),
        truth=odometer.chart.coordinates(true_pose, pose),
        pose=pose,
        true_pose=true_pose,
        sequence=dataset.sequence[kept],
        flagged=len(indices) - len(seen),
    )


def thresholds(
    cal_scores: Array,
    cal_sequence: NDArray[np.int64],
    val_scores: Array,
    rule: Rule,
) -> tuple[Threshold, ...]:
    """Both scopes at every confidence, from scores (n, 6) on cal; val gives the joint scales.

    ``pooled`` counts frames, ``hierarchical`` sequences; what too few of them cannot support is
    unbounded (null).
    """

    def q_hat(scores: Array, confidence: float) -> float:
        if rule == "hierarchical":
            return hierarchical_quantile(scores, cal_sequence, confidence)
        return conformal_quantile(scores, confidence)

    scales = joint_scales(val_scores)
    joint = joint_scores(cal_scores, scales)
    found = []
    for confidence in CONFIDENCES:
        marginal = [q_hat(cal_scores[:, dof], confidence) for dof in range(6)]
        found.append(_threshold(confidence, "marginal", np.array(marginal)))
        found.append(_threshold(confidence, "joint", scales * q_hat(joint, confidence)))
    return tuple(found)


def joint_scales(val_scores: Array) -> Array:
    """m_d, shape (6,): the 90 % quantile of |score| of each DoF on val, at least 1e-6."""
    scales = np.quantile(np.abs(val_scores), _SCALE_LEVEL, axis=0)
    return np.asarray(np.maximum(scales, _LEAST_SCALE))


def effective_frames(cal_scores: Array, cal_sequence: NDArray[np.int64]) -> float:
    """Independent frames that the calibration set is worth: the least over the six DoF.

    Summed over sequences, which are independent of each other.
    """
    return min(
        sum(
            effective_sample_size(cal_scores[cal_sequence == number, dof])
            for number in np.unique(cal_sequence)
        )
        for dof in range(6)
    )


def _threshold(confidence: float, scope: Literal["marginal", "joint"], values: Array) -> Threshold:
    six = tuple(float(value) if np.isfinite(value) else None for value in values)
    q_hat: SixOrUnbounded = (six[0], six[1], six[2], six[3], six[4], six[5])
    return Threshold(confidence=confidence, scope=scope, q_hat=q_hat, q_hat_upper=None)
