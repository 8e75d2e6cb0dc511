"""The self-test of a bundle: compare outputs for a known image with the expected ones."""

from __future__ import annotations

import numpy as np

from cvo_edge.engine.observation import Observation, Observer
from cvo_edge.errors import GateError
from cvo_edge.input import preprocess
from cvo_edge.odometer import Odometer


def observe_selftest(observer: Observer | Odometer, height: int, width: int) -> Observation:
    """Run the self-test image through preprocessing and network as frame 0."""
    return observer.observe(preprocess.selftest_image(height, width), seq=0)


def check_selftest(odometer: Odometer) -> float:
    """Compare all outputs with the expected ones; returns the largest absolute difference.

    Raises GateError if it exceeds the tolerance: results on this machine differ from those at
    calibration, so the stated probability does not hold.
    """
    test = odometer.calibration.selftest
    outputs = observe_selftest(odometer, test.height, test.width).outputs
    worst, worst_name = 0.0, ""
    for name, expected in test.outputs.items():
        # NaN must fail, so it counts as an infinite difference.
        difference = np.abs(outputs[name].reshape(-1).astype(np.float64) - np.array(expected))
        largest = float(np.nan_to_num(difference, nan=np.inf).max())
        if largest >= worst:
            worst, worst_name = largest, name
    if worst > test.tolerance:
        raise GateError(
            f"self-test: expected outputs within {test.tolerance:g}, found {worst_name} off by "
            f"{worst:.6g}; do not use the bundle on this machine, its results differ"
        )
    return worst
