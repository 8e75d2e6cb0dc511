"""The part of an odometer that takes labels."""

from __future__ import annotations

from numpy.typing import ArrayLike

from cvo_edge.errors import UsageError
from cvo_edge.monitor.adaptation import Adaptation, Adapted, Update
from cvo_edge.pose import Pose


class Labelled:
    """Takes true poses of single frames, and adapts the thresholds to them.

    Every method raises UsageError unless the odometer was loaded with ``adapt`` or ``state``, after
    ``close`` and in a forked process, and SinkError if the state file cannot be written; the call
    then has changed nothing.
    """

    _adaptation: Adaptation | None = None

    @property
    def adapted(self) -> Adapted | None:
        """What the thresholds are adapted to; None unless loaded with ``adapt`` or ``state``."""
        return None if self._adaptation is None else self._adaptation.adapted

    def update(self, seq: int, pose: Pose | ArrayLike) -> Update:
        """Take the true ``T_world_camera`` (Pose or shape (7,)) of a frame, now or later.

        The frame's score is compared with the thresholds that were used for that frame; the
        thresholds of the next frames follow. Labels may skip frames and come in any order. The
        label of a frame without an interval (``degraded``, ``invalid``) changes nothing. What it
        guarantees: ``cvo_edge.monitor.adaptation``.

        Parameters
        ----------
        seq
            Number of the frame; one of the last 1,024, not yet labelled.
        pose
            The true pose. A frame whose true pose is not known has no label: do not call.

        Raises
        ------
        UsageError
            The frame is unknown, dropped, too old or labelled already, or the pose is invalid;
            nothing has changed.
        """
        return self._adapting().update(seq, pose)

    def freeze(self) -> None:
        """Keep the present thresholds, also over restarts: labels are compared and change nothing.

        ``reset`` ends this.
        """
        self._adapting().freeze()

    def reset(self) -> None:
        """Return to the calibrated thresholds and adapt to the next labels."""
        self._adapting().reset()

    def _adapting(self) -> Adaptation:
        if self._adaptation is None:
            raise UsageError(
                "labels: expected an odometer that adapts; load it with adapt=True or state=FILE"
            )
        return self._adaptation
