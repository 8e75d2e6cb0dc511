"""How hard a frame is, without labels: the factor u that scales its sets.

A bundle's graph tells of every frame how unfamiliar its image is. With g the logarithms of the four
numbers of its output ``novelty``, and weights w,

    u = exp(clip(b + w . g, lowest, highest)),

and the nonconformity score of a truth y is the method's own score of p + (y - p) / u, with p the
prediction. Its set {p + u (y - p) : y in the method's set} is the method's own, stretched about the
prediction; regions and bands stretch alike. w and b are fitted before calibration, to other frames:
u is a fixed function of the image, so the scores stay exchangeable, and the thresholds promise the
same as without it (Lei et al. 2018, section 5.2: locally weighted conformal inference).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import NOVELTY_OUTPUT, DifficultySpec

Array = NDArray[np.float64]

# A distance below this is that of a frame that was trained on.
_LEAST_NOVELTY = 1e-3


class Difficulty:
    """The factors of frames, from the outputs of the graph."""

    def __init__(self, spec: DifficultySpec) -> None:
        self.spec = spec

    def factors(self, outputs: Mapping[str, NDArray[Any]]) -> Array:
        """Outputs stacked over n frames -> u (n,)."""
        return np.array([self.factor(row) for row in outputs[NOVELTY_OUTPUT].tolist()])

    def factor(self, novelty: list[float]) -> float:
        """Return u of one frame; for four numbers plain Python is faster than numpy."""
        spec = self.spec
        log_u = spec.bias + sum(
            weight * math.log(max(value, _LEAST_NOVELTY))
            for weight, value in zip(spec.weights, novelty, strict=True)
        )
        return math.exp(max(spec.lowest, min(log_u, spec.highest)))


def features(outputs: Mapping[str, NDArray[Any]]) -> Array:
    """Outputs stacked over n frames -> g (n, 4)."""
    return np.log(np.maximum(outputs[NOVELTY_OUTPUT].astype(np.float64), _LEAST_NOVELTY))
