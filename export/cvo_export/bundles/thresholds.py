"""Run the exported model in the runtime, compute scores and derive thresholds.

Coverage then does not depend on the fidelity of the export: the graph that runs on the device,
8-bit or not, is the graph that was calibrated.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from cvo_edge.bundle.format import (
    CONFIDENCES,
    AlarmSpec,
    Calibration,
    Threshold,
    version_of,
)
from cvo_edge.conformal import (
    JointScale,
    capped_quantiles,
    conformal_quantiles,
    effective_sample_size,
    recording_cap,
)
from cvo_edge.engine.selftest import observe_selftest
from cvo_edge.errors import UsageError
from cvo_edge.heads import Candidate, Head
from cvo_edge.vocabulary import SCOPES, Joint, Rule, Scope
from cvo_export.bundles.alarm import fitted_alarm, with_copies
from cvo_export.bundles.choice import chosen, with_difficulty
from cvo_export.bundles.difficulty import degraded
from cvo_export.bundles.draft import SELFTEST_SIZE, Counts, Draft, images_of
from cvo_export.bundles.entries import entry_of, marginal_thresholds
from cvo_export.bundles.observed import Observed, Scored, in_order, observe
from cvo_export.bundles.quantiles import with_quantiles
from cvo_export.bundles.rule import left_out
from cvo_export.datasets import PoseDataset

Array = NDArray[np.float64]


def calibrated(
    draft: Draft,
    model_bytes: bytes,
    dataset: PoseDataset,
    roles: Mapping[str, NDArray[np.int64]],
    candidates: Sequence[Candidate],
    told: Callable[[Observed, Observed], None] | None = None,
) -> Calibration:
    """Calibrate a draft: run its model on val and cal, choose a score, compute thresholds.

    The val frames choose among the candidates (see ``chosen``), scale the degrees of freedom for
    the joint scope and, with noisy copies of them, decide on a difficulty (see
    ``with_difficulty``); the cal frames give the thresholds. ``told`` is called with what was
    observed on val and cal.

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
    images = images_of(draft, val.size, (val.coloured, cal.coloured))
    draft = dataclasses.replace(draft, images=images)
    if images.colour:
        val, cal = val.in_colour(), cal.in_colour()
    known, sequence = in_order(val, cal)
    candidates = [
        candidate._replace(
            parameters=draft.head(candidate).tuned(val.outputs, val.true_pose, known, sequence)
        )
        for candidate in candidates
    ]
    best = chosen(draft, val, candidates)
    head = draft.head(best)
    if head.solves:
        # What was tuned may have changed what the solver finds.
        with draft.observer(model_bytes, head) as observer:
            val = observe(observer, dataset, roles["val"])
            cal = observe(observer, dataset, roles["cal"])
    if told is not None:
        told(val, cal)
    alarm = None
    if val.judged is not None:
        with draft.observer(model_bytes, head) as observer:
            given = partial(observe, observer), dataset, draft.split
            copies = with_copies(*given, val), with_copies(*given, cal, whole=True)
            noisy = None if head.solves else degraded(*given, val.indices)
        alarm = fitted_alarm(draft.split.kind, *copies)
        if noisy is not None:
            draft = with_difficulty(draft, best, val, noisy)
            head = draft.head(best)
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
    found = Quantiles(head, cal, val, draft.rule, draft.joint, draft.cap)
    calibration = draft.calibrated(head, found.entries(), counts(cal), selftest, alarm)
    return with_quantiles(calibration, head, found.bounds)


def with_thresholds(
    calibration: Calibration, head: Head, val: Observed, cal: Observed
) -> Calibration:
    """Return a calibration with thresholds and counts from these observations.

    Rule, joint scope and score stay; val scales the degrees of freedom for the joint scope.
    """
    source, scored = calibration.calibration, cal.scored(head)
    rule = source.rule, source.joint, source.cap
    found = counts(scored)
    return replace(
        calibration,
        schema_version=version_of(calibration.preprocess, None),
        quantiles=None,
        thresholds=Quantiles(head, scored, val.scored(head), *rule).entries(),
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


@dataclass(frozen=True)
class Quantiles:
    """The thresholds that a rule gives for scores on cal, with val's scores for the joint scope.

    ``pooled`` counts frames; ``capped``, with its ``cap``, and ``hierarchical`` count recordings
    (see ``capped_quantile``); with too few of them a threshold is infinite. The joint scope ``max``
    uses each frame's largest score, after scaling that makes the degrees of freedom comparable on
    val; ``bonferroni`` uses six sets at a sixth of the miscoverage each. A method with one score
    for all six gets the same threshold six times.
    """

    head: Head
    cal: Scored
    val: Scored
    rule: Rule
    joint: Joint
    cap: float | None = None

    @cached_property
    def _scale(self) -> JointScale:
        return self.head.joint_scale(self.val.joint)

    @cached_property
    def _largest(self) -> Array:
        return np.asarray(self._scale.comparable(self.cal.joint)[:, self.used].max(axis=(1, 2)))

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which sides are bounded."""
        return np.array([level is not None for level in self.head.side_confidences(0.9)])

    def compared(self, scope: Scope) -> Array:
        """Return the scores (n, sides, 6) that the thresholds of a scope are compared with."""
        return self.cal.joint if scope == "joint" and self.joint == "max" else self.cal.marginal

    def bounds(
        self, confidences: Sequence[float], scope: Scope, rows: NDArray[np.bool_] | None = None
    ) -> Array:
        """Thresholds (m, sides, 6) at m confidences, from the scores of these rows (n,) or all."""
        rows = np.full(len(self._largest), True) if rows is None else rows
        counted = recording_cap(self.rule, self.cap)

        def q_hat(scores: Array, levels: Sequence[float]) -> Array:
            if counted is None:
                return conformal_quantiles(scores, levels)
            return capped_quantiles(scores, self.cal.sequence[rows], levels, counted)

        if scope == "joint" and self.joint == "max":
            together = np.full((len(confidences), *self.cal.joint.shape[1:]), np.inf)
            found = q_hat(self._largest[rows], confidences).tolist()
            together[:, self.used] = [self._scale.thresholds(q)[self.used] for q in found]
            return together
        if scope == "joint":
            confidences = [1.0 - (1.0 - each) / 6 for each in confidences]
        return marginal_thresholds(self.head, self.cal.marginal[rows], confidences, q_hat)

    def entries(self) -> tuple[Threshold, ...]:
        """Return the thresholds of both scopes at every confidence that is stored."""
        entries = []
        for confidence, scope in product(CONFIDENCES, SCOPES):

            def at(
                rows: NDArray[np.bool_] | None = None, level: float = confidence, of: Scope = scope
            ) -> Array:
                return np.asarray(self.bounds([level], of, rows)[0])

            left = left_out(self.compared(scope), self.cal.sequence, self.used, scope, at)
            entries.append(entry_of(confidence, scope, at(), left))
        return tuple(entries)


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
