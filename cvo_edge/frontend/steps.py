"""A step of the front end: from one image to the next."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from cvo_edge.frontend.essential import Motion
from cvo_edge.record import Status

Array = NDArray[np.float64]


class StepReason(StrEnum):
    """Remarks on a step; the comments give the status that goes with each of them."""

    IMAGE_UNREADABLE = "image_unreadable"  # invalid: no image, or none of 8 or 16 bits
    IMAGE_SIZE = "image_size"  # invalid: not the size of the camera's images
    TRACKS_FEW = "tracks_few"  # invalid: black, blurred, without texture, or of another place
    NO_CONSENSUS = "no_consensus"  # invalid: no motion of the camera fits enough points
    LENGTH_MISSING = "length_missing"  # invalid: no length of the step is known
    NOTHING_BEFORE = "nothing_before"  # degraded: the first image, or the image before is unusable
    PARALLAX_SMALL = "parallax_small"  # ok: the step has no direction


_LOST = frozenset(StepReason) - {StepReason.NOTHING_BEFORE, StepReason.PARALLAX_SMALL}


@dataclass(frozen=True, eq=False)
class Step:
    """One image, and the camera's motion since the image before.

    Attributes
    ----------
    seq, stamp_ns, source
        As in the records of ``run``.
    reasons
        Remarks, most important first.
    tracks
        Points that both images share.
    motion
        None if there is none.
    length_m
        Length of the step; None if it is not known.
    pose
        Shape (7,): the steps added up, from the first image on, tx ty tz qx qy qz qw; NaN if the
        step is lost. Without lengths, a step with a direction counts as 1.
    size
        Height and width of the image; None without one.
    """

    seq: int
    stamp_ns: int | None
    source: str
    reasons: tuple[StepReason, ...]
    tracks: int
    motion: Motion | None
    length_m: float | None
    pose: Array
    size: tuple[int, int] | None

    @property
    def status(self) -> Status:
        """``ok`` with a rotation, ``degraded`` with nothing before, ``invalid`` for a lost step."""
        if _LOST & set(self.reasons):
            return Status.INVALID
        return Status.OK if self.motion is not None else Status.DEGRADED
