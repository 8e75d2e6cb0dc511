"""Labels of a run: true poses from a file, given to the odometer as late as they would arrive."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from cvo_edge.estimate import PoseInterval
from cvo_edge.ground_truth import GroundTruth
from cvo_edge.odometer import Odometer


class Labels:
    """Passes the true poses of a file on to an odometer, ``delay`` frames late.

    Labels that are still under way when the run ends are lost, as on a robot that is switched off.
    """

    def __init__(self, odometer: Odometer, truth: GroundTruth, delay: int) -> None:
        self._odometer = odometer
        self._truth = truth
        self._delay = delay
        self._coming: deque[tuple[int, NDArray[np.float64]]] = deque()
        self._used = self._without_interval = 0
        self._factor: tuple[float, ...] = ()

    def after(self, estimate: PoseInterval) -> None:
        """Give the labels that arrive after this estimate, and look for the label of its frame."""
        pose = self._truth.pose_of(estimate)
        if pose is not None:
            self._coming.append((estimate.seq, pose))
        while self._coming and self._coming[0][0] <= estimate.seq - self._delay:
            update = self._odometer.update(*self._coming.popleft())
            self._used += update.covered is not None
            self._without_interval += update.covered is None
            self._factor = update.factor

    def line(self) -> str:
        """Return the line of the summary."""
        if not self._used + self._without_interval:
            return "labels      none: no frame matched a label in time, by name or by stamp"
        line = f"labels      {self._used} used"
        if self._without_interval:
            line += f", {self._without_interval} of frames without an interval"
        return f"{line}; factor {' '.join(f'{each:.3g}' for each in self._factor)}"
