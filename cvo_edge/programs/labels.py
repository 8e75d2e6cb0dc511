"""Labels of a run: true poses from a file, given to the odometer as late as they would arrive."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from cvo_edge.estimate import PoseInterval
from cvo_edge.ground_truth import GroundTruth
from cvo_edge.odometer import Odometer

# Of so many labels, a share that no drift of the thresholds explains.
_LEAST_USED, _MOST_MISSED = 20, 0.5


class Labels:
    """Passes the true poses of a file on to an odometer, ``delay`` frames late.

    Labels that are still under way when the run ends are lost, as on a robot that is switched off.
    """

    def __init__(self, odometer: Odometer, truth: GroundTruth, delay: int) -> None:
        self._odometer = odometer
        self._truth = truth
        self._delay = delay
        self._coming: deque[tuple[int, NDArray[np.float64]]] = deque()
        self._matched = self._used = self._without_interval = self._missed = 0

    def after(self, estimate: PoseInterval) -> None:
        """Give the labels that arrive after this estimate, and look for the label of its frame."""
        pose = self._truth.pose_of(estimate)
        if pose is not None:
            self._matched += 1
            self._coming.append((estimate.seq, pose))
        while self._coming and self._coming[0][0] <= estimate.seq - self._delay:
            update = self._odometer.update(*self._coming.popleft())
            self._used += update.covered is not None
            self._missed += update.covered is not None and not all(update.covered)
            self._without_interval += update.covered is None

    def line(self) -> str:
        """Return the line of the summary."""
        if not self._matched:
            return "labels      none: no frame matched a label, by name or by stamp"
        adapted = self._odometer.adapted
        frozen = adapted is not None and adapted.frozen
        line = f"labels      {self._used} {'compared, the state is frozen' if frozen else 'used'}"
        if self._used:
            line += f", {self._missed} outside"
        if self._without_interval:
            line += f", {self._without_interval} of frames without an interval"
        if late := self._matched - self._used - self._without_interval:
            line += f", {late} too late"
        if self._missed > _MOST_MISSED * self._used and self._used >= _LEAST_USED:
            line += "; check the labels' frame of reference and quaternion order (qx qy qz qw)"
        return line
