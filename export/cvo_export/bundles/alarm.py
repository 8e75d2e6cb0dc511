"""The limits of a bundle's alarm, from known frames; see ``cvo_edge.monitor.alarm``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from cvo_edge.bundle.format import (
    DEGRADATION_OUTPUT,
    NOVELTY_OUTPUT,
    STATISTICS,
    AlarmSpec,
    Five,
    SplitSpec,
)
from cvo_edge.errors import UsageError
from cvo_edge.estimate import recorded_novelty
from cvo_edge.monitor.alarm import Running, StreamAlarm, rank
from cvo_edge.monitor.martingale import mean_novelty
from cvo_edge.vocabulary import SplitKind
from cvo_export.bundles.observed import Observed
from cvo_export.data.harmless import harmlessly_changed
from cvo_export.datasets import PoseDataset

Array = NDArray[np.float64]

# Frames that are also looked at with a harmless change, unless whole recordings are needed.
_CHANGED_FRAMES = 250
# Scales are the distance from the median to this quantile: only larger values are of interest.
_HIGH, _LEAST = 0.9, 1e-6
_LEAST_LIMIT = 0.5
# Share of frames with a harmless change that stay within the limit.
_COPIES = 0.98


class Statistics(NamedTuple):
    """The statistics (n, 5) of frames in order, and the numbers (n,) of their recordings."""

    values: Array
    sequence: NDArray[np.int64]


# Of frames as they are, and of copies with harmless changes.
Pair = tuple[Statistics, Statistics]


def with_copies(
    see: Callable[[PoseDataset, NDArray[np.int64]], Observed],
    dataset: PoseDataset,
    split: SplitSpec,
    known: Observed,
    *,
    whole: bool = False,
) -> Pair:
    """Return the statistics of known frames, and of copies of them with harmless changes.

    ``see`` runs frames of a data set through the graph. Some frames have copies; with ``whole`` and
    a split by sequence, all.
    """
    by_recording = split.kind == "sequence"
    unit = dataset.sequence if by_recording else np.arange(len(dataset))
    count = len(known.indices)
    most = count if whole and by_recording else min(_CHANGED_FRAMES, count)
    some = known.indices[np.linspace(0, count - 1, most).astype(np.int64)]
    return (
        _statistics(known),
        _statistics(see(harmlessly_changed(dataset, split.seed, unit), some)),
    )


def together(pairs: Sequence[Pair]) -> Pair:
    """Stack the statistics of several graphs' frames."""
    clean, changed = (
        Statistics(*(np.concatenate(parts) for parts in zip(*each, strict=True)))
        for each in zip(*pairs, strict=True)
    )
    return clean, changed


def _statistics(seen: Observed) -> Statistics:
    if seen.judged is None:
        raise UsageError("alarm: expected a graph with the statistics of familiarity, found none")
    return Statistics(seen.judged.values, seen.judged.sequence)


def fitted_alarm(
    split: SplitKind,
    val: Pair,
    cal: Pair,
) -> AlarmSpec:
    """Return the alarm's limits from frames as they are, and with harmless changes.

    val gives usual values and scales, cal the limits: of single frames, or with a split by sequence
    of whole recordings.
    """
    known = np.concatenate([each.values for each in val])
    usual = np.median(known, axis=0)
    scales = np.maximum(np.quantile(known, _HIGH, axis=0) - usual, _LEAST)

    def scaled(each: Statistics) -> Statistics:
        return Statistics((each.values - usual) / scales, each.sequence)

    clean, changed = (scaled(each) for each in cal)
    kind: Literal["frames", "recordings"] = "recordings" if split == "sequence" else "frames"
    if kind == "frames":
        limits, n = _frame_limits(clean, changed), len(clean.values)
    else:
        largest = _largest(clean, changed)
        limits, n = _recording_limits(largest), len(largest)
    spec = AlarmSpec(kind=kind, usual=_five(usual), scales=_five(scales), limits=_five(limits), n=n)
    if kind == "recordings" and n > 1:
        return replace(spec, recordings=_novelties(spec, largest, cal[0]))
    return spec


def _frame_limits(clean: Statistics, changed: Statistics) -> Array:
    """Return one limit five times: the rank of the frames' largest r, or more for their copies.

    A limit above that of the clean frames keeps its statement.
    """
    largest = np.sort(clean.values.max(axis=1))
    copies = float(np.quantile(changed.values.max(axis=1), _COPIES))
    limit = max(float(largest[rank(len(largest)) - 1]), copies, _LEAST_LIMIT)
    return np.full(len(STATISTICS), limit)


def _largest(clean: Statistics, changed: Statistics) -> Array:
    """Return the largest running statistics of each recording and its copies, (G, 5)."""
    return np.array(
        [
            np.max(
                [
                    _running(each.values[each.sequence == number])
                    for each in (clean, changed)
                    if number in each.sequence
                ],
                axis=0,
            )
            for number in np.unique(clean.sequence)
        ]
    )


def _recording_limits(largest: Array) -> Array:
    return np.asarray(np.maximum(np.max(largest, axis=0), _LEAST_LIMIT))


def _novelties(spec: AlarmSpec, largest: Array, known: Statistics) -> tuple[float, ...]:
    """Return the mean novelty of each recording as the runtime would record it, were it new.

    That is, with limits from the others: its own would make it look more familiar than a new one.
    """
    means = []
    for index, number in enumerate(np.unique(known.sequence)):
        limits = _recording_limits(np.delete(largest, index, axis=0))
        alarm = StreamAlarm(replace(spec, limits=_five(limits)))
        judged = (
            alarm.judge({NOVELTY_OUTPUT: row[:-1], DEGRADATION_OUTPUT: row[-1:]}, seq)
            for seq, row in enumerate(known.values[known.sequence == number])
        )
        _, mean = mean_novelty(recorded_novelty(each.novelty) for each in judged if each)
        if mean is not None:
            means.append(mean)
    return tuple(means)


def _running(values: Array) -> Array:
    """Return the largest M_t of one recording, (5,)."""
    running = Running((np.inf,) * values.shape[1])
    return np.asarray(np.max([running.add(row) for row in values.tolist()], axis=0))


def _five(values: Array) -> Five:
    a, b, c, d, e = (float(value) for value in values)
    return (a, b, c, d, e)
