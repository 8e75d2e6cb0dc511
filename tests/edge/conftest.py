"""Calibrations of every method without a model, for heads alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from cvo_edge.artifact import Bundle, Calibration, Threshold
from cvo_edge.heads import HEADS, Head


@pytest.fixture
def make_head(bundle: Bundle) -> Callable[..., Head]:
    """Head of a method with these parameters, score and thresholds at 0.9 marginal."""

    def make(
        method: str,
        score: str,
        parameters: dict[str, Any],
        q_hat: Any = (None,) * 6,
        q_hat_upper: Any = None,
    ) -> Head:
        entry = Threshold(confidence=0.9, scope="marginal", q_hat=q_hat, q_hat_upper=q_hat_upper)
        source = msgspec.structs.replace(bundle.calibration.calibration, score=score)
        calibration: Calibration = msgspec.structs.replace(
            bundle.calibration,
            method=method,
            method_parameters=parameters,
            thresholds=(entry,),
            calibration=source,
        )
        return HEADS[method](calibration)

    return make
