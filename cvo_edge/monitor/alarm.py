"""The alarm without labels: whether the images of a stream are like those of the calibration.

A bundle's graph gives five statistics x of every frame (outputs ``novelty`` and ``degradation``),
and the bundle their usual values, scales and limits: r = (x - usual) / scale.

``frames``: a frame is beyond if any r exceeds the limit, a conformal quantile of known frames'
largest r. A frame exchangeable with those is beyond with probability at most 1 %; frames of a block
are not, because neighbours depend on each other. A doubt lasts while at least a quarter of the last
32 frames, and at least three, were beyond.

``recordings``: a running statistic M_t = max(0.9 E_t(1/2), E_t(1/10)) of each r must not exceed the
limit; E_t(a) is the exponentially weighted mean of weight a. Each limit is at least the largest M_t
of all G calibration recordings. A new recording that is exchangeable with them, length included,
therefore exceeds it with probability at most 1 / (G + 1), and any of the k = 5 limits with k / (G +
1), at any time. In a crossed calibration other networks gave the limits, and nothing is proven.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from numpy.typing import NDArray

from cvo_edge.bundle.format import (
    DEGRADATION_OUTPUT,
    NOVELTY_OUTPUT,
    STATISTICS,
    AlarmSpec,
    Calibration,
)
from cvo_edge.estimate import Drift
from cvo_edge.record import Reason

# Share of known frames beyond the limit of single frames.
LEVEL = 0.99
_WEIGHTS, _FACTORS = (0.5, 0.1), (0.9, 1.0)
# Values count between these, the upper one in limits: neither a clear frame nor a very strange one
# decides for long what the next frames are taken for.
_LOWEST, _LARGEST = -1.0, 3.0
_REMEMBERED, _LEAST, _SHARE = 32, 3, 0.25


class Judgement(NamedTuple):
    """A frame's doubt or None, and its largest statistic as a share of the limit."""

    doubt: Reason | None
    novelty: float


class Running:
    """The running statistics of one stream: exponentially weighted means, one row per weight."""

    def __init__(self, limits: tuple[float, ...]) -> None:
        self._most = [_LARGEST * limit for limit in limits]
        self._means: list[list[float]] = []

    def add(self, values: list[float]) -> list[float]:
        """Values r (k,) of the next frame -> M_t (k,)."""
        kept = [
            max(_LOWEST, min(value, most)) for value, most in zip(values, self._most, strict=True)
        ]
        if not self._means:
            self._means = [kept, kept]
        quick, slow = self._means = [
            [mean + weight * (value - mean) for mean, value in zip(means, kept, strict=True)]
            for weight, means in zip(_WEIGHTS, self._means, strict=True)
        ]
        of_quick, of_slow = _FACTORS
        return [max(of_quick * a, of_slow * b) for a, b in zip(quick, slow, strict=True)]


class StreamAlarm:
    """Judges the frames of one stream; pass every usable frame once, in order.

    ``spec`` is None for a bundle without an alarm, whose drift is unknown. ``bound`` is that of
    ``false_alarms``.
    """

    def __init__(self, spec: AlarmSpec | None, bound: float | None = None) -> None:
        self._spec, self._bound = spec, bound
        self._running = None if spec is None else Running(spec.limits)
        self._recent: deque[bool] = deque(maxlen=_REMEMBERED)
        self._since: int | None = None
        self._reason: Reason | None = None

    def judge(self, outputs: Mapping[str, NDArray[Any]], seq: int) -> Judgement | None:
        """Judge frame ``seq`` by the model's outputs, all finite; None without an alarm."""
        spec = self._spec
        if spec is None or self._running is None:
            return None
        values = values_of(outputs, spec)
        if spec.kind == "recordings":
            values = self._running.add(values)
        shares = [value / limit for value, limit in zip(values, spec.limits, strict=True)]
        largest = max(shares)
        beyond = largest > 1.0
        lasting = False
        if spec.kind == "frames":
            self._recent.append(beyond)
            count = sum(self._recent)
            lasting = count >= max(_LEAST, _SHARE * len(self._recent))
        if beyond:
            degraded = shares.index(largest) == len(shares) - 1
            self._reason = Reason.IMAGE_DEGRADED if degraded else Reason.IMAGE_UNFAMILIAR
        if not (beyond or lasting):
            self._reason = self._since = None
        elif self._since is None:
            self._since = seq
        return Judgement(self._reason, largest)

    @property
    def drift(self) -> Drift:
        """The state after the last frame that was judged."""
        if self._spec is None:
            return Drift("unknown")
        state: Literal["clear", "alarm"] = "clear" if self._reason is None else "alarm"
        return Drift(state, self._reason, self._since, self._bound)


def values_of(outputs: Mapping[str, NDArray[Any]], spec: AlarmSpec) -> list[float]:
    """Return r (k,) of one frame."""
    statistics = [
        *outputs[NOVELTY_OUTPUT].ravel().tolist(),
        *outputs[DEGRADATION_OUTPUT].ravel().tolist(),
    ]
    return [
        (value - usual) / scale
        for value, usual, scale in zip(statistics, spec.usual, spec.scales, strict=True)
    ]


def rank(n: int) -> int:
    """Return the rank among n known frames that is the limit of single frames."""
    return min(math.ceil(LEVEL * (n + 1)), n)


def false_alarms(calibration: Calibration) -> float | None:
    """Return the bound of the probability of a false alarm; None if none is proven."""
    spec, source = calibration.alarm, calibration.calibration
    if spec is None or source.crossed is not None or source.split.kind == "block":
        return None
    if spec.kind == "frames":
        return 1.0 - rank(spec.n) / (spec.n + 1)
    bound = len(STATISTICS) / (spec.n + 1)
    return bound if bound < 1.0 else None


def alarm_statement(calibration: Calibration) -> str:
    """Return in a sentence what is known of the alarm's false alarms."""
    spec, source = calibration.alarm, calibration.calibration
    if spec is None:
        return "none: the graph has no outputs novelty and degradation; drift is unknown"
    bound = false_alarms(calibration)
    if source.crossed is not None:
        return "no rate of false alarms is proven: other networks gave the limits"
    if bound is None and spec.kind == "frames":
        return "no rate of false alarms is proven: neighbouring frames depend on each other"
    if bound is None:
        return f"{spec.n} recordings bound no rate of false alarms; {len(STATISTICS)} or more would"
    if spec.kind == "frames":
        return (
            f"a new frame of the calibrated recordings is beyond the limits with probability at "
            f"most {bound:.2g}, from {spec.n} frames"
        )
    return (
        f"a new recording, exchangeable with the {spec.n} of the calibration, length included, has "
        f"a false alarm with probability at most {bound:.2g}"
    )
