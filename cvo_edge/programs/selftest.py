"""The self-test of a bundle: a known image, the outputs it must give, on this very machine."""

from __future__ import annotations

import numpy as np

from cvo_edge.errors import GateError
from cvo_edge.input import preprocess
from cvo_edge.observer import Observation, Observer
from cvo_edge.odometer import Odometer


def observe_selftest(observer: Observer | Odometer, height: int, width: int) -> Observation:
    """Run the recipe's image through preprocessing and network, as frame number 0."""
    return observer.observe(preprocess.selftest_image(height, width), seq=0)


def check_selftest(odometer: Odometer) -> float:
    """Compare every output with the bundle's expectation -> the largest absolute difference.

    Raises GateError where it exceeds the tolerance: kernels or resize of this machine compute
    something else than what was calibrated, so that no stated probability holds.
    """
    test = odometer.calibration.selftest
    outputs = observe_selftest(odometer, test.height, test.width).outputs
    worst, worst_name = 0.0, ""
    for name, expected in test.outputs.items():
        # NaN must fail: as the largest difference of all.
        difference = np.abs(outputs[name].reshape(-1).astype(np.float64) - np.array(expected))
        largest = float(np.nan_to_num(difference, nan=np.inf).max())
        if largest >= worst:
            worst, worst_name = largest, name
    if worst > test.tolerance:
        raise GateError(
            f"self-test: expected outputs within {test.tolerance:g}, found {worst_name} off by "
            f"{worst:.6g}; this machine computes another network than the one calibrated"
        )
    return worst
