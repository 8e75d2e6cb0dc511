"""An estimate with the truth of the same drive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.motion.alignment import Alignment, align
from cvo_edge.motion.files import Poses
from cvo_edge.trajectories.interpolation import Track

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# A pose of the estimate has a truth if one is this near, or half a period of a slow truth.
_NEAR_NS, _FARTHEST_NS = 20_000_000, 100_000_000
# With fewer poses than this, a pair says nothing.
LEAST_POSES = 20
# Between poses that are further apart, a truth cannot be interpolated.
_SLOWEST_S = 0.25


@dataclass(frozen=True, eq=False)
class Pair:
    """An estimate and its ground truth.

    Attributes
    ----------
    name, group
        What it is called, and the drive that it is a recording of: runs of an estimator on one
        drive are one recording.
    stamps_ns, estimate
        Shape (n,), ascending, and (n, 7); NaN where there is no pose.
    columns
        Shape (n,) each, by name.
    track
        The truth at its own stamps.
    offset_ns, turn
        Added to the estimate's stamps to look the truth up; quaternion (4,) from the estimate's
        body frame to the truth's. Zero and None unless they are corrected.
    timed
        Whether one of the files has no times of its own.
    unscaled
        Whether the estimate's steps have no length, see ``direction``.
    """

    name: str
    group: str
    stamps_ns: Integers
    estimate: Array
    columns: dict[str, Array]
    track: Track
    offset_ns: int = 0
    turn: Array | None = None
    timed: bool = False
    unscaled: bool = False

    @property
    def truth(self) -> Array:
        """The truth at the estimate's stamps, (n, 7), in its body frame; NaN where unknown."""
        usual_ns = float(np.median(np.diff(self.track.stamps_ns)))
        bound_ns = round(max(_NEAR_NS, min(0.5 * usual_ns, _FARTHEST_NS)))
        poses, _ = self.track.poses_at(self.stamps_ns + self.offset_ns, bound_ns)
        if self.turn is not None:
            poses[:, 3:] = geometry.quaternion_multiply(poses[:, 3:], self.turn)
        return poses

    def aligned(self) -> Alignment | None:
        """Compare the two trajectories; see ``alignment.align``."""
        return align(self.stamps_ns, self.estimate, self.track)


def pair_of(name: str, group: str, estimate: Poses, truth: Poses) -> Pair:
    """Return an estimate and a truth as a pair.

    Raises SourceError if they do not overlap, or hardly, and for one file twice.
    """
    period_s = (
        1e-9 * float(np.median(np.diff(truth.stamps_ns))) if len(truth.stamps_ns) > 1 else 0.0
    )
    if period_s > _SLOWEST_S:
        raise SourceError(
            f"{truth.path}: expected a truth with at least {1.0 / _SLOWEST_S:g} poses a second, "
            f"found one every {period_s:.3g} s; between its poses a path would be cut short"
        )
    if np.array_equal(estimate.poses, truth.poses, equal_nan=True):
        raise SourceError(
            f"{estimate.path}: expected an estimate with its truth, found the same poses in "
            f"{truth.path}"
        )
    track = Track(truth.stamps_ns, truth.poses)
    timed = estimate.timed or truth.timed
    if truth.unscaled:
        raise UsageError(
            f"{truth.path}: expected a truth in metres, found a comment # scale: none; the "
            "estimate comes first"
        )
    pair = Pair(
        name,
        group,
        estimate.stamps_ns,
        estimate.poses,
        estimate.columns,
        track,
        timed=timed,
        unscaled=estimate.unscaled,
    )
    both = np.isfinite(np.concatenate([pair.truth, pair.estimate], axis=1)).all(axis=1)
    if both.sum() < LEAST_POSES:
        raise SourceError(
            f"{estimate.path}: expected at least {LEAST_POSES} poses with a truth in {truth.path}, "
            f"found {both.sum()} of {len(pair.stamps_ns)}; estimate at {_span(estimate)}, truth at "
            f"{_span(truth)}"
        )
    return pair


def _span(poses: Poses) -> str:
    first, last = 1e-9 * poses.stamps_ns[0], 1e-9 * poses.stamps_ns[-1]
    return f"{first:.3f} .. {last:.3f} s"
