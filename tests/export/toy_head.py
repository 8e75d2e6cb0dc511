"""Runtime side of a toy method: fixed half-widths, scaled by one factor for all frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from cvo_edge.bundle.format import SixPositive, Threshold
from cvo_edge.heads import Head
from cvo_edge.heads.cqr import infinite_where_null
from cvo_edge.sets import ConformalSet
from cvo_edge.vocabulary import Scope


class ToyParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """``unit`` is the error per DoF (m, rad) that has a score of 1."""

    unit: SixPositive


class ToyHead(Head):
    """The score |y - m| / unit, named ``toy_distance``."""

    method = "toy"
    parameters_type = ToyParameters
    score_names = ("toy_distance",)
    outputs = {"pose": (1, 7)}  # noqa: RUF012 - declared like this in the protocol

    def plain_scores(
        self,
        outputs: Mapping[str, NDArray[Any]],
        point: NDArray[np.float64],
        truth: NDArray[np.float64],
        scope: Scope = "marginal",
    ) -> NDArray[np.float64]:
        return (np.abs(truth - point) / np.array(self.parameters.unit))[:, np.newaxis]

    def plain_set(
        self,
        outputs: Mapping[str, NDArray[Any]],
        point: NDArray[np.float64],
        threshold: Threshold,
    ) -> ConformalSet:
        half = infinite_where_null(threshold.q_hat) * np.array(self.parameters.unit)
        return ConformalSet(point - half, point + half)

    def figures(self, sets: Sequence[ConformalSet]) -> dict[str, Any]:
        return {"toy_width": float(np.mean([each.width() for each in sets]))}

    def description(self) -> str:
        return "units of a toy"
