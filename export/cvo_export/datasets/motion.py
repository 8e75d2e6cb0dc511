"""What a data set's poses say: how far and fast the camera moves, where is up, what is missing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_export.datasets.base import PoseDataset

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# With a larger spread about the mean rotation, tangent coordinates come close to their
# discontinuity at pi.
MAX_SPREAD_RAD = 2.0
# A degree of freedom that moves less than this share of the largest of its kind, or than this many
# metres or radians, stands still: its unit is this floor.
_STILL_SHARE = 0.01
STILL_M, STILL_RAD = 1e-4, 5e-3

# A step this many times as fast as the median of the steps about it, and of all steps, is a jump,
# unless it is shorter than this.
_JUMP, _ABOUT, _JUMP_M, _JUMP_RAD = 10.0, 8, 0.05, 0.2
# A pause this many times as long as the median of the recording is a gap.
_GAP = 2.5
# Up is known where the camera's x axis is level (mean squared sine of the angle) and points to
# several sides (mean squared sine of the angle from its main direction).
_LEVEL, _TURNED = 0.03, 0.05
# The camera's own up, which decides the sign, is at least this long on average along that axis.
_SIGNED = 0.3


def deviation_floor(deviation: Array) -> Array:
    """Return the least unit of each degree of freedom, from the deviations (6,), m and rad.

    A degree of freedom whose deviation is less stands still.
    """
    return np.concatenate(
        [
            np.full(3, max(least, _STILL_SHARE * float(part.max())))
            for part, least in ((deviation[:3], STILL_M), (deviation[3:], STILL_RAD))
        ]
    )


class Up(NamedTuple):
    """The world's up: a unit vector (3,), and why it is not sure, or "" if it is."""

    direction: Array
    doubt: str


@dataclass(frozen=True)
class Motion:
    """The motion of n frames, in which m steps join consecutive frames of one recording.

    Attributes
    ----------
    first
        Frame number (m,) at which each step begins.
    metres, radians
        Distance and angle of each step, (m,).
    seconds
        Duration of each step, (m,); None if the data set has no stamps.
    jumps, gaps, repeated
        Which steps jump, take much longer than usual, and take no time, (m,) each.
    spread_rad
        Largest angle from the mean rotation.
    still
        Which degrees of freedom stand still, (6,), over all frames.
    """

    first: Indices
    metres: Array
    radians: Array
    seconds: Array | None
    jumps: NDArray[np.bool_]
    gaps: NDArray[np.bool_]
    repeated: NDArray[np.bool_]
    spread_rad: float
    still: NDArray[np.bool_]

    def rates(self, amount: Array) -> Array:
        """Return amounts (m,) per second, or per frame without stamps, where time passes."""
        if self.seconds is None:
            return amount
        passed = self.seconds > 0.0
        return np.asarray(amount[passed] / self.seconds[passed])


def motion_of(dataset: PoseDataset) -> Motion:
    """Measure the motion of a data set, from its poses and stamps alone."""
    poses, sequence = dataset.poses, dataset.sequence
    first = np.flatnonzero(sequence[1:] == sequence[:-1])
    metres = np.linalg.norm(poses[first + 1, :3] - poses[first, :3], axis=1)
    inverse = geometry.quaternion_conjugate(poses[first, 3:])
    turned = geometry.quaternion_log(geometry.quaternion_multiply(inverse, poses[first + 1, 3:]))
    radians = np.linalg.norm(turned, axis=1)
    gaps = repeated = np.zeros(first.size, np.bool_)
    seconds = None
    rates = metres, radians
    if dataset.stamps_ns is not None:
        # Subtracted as integers: float64 resolves stamps of this century to a quarter microsecond.
        seconds = (dataset.stamps_ns[first + 1] - dataset.stamps_ns[first]) / 1e9
        repeated = seconds <= 0.0
        usual = _by_sequence(seconds, sequence[first])
        gaps = seconds > _GAP * usual
        passed = np.where(repeated, usual, seconds)
        rates = metres / np.maximum(passed, 1e-9), radians / np.maximum(passed, 1e-9)
    jumps = _outliers(rates[0]) & (metres > _JUMP_M) | _outliers(rates[1]) & (radians > _JUMP_RAD)
    reference = geometry.mean_rotation(poses[:, 3:])
    tangent = geometry.quaternion_log(
        geometry.quaternion_multiply(geometry.quaternion_conjugate(reference), poses[:, 3:])
    )
    deviation = np.concatenate([poses[:, :3].std(axis=0), tangent.std(axis=0)])
    return Motion(
        first=first,
        metres=metres,
        radians=radians,
        seconds=seconds,
        jumps=jumps,
        gaps=gaps,
        repeated=repeated,
        spread_rad=float(np.linalg.norm(tangent, axis=1).max()),
        still=deviation < deviation_floor(deviation),
    )


def up_of(poses: Array) -> Up:
    """Judge the world's up from camera poses (n, 7): cameras are held level, or nearly so.

    The x axis of a camera that is not rolled is level in any direction of view. Where it points to
    several sides, up is the normal of the plane that it sweeps; otherwise the mean of the cameras'
    own up (-y), which is not sure, because all may look downwards.
    """
    R = geometry.quaternion_to_matrix(poses[:, 3:])
    own = -R[:, :, 1].mean(axis=0)
    x = R[:, :, 0]
    values, vectors = np.linalg.eigh(x.T @ x / len(x))
    normal = vectors[:, 0] * (1.0 if vectors[:, 0] @ own >= 0.0 else -1.0)
    if values[1] < _TURNED:
        doubt = "the camera hardly turns about it"
    elif values[0] > _LEVEL:
        doubt = "the camera is not held level"
    elif normal @ own < _SIGNED:
        return Up(normal, "the camera looks up or down along it: the opposite is possible")
    else:
        return Up(normal, "")
    length = float(np.linalg.norm(own))
    return Up(own / length if length > 0.0 else normal, doubt)


def _by_sequence(seconds: Array, sequence: Indices) -> Array:
    """Return, for each step, the median duration of its recording's steps."""
    usual = np.empty(seconds.size)
    for number in np.unique(sequence):
        own = sequence == number
        usual[own] = np.median(seconds[own])
    return usual


def _outliers(rate: Array) -> NDArray[np.bool_]:
    """Return which of the rates (m,) are far above those about them, and above all rates."""
    if rate.size < 2 * _ABOUT + 1:
        return np.zeros(rate.size, np.bool_)
    padded = np.pad(rate, _ABOUT, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _ABOUT + 1)
    usual = np.maximum(np.median(windows, axis=1), np.median(rate))
    return np.asarray(rate > _JUMP * usual)
