"""Thresholds for new recordings, from scores of recordings that are exchangeable with them.

L_g(q) is the share of recording g's scores above q, alpha = 1 - confidence, and G the number of
recordings (drives of one group count as one).

================  ================================================  ================================
rule              threshold q                                       statement about a new recording
================  ================================================  ================================
``mean``          least q with mean_g L_g(q) <= alpha               none that is proven: the average
                                                                    of these recordings
``tolerance``     max_g of the least q with L_g(q) <= alpha         with probability G / (G + 1), at
                                                                    most alpha of its scores are
                                                                    above (Wilks 1941: the maximum)
``capped``        ``conformal.capped_quantile`` with cap 0.5        E min(L, cap) <= alpha
``hierarchical``  the same with cap 1                               E L <= alpha
================  ================================================  ================================

"Scores" are those of fixed bias and scale. With crossed fits, each recording is scored by a model
fitted without it, and what the statements give is measured, not proven.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cvo_edge.vocabulary import MotionRule

Array = NDArray[np.float64]

CAP = 0.5
_TOLERANCE = 1e-9
# Size of a sample, and how many of its values to both sides of a quantile are looked at first.
_SAMPLE, _MARGIN = 1000, 30


def within(rule: MotionRule, confidence: float, count: int) -> float:
    """Return what the shares of ``count`` recordings up to the threshold have to add up to."""
    wanted = confidence * count
    if rule != "mean":
        wanted = confidence * (count + 1) - (1.0 - (CAP if rule == "capped" else 1.0))
    return wanted - _TOLERANCE * count


def is_supported(rule: MotionRule, confidence: float, count: int) -> bool:
    """Whether ``count`` recordings have a finite threshold."""
    return rule == "tolerance" or within(rule, confidence, count) <= count


class Scores:
    """The scores of several recordings, (n, columns) each; ``groups`` says which are one.

    Columns are worked on one after another: those of many recordings fill the memory.
    """

    def __init__(self, scores: Sequence[Array], groups: Sequence[str]) -> None:
        named: dict[str, list[Array]] = {}
        for group, values in zip(groups, scores, strict=True):
            named.setdefault(group, []).append(values)
        # Sorted by name: sums of floats depend on the order.
        self._groups = [named[name] for name in sorted(named)]
        self._sizes = [sum(map(len, each)) for each in self._groups]
        self.count = len(self._groups)

    def thresholds(self, rule: MotionRule, confidence: float) -> Array:
        """Return a threshold for each column, (columns,); infinite if the rule supports none."""
        return np.asarray(self.table((rule,), (confidence,))[0, 0])

    def table(self, rules: Sequence[MotionRule], levels: Sequence[float]) -> Array:
        """Return the thresholds of several rules and confidences, (rules, levels, columns)."""
        weights = np.repeat([1.0 / size for size in self._sizes], self._sizes)
        found = np.empty((len(rules), len(levels), self._groups[0][0].shape[1]))
        single = len(rules) * len(levels) == 1 and rules[0] != "tolerance"
        for column in range(found.shape[2]):
            own = [np.concatenate([each[:, column] for each in group]) for group in self._groups]
            if single:
                wanted = within(rules[0], levels[0], self.count)
                found[0, 0, column] = _selected(np.concatenate(own), weights, wanted)
                continue
            for each in own:
                each.sort()
            every = np.concatenate(own)
            # Runs that are sorted already are merged, which is faster than to sort them.
            order = np.argsort(every, kind="stable")
            shares = np.cumsum(weights[order])
            for row, rule in enumerate(rules):
                for place, level in enumerate(levels):
                    if rule == "tolerance":
                        found[row, place, column] = max(_quantile(each, level) for each in own)
                        continue
                    index = int(np.searchsorted(shares, within(rule, level, self.count)))
                    inside = index < len(every)
                    found[row, place, column] = every[order[index]] if inside else math.inf
        return found


def _quantile(ascending: Array, confidence: float) -> float:
    """Return the least score that at least this share of scores (n,) are up to."""
    n = len(ascending)
    return float(ascending[max(0, math.ceil(confidence * n - _TOLERANCE * n) - 1)])


def _selected(values: Array, weights: Array, wanted: float) -> float:
    """Return the least value up to which the weights of values (n,) add up to ``wanted``.

    A sample says between which values it is; only those are sorted. (Floyd and Rivest 1975)
    """
    step = 1 + len(values) // _SAMPLE
    order = np.argsort(values[::step])
    sample, shares = values[::step][order], np.cumsum(weights[::step][order])
    place = int(np.searchsorted(shares, wanted * shares[-1] / weights.sum()))
    margin = _MARGIN
    while True:
        low = sample[place - margin] if place >= margin else -math.inf
        high = sample[place + margin] if place + margin < len(sample) else math.inf
        below = float(weights @ (values <= low))
        inside = np.flatnonzero((values > low) & (values <= high))
        inside = inside[np.argsort(values[inside])]
        index = int(np.searchsorted(below + np.cumsum(weights[inside]), wanted))
        if (below < wanted or math.isinf(low)) and index < len(inside):
            return float(values[inside[index]])
        if math.isinf(low) and math.isinf(high):
            return math.inf
        margin *= 4
