"""One frame between the worker that estimates it and the stream that it is part of."""

from __future__ import annotations

from typing import NamedTuple

from cvo_edge.engine.observation import Observation
from cvo_edge.input.frame import Frame
from cvo_edge.monitor.adaptation import Level
from cvo_edge.record import Reason
from cvo_edge.sets import ConformalSet


class Processed(NamedTuple):
    """One frame before its stream checks: the result of a worker and the input of ``conclude``.

    ``conformal_set`` is unbounded if the observation has a fault or a doubt. ``conformal_ms`` is
    the time for the set, ``total_ms`` the time from reading the frame to the set, ``level`` the
    thresholds of the set if the odometer adapts. ``picture`` holds the doubts of the stream about
    the picture, None for a frame that was processed beside others of its stream.
    """

    frame: Frame
    seq: int
    observation: Observation
    conformal_set: ConformalSet
    conformal_ms: float
    total_ms: float
    level: Level | None = None
    picture: tuple[Reason, ...] | None = None

    def latency_ms(self) -> dict[str, float]:
        """Return milliseconds per stage, as in a record."""
        return {
            "read": round(self.frame.read_ms, 4),
            "preprocess": round(self.observation.preprocess_ms, 4),
            "model": round(self.observation.model_ms, 4),
            "conformal": round(self.conformal_ms, 4),
            "total": round(self.total_ms, 4),
        }
