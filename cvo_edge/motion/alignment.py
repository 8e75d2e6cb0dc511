"""How two trajectories of one drive fit together: time offset, body frames, scale.

Public pairs of an estimate and a ground truth are often off by a frame or by a degree. Such a fault
widens all intervals, and it is not the estimator's. With the motions dE of the estimate and dG of
the truth over half a second (of keyframes: from one to the next), as rotation vectors w and
translations t,

    w_G = R w_E,    t_G = s R t_E

for body frames that differ by a rotation R and a scale s, up to noise. For each time offset of the
truth, R and s follow by least squares on the 80 % of motions that fit best: R from the solution of
Wahba's problem by SVD (Markley 1988), then from Gauss-Newton steps. The offset is where the noise
is least: the vertex of a parabola through its square at three offsets.

Standard errors are those of a jackknife over ten blocks of the drive. Straight motion says nothing
about the rotation about its own direction: about an axis with a standard error of more than half a
degree, the rotation is undetermined.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvo_edge import geometry
from cvo_edge.motion.horizons import Horizon, path_length, starts
from cvo_edge.motion.relative import motion
from cvo_edge.trajectories.interpolation import Track

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Largest offset that is looked for.
MOST_OFFSET_S = 1.0
# Standard error (deg) from which on a rotation about an axis is undetermined.
UNDETERMINED_DEG = 0.5
_SPAN = Horizon("s", 0.5)
# Motions between keyframes are those of neighbours, up to so many usual periods.
_WIDEST = 3.0
_KEPT = 0.8
_BLOCKS = 10
_STEPS = 6
# With fewer motions than this, nothing is found.
LEAST_MOTIONS = 50
_MOST_MOTIONS = 2000
_MOST_COARSE = 400
_LEAST_NOISE = 1e-9
# So many offsets are looked at together.
_AT_ONCE = 16
# A body whose usual rotation (rad) and translation (m) in half a second are below these stands.
_LEAST_MOTION = np.array([2e-3, 2e-3])
# If more than this share of motions stand, they are left out: those that fit best would be still.
_MOST_STILL = 0.5


class Alignment(NamedTuple):
    """What was found of one pair, with standard errors.

    ``misfit``: root mean square of what is left of rotations and of translations, on the motions
    that fit best, over that of the motions themselves (2,).

    Attributes
    ----------
    offset_s, offset_error_s
        To be added to the estimate's stamps to give the truth's.
    rotation, rotation_error_deg
        Rotation vector (3,) of R in rad, from the estimate's body frame to the truth's, and the
        standard errors (3,) about the ``axes``, ascending.
    axes
        Unit vectors (3, 3), one a row, in the estimate's body frame.
    scale, scale_error
        The estimate's translations times this are the truth's.
    """

    offset_s: float
    offset_error_s: float
    rotation: Array
    rotation_error_deg: Array
    axes: Array
    scale: float
    scale_error: float
    misfit: Array

    @property
    def undetermined(self) -> Array:
        """The axes (k, 3) about which the rotation is undetermined."""
        return self.axes[self.rotation_error_deg > UNDETERMINED_DEG]

    @property
    def determined_rotation(self) -> Array:
        """The rotation vector (3,), rad, without its parts about undetermined axes."""
        known = self.axes[self.rotation_error_deg <= UNDETERMINED_DEG]
        return np.asarray(known.T @ (known @ self.rotation))


class _Twists(NamedTuple):
    """Rotation vectors and translations, (n, 3) each, of the same motions."""

    w: Array
    t: Array

    @property
    def known(self) -> Mask:
        return np.asarray(np.isfinite(self.w).all(axis=1))

    def taken(self, which: Mask) -> _Twists:
        return _Twists(self.w[which], self.t[which])


class _Solution(NamedTuple):
    """R (3, 3), the scale, and the noise of rotations (rad) and translations (m)."""

    R: Array
    scale: float
    noise: Array


def align(stamps_ns: Integers, estimate: Array, truth: Track) -> Alignment | None:
    """Compare an estimate with a truth; None if too few motions overlap or nothing moves.

    Parameters
    ----------
    stamps_ns, estimate
        Shape (n,), ascending, and (n, 7), NaN where there is no pose.
    truth
        The truth at its own stamps.
    """
    if len(stamps_ns) < LEAST_MOTIONS or len(truth.stamps_ns) < LEAST_MOTIONS:
        return None
    pair = _Pair(stamps_ns, estimate, truth)
    offset_ns = pair.coarse_offset()
    if offset_ns is None or pair.stands(offset_ns):
        return None
    trues = [pair.truth_at([offset_ns + k * pair.step_ns]) for k in (-1, 0, 1)]
    known = trues[0].known & trues[1].known & trues[2].known
    block = np.arange(len(known)) * _BLOCKS // len(known)
    vertices = [
        _vertex(pair.moved, trues, known & (block != left_out)) for left_out in range(-1, _BLOCKS)
    ]
    whole = [each for each in vertices if each is not None]
    if len(whole) < len(vertices):
        return None
    found, *others = whole
    # At the vertex itself; those of the blocks only measure how much they differ.
    offset_ns += found.shift * pair.step_ns
    true = pair.truth_at([offset_ns])
    known = true.known
    best = _solve(pair.moved.taken(known), true.taken(known))
    turns = _logarithms(np.array([each.solution.R @ best.R.T for each in others]))
    # Rotations of the truth's body frame, seen from the estimate's.
    variances, axes = np.linalg.eigh(_jackknife(turns @ best.R))
    deviation = np.sqrt(np.maximum(variances, 0.0))
    return Alignment(
        1e-9 * offset_ns,
        1e-9 * pair.step_ns * float(np.sqrt(_jackknife([each.shift for each in others])[0, 0])),
        _logarithms(best.R[np.newaxis])[0],
        np.rad2deg(deviation),
        axes.T,
        best.scale,
        float(np.sqrt(_jackknife([each.solution.scale for each in others])[0, 0])),
        best.noise / np.maximum([_rms(true.w[known]), _rms(true.t[known])], _LEAST_MOTION),
    )


class _Pair:
    """The motions of an estimate, and those of the truth over the same times at any offset."""

    def __init__(self, stamps_ns: Integers, estimate: Array, truth: Track) -> None:
        whole = np.isfinite(estimate).all(axis=1)
        stamps_ns, estimate = stamps_ns[whole], estimate[whole]
        along = _SPAN.along(stamps_ns, path_length(estimate))
        every = np.arange(len(along))
        usual_s = float(np.median(np.diff(along)))
        if usual_s <= 0.5 * _SPAN.value:
            start = starts(_SPAN, along, np.zeros_like(every), every)
        else:
            # Keyframes, at odd times: hardly two of them are half a second apart.
            start = np.where(np.diff(along, prepend=-np.inf) <= _WIDEST * usual_s, every - 1, -1)
        end = np.flatnonzero(start >= 0)
        still = _stand(_twists(motion(estimate[start[end]], estimate[end])))
        if still.sum() > _MOST_STILL * len(still):
            end = end[~still]
        end = end[:: max(1, len(end) // _MOST_MOTIONS)]
        self._stamps_ns = np.concatenate([stamps_ns[start[end]], stamps_ns[end]])
        self._truth = truth
        self.moved = _twists(motion(estimate[start[end]], estimate[end]))
        usual_ns = float(np.median(np.diff(stamps_ns)))
        of_truth_ns = float(np.median(np.diff(truth.stamps_ns)))
        # Between its poses, an interpolated truth has less noise than at them. Offsets that are
        # multiples of the period of a slow truth treat them all alike.
        self.step_ns = of_truth_ns if of_truth_ns >= 0.5 * usual_ns else 0.25 * usual_ns
        self._bound_ns = round(max(20e6, 0.6 * of_truth_ns))

    def truth_at(self, offsets_ns: Sequence[float], every: int = 1) -> _Twists:
        """Return the truth's motions at each offset in turn, NaN where it is not known."""
        first, last = (each[::every] for each in np.split(self._stamps_ns, 2))
        shifts = [round(offset) for offset in offsets_ns]
        both = [stamps + shift for stamps in (first, last) for shift in shifts]
        poses, _ = self._truth.poses_at(np.concatenate(both), self._bound_ns)
        return _twists(motion(*np.split(poses, 2)))

    def stands(self, offset_ns: float) -> bool:
        """Whether the truth neither turns nor moves."""
        true = self.truth_at([offset_ns])
        usual = np.array([_rms(true.w[true.known]), _rms(true.t[true.known])])
        return bool((usual < _LEAST_MOTION).all())

    def coarse_offset(self) -> float | None:
        """Return the offset at which speeds and turn rates fit best; None if nothing does."""
        every = max(1, len(self.moved.w) // _MOST_COARSE)
        own = _rates(_Twists(self.moved.w[::every], self.moved.t[::every]))
        count = round(1e9 * MOST_OFFSET_S / self.step_ns)
        offsets = [self.step_ns * k for k in range(-count, count + 1)]
        costs = []
        for first in range(0, len(offsets), _AT_ONCE):
            some = offsets[first : first + _AT_ONCE]
            rates = _rates(self.truth_at(some, every)).reshape(2, len(some), -1)
            costs += [_mismatch(own, rates[:, place]) for place in range(len(some))]
        if not np.isfinite(costs).any():
            return None
        near = offsets[int(np.argmin(costs))]
        fine = {}
        for offset in (near + k * self.step_ns for k in range(-2, 3)):
            true = self.truth_at([offset])
            known = true.known
            if known.sum() >= LEAST_MOTIONS:
                noise = _solve(self.moved.taken(known), true.taken(known)).noise
                fine[offset] = float(np.log(noise).sum())
        return min(fine, key=fine.__getitem__, default=None)


class _Vertex(NamedTuple):
    """Where the noise is least, in steps from the middle offset, and the solution there."""

    shift: float
    solution: _Solution


def _vertex(moved: _Twists, trues: list[_Twists], which: Mask) -> _Vertex | None:
    if which.sum() < LEAST_MOTIONS:
        return None
    solutions = [_solve(moved.taken(which), true.taken(which)) for true in trues]
    before, middle, after = (
        float(np.sum((each.noise / solutions[1].noise) ** 2)) for each in solutions
    )
    curvature = before - 2.0 * middle + after
    shift = 0.5 * (before - after) / curvature if curvature > 0.0 else 0.0
    return _Vertex(float(np.clip(shift, -1.0, 1.0)), solutions[1])


def _solve(moved: _Twists, true: _Twists) -> _Solution:
    """Return R, scale and noise on the motions that fit best, after a few steps."""
    R, scale, noise = np.eye(3), 1.0, np.ones(2)
    for step in range(_STEPS):
        turned = moved.w @ R.T, scale * (moved.t @ R.T)
        off = true.w - turned[0], true.t - turned[1]
        fits = np.flatnonzero(_fits(off[0]) & _fits(off[1]))
        off = off[0][fits], off[1][fits]
        noise = np.maximum([_rms(each) for each in off], _LEAST_NOISE)
        own_t, true_t = moved.t[fits], true.t[fits]
        if step == 0:
            R = geometry.nearest_rotation(
                true.w[fits].T @ moved.w[fits] / noise[0] ** 2 + true_t.T @ own_t / noise[1] ** 2
            )
        else:
            information, pull = np.zeros((3, 3)), np.zeros(3)
            for part, rest, deviation in zip(turned, off, noise, strict=True):
                p = part[fits]
                gram, mixed = p.T @ p / deviation**2, p.T @ rest / deviation**2
                information += np.trace(gram) * np.eye(3) - gram
                # The sum of cross products p x r.
                pull += (mixed - mixed.T)[(1, 2, 0), (2, 0, 1)]
            information += 1e-9 * np.trace(information) * np.eye(3) + 1e-300 * np.eye(3)
            turn = geometry.quaternion_exp(np.linalg.solve(information, pull))
            R = geometry.quaternion_to_matrix(turn) @ R
        scale = float(np.sum(R * (true_t.T @ own_t)) / max(np.sum(own_t * own_t), 1e-300))
    return _Solution(R, scale, noise)


def _fits(off: Array) -> Mask:
    size = np.einsum("ij,ij->i", off, off)
    most = int(_KEPT * (len(size) - 1))
    return np.asarray(size <= np.partition(size, most)[most])


def _rates(twists: _Twists) -> Array:
    """Return the sizes (2, n) of rotations and translations."""
    return np.sqrt([np.einsum("ij,ij->i", each, each) for each in twists])


def _stand(twists: _Twists) -> Mask:
    """Return in which motions (n,) the body neither turns nor moves."""
    return np.asarray((_rates(twists) < _LEAST_MOTION[:, np.newaxis]).all(axis=0))


def _mismatch(moved: Array, true: Array) -> float:
    """Return how much sizes (2, n) differ, as logarithms of their trimmed squares."""
    known = np.isfinite(true[0])
    if known.sum() < LEAST_MOTIONS:
        return np.inf
    (w, t), (true_w, true_t) = moved[:, known], true[:, known]
    ratio = np.median(t) / max(float(np.median(true_t)), 1e-12)
    kept = int(_KEPT * len(w))
    return sum(
        float(np.log(max(_rms(np.partition(np.abs(off), kept)[:kept]), _LEAST_NOISE)))
        for off in (w - true_w, t - ratio * true_t)
    )


def _jackknife(values: ArrayLike) -> Array:
    """Estimates without each block (blocks,) or (blocks, k) -> their covariance (k, k)."""
    each = np.asarray(values, np.float64).reshape(_BLOCKS, -1)
    off = each - each.mean(axis=0)
    return np.asarray((_BLOCKS - 1) / _BLOCKS * (off.T @ off))


def _twists(motions: Array) -> _Twists:
    return _Twists(geometry.quaternion_log(motions[:, 3:]), motions[:, :3])


def _logarithms(R: Array) -> Array:
    return geometry.quaternion_log(geometry.matrix_to_quaternion(R))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values * values))) if values.size else 0.0
