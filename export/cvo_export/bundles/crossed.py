"""Crossed calibration: scores of each fold of recordings from a network trained without it.

As in cross-conformal prediction (Vovk 2015, https://arxiv.org/abs/1208.0806) and the jackknife+
(Barber et al. 2021, https://arxiv.org/abs/1905.02928), every recording trains and calibrates. Their
sets are made with all networks, and so are those for which CV-CRC (Cohen et al. 2024,
https://arxiv.org/abs/2401.11974) proves a bound. Here the device runs one network, trained on all
recordings: its coverage is measured, not proven.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration, DifficultySpec
from cvo_edge.heads import Candidate
from cvo_export.bundles.alarm import Pair, fitted_alarm, together, with_copies
from cvo_export.bundles.choice import chosen, with_difficulty
from cvo_export.bundles.difficulty import degraded
from cvo_export.bundles.draft import Draft, images_of
from cvo_export.bundles.observed import Observed, Scored, observe
from cvo_export.bundles.thresholds import completed, first_head
from cvo_export.datasets import PoseDataset

Indices = NDArray[np.int64]


class Fold(NamedTuple):
    """A network trained without some recordings, its candidates, and these recordings' frames."""

    draft: Draft
    model_bytes: bytes
    candidates: Sequence[Candidate]
    indices: Indices

    def observed(self, dataset: PoseDataset) -> Observed:
        """Run the fold's frames through its network; raises SourceError if none passes."""
        first = self.draft.head(self.candidates[0])
        with self.draft.observer(self.model_bytes, first) as observer:
            return observe(observer, dataset, self.indices)

    def copied(self, dataset: PoseDataset, seen: Observed, number: int) -> Pair:
        """Return the statistics of observed frames and of their copies, for the alarm."""
        head = self.draft.head(self.candidates[number])
        with self.draft.observer(self.model_bytes, head) as observer:
            see = partial(observe, observer)
            return with_copies(see, dataset, self.draft.split, seen, whole=True)

    def scored(self, seen: Observed, number: int, difficulty: DifficultySpec | None) -> Scored:
        """Return the scores of observed frames by the candidate of this number.

        ``difficulty`` is that of the bundle, for the statistics of the fold's own graph.
        """
        return seen.scored(self.draft.head(self.candidates[number]).scaled(difficulty))


def calibrated_crossed(
    draft: Draft,
    model_bytes: bytes,
    dataset: PoseDataset,
    val_indices: Indices,
    candidates: Sequence[Candidate],
    folds: Sequence[Fold],
) -> Calibration:
    """Calibrate a draft with the scores of all folds together; raises as ``calibrated``.

    The frames of val choose the score, by its number among the candidates, and scale the degrees of
    freedom for the joint scope; both are those of the draft's own network.
    """
    with draft.observer(model_bytes, first_head(draft, candidates)) as observer:
        val = observe(observer, dataset, val_indices)
    seen = [fold.observed(dataset) for fold in folds]
    images = images_of(draft, val.size, [each.coloured for each in (val, *seen)])
    draft = replace(draft, images=images)
    if images.colour:
        val, *seen = (each.in_colour() for each in (val, *seen))
    best = chosen(draft, val, candidates)
    number = [candidate is best for candidate in candidates].index(True)
    head = draft.head(best)
    alarm = None
    if val.judged is not None:
        with draft.observer(model_bytes, head) as observer:
            given = partial(observe, observer), dataset, draft.split
            known = with_copies(*given, val)
            noisy = None if head.solves else degraded(*given, val.indices)
        if noisy is not None:
            draft = with_difficulty(draft, best, val, noisy)
            head = draft.head(best)
        left_out = [
            fold.copied(dataset, each, number) for fold, each in zip(folds, seen, strict=True)
        ]
        alarm = fitted_alarm(draft.split.kind, known, together(left_out))
    scores = [
        fold.scored(each, number, draft.difficulty) for fold, each in zip(folds, seen, strict=True)
    ]
    cal = Scored(*(np.concatenate(parts) for parts in zip(*scores, strict=True)))
    return completed(draft, model_bytes, head, cal, val.scored(head), alarm)
