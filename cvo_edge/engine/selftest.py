"""The self-test of a bundle: outputs for a known image, and the solver's pose for exact points."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration
from cvo_edge.engine.observation import Observation
from cvo_edge.errors import GateError
from cvo_edge.input import preprocess

# The solver computes in float64.
_SOLVER_TOLERANCE = 1e-9


class Observing(Protocol):
    """What runs a network on images: an observer or an odometer."""

    def observe(self, image_bgr: NDArray[Any] | None, seq: int) -> Observation:
        """Run the network on one image."""


class Testable(Observing, Protocol):
    """A loaded bundle: an odometer."""

    calibration: Calibration

    def solver_error(self) -> float:
        """Return how wrong the method's solver is on this machine."""


def observe_selftest(observer: Observing, height: int, width: int) -> Observation:
    """Run the self-test image through preprocessing and network as frame 0."""
    return observer.observe(preprocess.selftest_image(height, width), seq=0)


def check_reaction(odometer: Testable) -> None:
    """Raise GateError if the network gives the same outputs for the self-test image's negative.

    Nothing that a camera or its images do could then change the outputs, and a self-test of such a
    network tests nothing.
    """
    test = odometer.calibration.selftest
    image = preprocess.selftest_image(test.height, test.width)
    first, second = (odometer.observe(each, seq=0).outputs for each in (image, 255 - image))
    names = [spec.name for spec in odometer.calibration.model.outputs]
    if all(np.array_equal(first[name], second[name]) for name in names):
        raise GateError(
            "self-test: expected outputs that depend on the image, found the same for its "
            "negative; do not use the bundle, its network sees nothing"
        )


def check_selftest(odometer: Testable) -> float:
    """Compare all outputs with the expected ones; returns the largest absolute difference.

    Raises GateError if it exceeds the tolerance, or if the method's solver does not find a known
    pose: results on this machine differ from those at calibration, so the stated probability does
    not hold.
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
    solver_error = odometer.solver_error()
    if not solver_error <= _SOLVER_TOLERANCE:
        raise GateError(
            f"self-test: expected the pose of exact points within {_SOLVER_TOLERANCE:g}, found it "
            f"off by {solver_error:.3g}; do not use the bundle on this machine, its results differ"
        )
    return worst
