"""Run the exported model in the runtime, compute scores and derive thresholds.

Coverage then does not depend on the fidelity of the export: the graph that runs on the device,
8-bit or not, is the graph that was calibrated.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from cvo_edge.bundle.format import (
    CONFIDENCES,
    AlarmSpec,
    Calibration,
    LeftOut,
    PoseSpec,
    SixOrUnbounded,
    Threshold,
)
from cvo_edge.conformal import (
    capped_quantile,
    conformal_quantile,
    effective_sample_size,
    interval_score,
    recording_cap,
)
from cvo_edge.engine.observation import Observation, Observer
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.heads import Candidate, Head
from cvo_edge.input.image_checks import has_colour
from cvo_edge.odometer import Odometer
from cvo_edge.pose import about
from cvo_edge.programs.selftest import observe_selftest
from cvo_edge.sets import ConformalSet
from cvo_edge.vocabulary import SCOPES, Joint, Rule, Scope
from cvo_export.bundles.alarm import fitted_alarm, tells, with_copies
from cvo_export.bundles.draft import SELFTEST_SIZE, Counts, Draft, images_of
from cvo_export.bundles.rule import left_out
from cvo_export.datasets import PoseDataset

Array = NDArray[np.float64]


# Margin by which another score must win on val; smaller differences may be chance.
_CLEARLY = 0.05


class Scored(NamedTuple):
    """Scores of n frames per scope, (n, sides, 6), and the frames' sequence numbers (n,)."""

    marginal: Array
    joint: Array
    sequence: NDArray[np.int64]


@dataclass(frozen=True)
class Observed:
    """The runtime's results for the n frames that passed the frame checks, stacked.

    ``outputs`` (n, ...) are the network's outputs by name; ``point`` and ``truth`` (n, 6) are in
    the bundle's chart; ``pose`` and ``true_pose`` are (n, 7); all positions are relative to the
    bundle's origin. ``sequence`` (n,) holds sequence numbers; ``coloured`` (n,) tells which images
    have colour; ``size`` is width and height of the first image; ``invalid`` and ``degraded``
    count the frames that the checks excluded.
    """

    indices: NDArray[np.int64]
    outputs: dict[str, NDArray[np.float32]]
    point: Array
    truth: Array
    pose: Array
    true_pose: Array
    sequence: NDArray[np.int64]
    coloured: NDArray[np.bool_]
    size: tuple[int, int]
    invalid: int
    degraded: int

    def where(self, rows: NDArray[np.bool_]) -> Observed:
        """Return the frames that a mask (n,) chooses; counts of excluded frames stay."""
        chosen = {
            name: getattr(self, name)[rows]
            for name in ("indices", "point", "truth", "pose", "true_pose", "sequence", "coloured")
        }
        outputs = {name: values[rows] for name, values in self.outputs.items()}
        return dataclasses.replace(self, outputs=outputs, **chosen)

    def scored(self, head: Head) -> Scored:
        """Return the scores of the true poses."""
        marginal, joint = (
            head.scores(self.outputs, self.point, self.truth, scope) for scope in SCOPES
        )
        return Scored(marginal, joint, self.sequence)

    def sets(self, head: Head, entry: Threshold) -> list[ConformalSet]:
        """Return the set of every frame at one threshold entry."""
        return [
            head.conformal_set(
                {name: values[row : row + 1] for name, values in self.outputs.items()},
                point,
                entry,
            )
            for row, point in enumerate(self.point)
        ]


def observe(
    observer: Observer | Odometer, dataset: PoseDataset, indices: NDArray[np.int64]
) -> Observed:
    """Run frames of a data set through a network, in order.

    Raises SourceError if no frame passes the checks.
    """
    kept: list[int] = []
    seen: list[Observation] = []
    reasons: Counter[str] = Counter()
    invalid = degraded = 0
    for index in indices.tolist():
        try:
            image = dataset.read_image(index)
        except SourceError:
            image = None  # flagged as invalid, as on the device
        observation = observer.observe(image, seq=index)
        problem = observation.fault or observation.doubt
        if problem is None:
            kept.append(index)
            seen.append(observation)
            continue
        reasons[problem] += 1
        invalid += observation.fault is not None
        degraded += observation.fault is None
    if not seen:
        found = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
        raise SourceError(
            f"{dataset.name}: expected frames that pass the frame checks, found none of "
            f"{len(indices)}: {found}"
        )
    pose = np.array([observation.pose for observation in seen])
    looks = [observation.look for observation in seen if observation.look is not None]
    true_pose = about(dataset.poses[kept], observer.origin_m)
    return Observed(
        indices=np.array(kept),
        outputs={
            name: np.concatenate([observation.outputs[name] for observation in seen])
            for name in seen[0].outputs
        },
        point=np.array([observation.point for observation in seen]),
        truth=observer.chart.coordinates(true_pose, pose),
        pose=pose,
        true_pose=true_pose,
        sequence=dataset.sequence[kept],
        coloured=np.array([has_colour(look) for look in looks]),
        size=(looks[0].size[1], looks[0].size[0]),
        invalid=invalid,
        degraded=degraded,
    )


def calibrated(
    draft: Draft,
    model_bytes: bytes,
    dataset: PoseDataset,
    roles: Mapping[str, NDArray[np.int64]],
    candidates: Sequence[Candidate],
) -> Calibration:
    """Calibrate a draft: run its model on val and cal, choose a score, compute thresholds.

    The val frames choose among the candidates (see ``chosen``) and scale the degrees of freedom
    for the joint scope; the cal frames give the thresholds.

    Raises
    ------
    BundleMismatchError, CalibrationFileError
        The model or a candidate does not fit the draft's method.
    SourceError
        No frame of val or cal passes the checks.
    UsageError
        Bonferroni's joint scope with a method that has one score for all six degrees of freedom.
    """
    first = first_head(draft, candidates)
    with draft.observer(model_bytes, first) as observer:
        val = observe(observer, dataset, roles["val"])
        cal = observe(observer, dataset, roles["cal"])
    images = images_of(draft.camera, val.size, (val.coloured, cal.coloured))
    draft = dataclasses.replace(draft, images=images)
    if images.colour:
        val, cal = val.where(val.coloured), cal.where(cal.coloured)
    known, sequence = in_order(val, cal)
    candidates = [
        candidate._replace(
            parameters=draft.head(candidate).tuned(val.outputs, val.true_pose, known, sequence)
        )
        for candidate in candidates
    ]
    head = draft.head(chosen(draft, val, candidates))
    if head.solves:
        # What was tuned may have changed what the solver finds.
        with draft.observer(model_bytes, head) as observer:
            val = observe(observer, dataset, roles["val"])
            cal = observe(observer, dataset, roles["cal"])
    alarm = None
    if tells(val):
        with draft.observer(model_bytes, head) as observer:
            given = partial(observe, observer), dataset, draft.split
            copies = with_copies(*given, val), with_copies(*given, cal, whole=True)
        alarm = fitted_alarm(draft.split.kind, *copies)
    return completed(draft, model_bytes, head, cal.scored(head), val.scored(head), alarm)


def first_head(draft: Draft, candidates: Sequence[Candidate]) -> Head:
    """Return the head of the first candidate; raises as ``calibrated``."""
    first = draft.head(candidates[0])
    if draft.joint == "bonferroni" and first.one_joint_score:
        raise UsageError(
            f"joint: expected max for {draft.method}, which has one score for all six degrees of "
            "freedom, found bonferroni"
        )
    return first


def completed(
    draft: Draft,
    model_bytes: bytes,
    head: Head,
    cal: Scored,
    val: Scored,
    alarm: AlarmSpec | None,
) -> Calibration:
    """Return the calibration of a chosen head from scores of cal and val, with its self-test."""
    with draft.observer(model_bytes, head, stated=True) as observer:
        outputs = observe_selftest(observer, *SELFTEST_SIZE).outputs
    selftest = {
        spec.name: tuple(float(f"{value:.9g}") for value in outputs[spec.name].reshape(-1).tolist())
        for spec in draft.model.outputs
    }
    found = thresholds(head, cal, val, draft.rule, draft.joint, draft.cap)
    return draft.calibrated(head, found, counts(cal), selftest, alarm)


def in_order(*observed: Observed) -> tuple[dict[str, NDArray[Any]], NDArray[np.int64]]:
    """Return outputs and sequence numbers of several roles, stacked in the data set's order."""
    order = np.argsort(np.concatenate([each.indices for each in observed]))
    outputs = {
        name: np.concatenate([each.outputs[name] for each in observed])[order]
        for name in observed[0].outputs
    }
    return outputs, np.concatenate([each.sequence for each in observed])[order]


def with_thresholds(
    calibration: Calibration, head: Head, val: Observed, cal: Observed
) -> Calibration:
    """Return a calibration with thresholds and counts from these observations.

    Rule, joint scope and score stay; val scales the degrees of freedom for the joint scope.
    """
    source, scored = calibration.calibration, cal.scored(head)
    found = counts(scored)
    return replace(
        calibration,
        thresholds=thresholds(
            head, scored, val.scored(head), source.rule, source.joint, source.cap
        ),
        calibration=replace(
            source,
            n=found.frames,
            n_sequences=found.sequences,
            n_effective=found.effective,
        ),
    )


def counts(cal: Scored) -> Counts:
    """Count the frames, sequences and effective frames behind calibration scores."""
    return Counts(
        frames=len(cal.sequence),
        sequences=len(np.unique(cal.sequence)),
        effective=round(effective_frames(cal), 1),
    )


def chosen(draft: Draft, val: Observed, candidates: Sequence[Candidate]) -> Candidate:
    """Return the candidate to use: the first, unless another is clearly better on val.

    Candidates are compared by the interval score at 0.9 over each DoF's standard deviation, with
    thresholds from val itself; val is too small to separate closer candidates.
    """
    results = []
    for candidate in candidates:
        head = draft.head(candidate)
        scores = head.scores(val.outputs, val.point, val.truth)
        entry = _threshold(0.9, "marginal", marginal_thresholds(head, scores, 0.9, _pooled))
        limits = workspace(draft.pose)
        sets = [each.within(*limits) for each in val.sets(head, entry)]
        width = np.array([each.width() for each in sets])
        distance = np.array([each.distance(y) for each, y in zip(sets, val.truth, strict=True)])
        deviation = np.array(draft.pose.standard_deviation)
        results.append(float((interval_score(width, distance, 0.1) / deviation).mean()))
    best = int(np.argmin(results))
    return candidates[best if results[best] < (1.0 - _CLEARLY) * results[0] else 0]


def workspace(pose: PoseSpec) -> tuple[Array, Array]:
    """Return the lowest and highest value per DoF, (6,) each, that replace unbounded sides."""
    limits = pose.limits
    lowest, highest = np.array(limits.lowest), np.array(limits.highest)
    if pose.rotation == "tangent_predicted":
        # Offsets from the prediction: at most half a turn.
        lowest[3:], highest[3:] = -np.pi, np.pi
    return lowest, highest


def thresholds(
    head: Head, cal: Scored, val: Scored, rule: Rule, joint: Joint, cap: float | None = None
) -> tuple[Threshold, ...]:
    """Return the thresholds of both scopes at every confidence, from scores on cal.

    ``pooled`` counts frames; ``capped``, with its ``cap``, and ``hierarchical`` count recordings
    (see ``capped_quantile``); with too few of them a threshold is unbounded (null). The joint scope
    ``max`` uses each frame's largest score, after scaling that makes the degrees of freedom
    comparable on val; ``bonferroni`` uses six sets at a sixth of the miscoverage each. A method
    with one score for all six gets the same threshold six times.
    """
    counted, used, scale = recording_cap(rule, cap), _used_sides(head), head.joint_scale(val.joint)
    largest = scale.comparable(cal.joint)[:, used].max(axis=(1, 2))

    def found(confidence: float, scope: Scope, rows: NDArray[np.bool_]) -> Array:
        """Thresholds (sides, 6) from the scores of these rows (n,)."""

        def q_hat(scores: Array, level: float) -> float:
            if counted is None:
                return conformal_quantile(scores, level)
            return capped_quantile(scores, cal.sequence[rows], level, counted)

        if scope == "joint" and joint == "max":
            together = np.full(cal.joint.shape[1:], np.inf)
            together[used] = scale.thresholds(q_hat(largest[rows], confidence))[used]
            return together
        each = confidence if scope == "marginal" else 1.0 - (1.0 - confidence) / 6
        return marginal_thresholds(head, cal.marginal[rows], each, q_hat)

    entries = []
    for confidence, scope in product(CONFIDENCES, SCOPES):
        at = partial(found, confidence, scope)
        compared = cal.joint if scope == "joint" and joint == "max" else cal.marginal
        left = left_out(compared, cal.sequence, used, scope, at)
        entries.append(_threshold(confidence, scope, at(np.full(len(largest), True)), left))
    return tuple(entries)


def marginal_thresholds(
    head: Head, scores: Array, confidence: float, q_hat: Callable[[Array, float], float]
) -> Array:
    """Return thresholds (sides, 6) from scores (n, sides, 6); infinite where unbounded."""
    found = np.full(scores.shape[1:], np.inf)
    for side, level in enumerate(head.side_confidences(confidence)):
        if level is not None:
            found[side] = [q_hat(scores[:, side, dof], level) for dof in range(6)]
    return found


def effective_frames(scored: Scored) -> float:
    """Return the effective sample size of marginal scores: the least over all columns.

    Sizes are summed over sequences, which are independent of each other. An infinite score counts
    as the largest finite one.
    """
    columns = [
        np.minimum(column, column[np.isfinite(column)].max(initial=0.0))
        for column in scored.marginal.reshape(len(scored.marginal), -1).T
    ]
    sequence = scored.sequence
    return min(
        sum(effective_sample_size(column[sequence == number]) for number in np.unique(sequence))
        for column in columns
    )


def _used_sides(head: Head) -> NDArray[np.bool_]:
    return np.array([level is not None for level in head.side_confidences(0.9)])


def _pooled(scores: Array, confidence: float) -> float:
    return conformal_quantile(scores, confidence)


def _threshold(
    confidence: float, scope: Scope, values: Array, left: LeftOut | None = None
) -> Threshold:
    """Convert thresholds (sides, 6), infinite where unbounded, to a stored entry."""
    sides = [_six_or_unbounded(row) for row in values]
    return Threshold(
        confidence=confidence,
        scope=scope,
        q_hat=sides[0],
        q_hat_upper=sides[1] if len(sides) == 2 else None,
        left_out=left,
    )


def _six_or_unbounded(values: Array) -> SixOrUnbounded:
    a, b, c, d, e, f = (float(value) if np.isfinite(value) else None for value in values)
    return (a, b, c, d, e, f)
