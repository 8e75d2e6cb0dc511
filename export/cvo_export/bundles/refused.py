"""Which frames the frame checks refused: how many for each reason, and an example of each."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from cvo_edge.engine.observation import Observation
from cvo_edge.record import Reason
from cvo_export.data.pose_errors import pose_errors


class Refused:
    """Counts of refused frames by reason; ``str`` gives them as text, the most common first.

    Attributes
    ----------
    invalid, degraded
        Frames with a fault, and frames with a doubt alone.
    """

    def __init__(self) -> None:
        self.invalid = self.degraded = 0
        self._counts: Counter[Reason] = Counter()
        self._examples: dict[Reason, str] = {}

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._counts)

    def __str__(self) -> str:
        """Return e.g. ``pose_implausible 20 (frame-000003: ...), image_black 1 (frame-000007)``."""
        return ", ".join(
            f"{reason} {count} ({self._examples[reason]})"
            for reason, count in self._counts.most_common()
        )

    def add(
        self, observation: Observation, frame: str, true_pose: NDArray[np.float64], unread: str
    ) -> None:
        """Count a frame that has a fault or a doubt.

        ``true_pose`` (7,) is relative to the bundle's origin; ``unread`` says why there is no
        image.
        """
        reason = observation.fault or observation.doubt
        if reason is None:
            return
        self.invalid += observation.fault is not None
        self.degraded += observation.fault is None
        self._counts[reason] += 1
        if reason not in self._examples:
            detail = unread if reason is Reason.IMAGE_UNREADABLE else _why(observation, true_pose)
            self._examples[reason] = f"{frame}: {detail}" if detail else frame


def _why(observation: Observation, true_pose: NDArray[np.float64]) -> str:
    """Say what is wrong with the network's numbers; nothing for an image."""
    if observation.fault is Reason.POSE_IMPLAUSIBLE:
        pose = observation.pose
        if np.isnan(pose).any():
            return "its quaternion is zero"
        _, (angle,) = pose_errors(pose[np.newaxis], true_pose[np.newaxis])
        return (
            f"position {_numbers(pose[:3])} m, true {_numbers(true_pose[:3])} m, rotation off by "
            f"{angle:.0f} deg"
        )
    if observation.fault in (Reason.OUTPUT_NOT_FINITE, Reason.OUTPUT_ABSURD):
        # NaN counts as largest.
        largest = {name: np.abs(values).max() for name, values in observation.outputs.items()}
        name, value = max(largest.items(), key=lambda item: np.nan_to_num(item[1], nan=np.inf))
        return f"output {name} holds {value:.2g}"
    return ""


def _numbers(values: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.2f}" for value in values)
