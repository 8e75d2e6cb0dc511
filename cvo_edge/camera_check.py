"""Whether the running camera is the one that was stated, from the frames of a stream.

A frame whose pose was solved from scene coordinates also says a little about the camera
(``pose_solver.LensEvidence``): a gradient g and a curvature H of the likelihood in the logarithms
of both focal lengths and a radial distortion, which add up over frames. The lens that frames show
is (sum H)^-1 sum g, with covariance (sum H)^-1. Two frames suffice where the lens is off by many
deviations; over a window, a few percent of focal length show in hard frames, too. Frames from
nearly the same pose err in the same way: only frames that have moved add evidence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from cvo_edge.bundle.format import Positive
from cvo_edge.pose_solver import PoseSolver

Array = NDArray[np.float64]
# Gradient (3,) and information (3, 3) of one frame.
Evidence = tuple[Array, Array]

# Frames whose evidence is added: where a lens must be off by more than a limit, and where it must
# be off by many deviations as well.
WINDOW, PAIR = 20, 2
# Frames in which a larger share of cells contradicts the pose are weak evidence: what seems to be
# another camera may be a part of the place that the network knows badly. With them, the limits are
# wider by a factor; without them, a camera that is far off would leave no evidence.
_CONTRADICTING, _WEAK = 0.3, 2.0
# Frames that the estimate uses at most, spread over the stream.
_KEPT = 64
# Limits in units of what the median recording of the known camera shows at most. The largest would
# be a poor measure: one badly known recording would switch the check off. Distortion is less
# certain, as only the corners of an image show it.
_FOCAL_MARGIN, _DISTORTION_MARGIN = 3.5, 6.0
# Limits in deviations over the largest of all pairs, which differ less between recordings; but not
# more over what the median recording shows at most.
_DEVIATION_MARGIN, _DEVIATION_MOST = 2.0, 4.0
# Limits of a camera that shows the network clearly less than it has learned are wider by a factor:
# its cells err more, and a narrower image tells focal length from distance less well.
_NARROW = 2.0
# Share of the usual motion between two frames of a recording that makes a frame new evidence.
_STEP_SHARE, _LEAST_STEP = 0.5, 1e-6
# The least distinct directions keep an estimate of what the frames leave open near zero.
_OPEN = 1e-6 * np.eye(3)


class LensLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """The largest differences that frames of the known camera may show over a window.

    ``log_focal``: logarithm of the factor of either focal length; ``distortion``: additional k1;
    ``deviations``: over two frames, of the logarithms of fx and fy and of k1, in deviations.
    ``step``: frames that have moved by less than this position (m) and rotation (rad) since the
    last one are no evidence.
    """

    log_focal: Positive
    distortion: Positive
    deviations: tuple[Positive, Positive, Positive]
    step: tuple[Positive, Positive]


class LensEstimate(NamedTuple):
    """The camera that the frames show: factors of the stated fx and fy, and additional k1."""

    fx: float
    fy: float
    k1: float
    frames: int


class CameraCheck:
    """Compares the camera of a stream with the stated one; pass every solved frame once, in order.

    Parameters
    ----------
    solver
        The pose solver of the stated camera.
    focal_px
        Its focal length in pixels of the model's input.
    limits
        Deviations beyond which the camera differs.
    error_px
        Median reprojection error of the known place: a camera is only reported if it explains the
        frames that well.
    narrow
        Whether the stated camera's images fill clearly less of the model's input than those that
        the network has learned.
    """

    def __init__(
        self,
        solver: PoseSolver,
        focal_px: float,
        limits: LensLimits,
        error_px: float,
        *,
        narrow: bool = False,
    ) -> None:
        self._solver, self._focal_px, self._error_px = solver, focal_px, error_px
        factor = _NARROW if narrow else 1.0
        largest = np.array([limits.log_focal, limits.log_focal, limits.distortion])
        self._deviations = factor * np.array(limits.deviations)
        self._step = limits.step
        self._last: Array | None = None
        self._clear, self._familiar = _Window(1.0), _Window(_WEAK)
        # For the pair and the whole of each window.
        self._limits = factor * np.array([[[1.0]] * 2, [[_WEAK]] * 2]) * largest
        self._kept: list[tuple[NDArray[Any], NDArray[Any], Array]] = []
        self._seen, self._stride = 0, 1
        # The verdict of whole windows, and for how many frames that of two still holds.
        self._differs, self._held = False, 0

    def differs(self, outputs: Mapping[str, NDArray[Any]], *, familiar: bool) -> bool:
        """Add one frame; return whether the frames of the stream show another camera.

        A frame that is not ``familiar`` counts for the estimate alone, because a camera that is
        quite different makes all frames unfamiliar. The camera of a stream does not change: what
        two frames have shown holds until a whole window of others has had its say.
        """
        if self._seen % self._stride == 0:
            self._keep(outputs)
        self._seen += 1
        pose = outputs["solved_pose"][0]
        if familiar and (self._last is None or _beyond(_motion(self._last, pose), self._step)):
            self._last = pose
            evidence = outputs["lens_gradient"][0], outputs["lens_information"][0]
            self._familiar.add(evidence)
            if _is_clear(outputs["signs"])[0]:
                self._clear.add(evidence)
            self._judge()
        return self._differs or self._held > 0

    def _judge(self) -> None:
        """Set what whole windows and the last two frames show."""
        windows = self._clear, self._familiar
        shown, differs = False, False
        beyond = np.abs(_lens(np.array([each.sums() for each in windows]))) > self._limits
        # Few frames come this far, so that the covariance costs nothing.
        if beyond.any():
            for window, (pair, whole) in zip(windows, beyond, strict=True):
                differs |= window.count >= WINDOW and bool(whole.any())
                if window.count >= PAIR and pair.any():
                    limits = window.factor * self._deviations
                    shown |= bool((pair & (in_deviations(window.pair()) > limits)).any())
        self._held = WINDOW if shown else max(0, self._held - 1)
        self._differs = differs

    def estimate(self) -> LensEstimate | None:
        """Return the camera that the frames show; None if none explains them, or for few frames."""
        if len(self._kept) < WINDOW:
            return None
        # Another thread may be adding a frame.
        frames = [
            (points, np.exp(log_scale.astype(np.float64)) / self._focal_px, pose)
            for points, log_scale, pose in list(self._kept)
        ]
        lens, error = self._solver.lens_fit(frames)
        if not np.median(error) * self._focal_px <= self._error_px:
            return None
        fx, fy = np.exp(lens[:2]).tolist()
        return LensEstimate(fx, fy, float(lens[2]), len(self._kept))

    def _keep(self, outputs: Mapping[str, NDArray[Any]]) -> None:
        # The engine may use the memory of its outputs again.
        cells = outputs["coordinates"][0].copy(), outputs["log_scale_px"][0].copy()
        self._kept.append((*cells, outputs["solved_pose"][0]))
        if len(self._kept) > _KEPT:
            self._kept = self._kept[::2]
            self._stride *= 2


class _Window:
    """The evidence of the newest frames of one kind; limits are wider by its factor."""

    def __init__(self, factor: float) -> None:
        self.factor, self.count = factor, 0
        self._ring = np.zeros((WINDOW, 3, 4))

    def add(self, evidence: Evidence) -> None:
        row = self._ring[self.count % WINDOW]
        row[:, 3], row[:, :3] = evidence
        self.count += 1

    def sums(self) -> tuple[Array, Array]:
        """Return [information, gradient] (3, 4), summed over the last two frames and over all."""
        last = self.count - 1
        pair = self._ring[last % WINDOW] + self._ring[(last - 1) % WINDOW]
        return pair, self._ring.sum(axis=0)

    def pair(self) -> list[Evidence]:
        """Return the evidence of the last two frames."""
        last = [self._ring[(self.count - back) % WINDOW] for back in (2, 1)]
        return [(row[:, 3], row[:, :3]) for row in last]


def _lens(sums: Array) -> Array:
    """Sums [information, gradient] (..., 3, 4) -> the lens they show, (..., 3)."""
    return np.asarray(np.linalg.solve(sums[..., :3] + _OPEN, sums[..., 3:])[..., 0], np.float64)


def summed(evidence: Sequence[Evidence]) -> Array:
    """Gradients (3,) and informations (3, 3) of several frames -> the lens (3,) they show."""
    gradient, information = (np.sum(each, axis=0) for each in zip(*evidence, strict=True))
    return _lens(np.column_stack([information, gradient]))


def in_deviations(evidence: Sequence[Evidence]) -> Array:
    """Gradients and informations of several frames -> sizes (3,) of the lens they show.

    In deviations; 0 where they leave it open. A lens that is far off can bend the likelihood
    upwards along the distortion: the deviations of the focal lengths are then those without it.
    """
    information = np.sum([each for _, each in evidence], axis=0) + _OPEN
    variance = np.diag(np.linalg.inv(information)).copy()
    alone = np.diag(np.linalg.inv(information[:2, :2]))
    variance[:2] = np.where(variance[:2] > 0.0, variance[:2], alone)
    known = variance > 0.0
    deviation = np.sqrt(np.where(known, variance, 1.0))
    return np.where(known, np.abs(summed(evidence)) / deviation, 0.0)


def fitted_limits(
    outputs: Mapping[str, NDArray[Any]], sequence: NDArray[np.int64]
) -> LensLimits | None:
    """Limits from frames of the known camera: stacked outputs of n frames and sequence numbers.

    None if no recording fills a window.
    """
    largest, deviations = [], []
    clear = _is_clear(outputs["signs"])
    gradient, information = outputs["lens_gradient"], outputs["lens_information"]
    poses = outputs["solved_pose"]
    recordings = [np.flatnonzero(sequence == number) for number in np.unique(sequence)]
    step = _usual_step(poses, recordings)
    for frames in recordings:
        moved = _moved(poses, frames, step)
        evidence = [(gradient[i], information[i]) for i in moved if clear[i]]
        pairs = [in_deviations(pair) for pair in _windows(evidence, PAIR)]
        if pairs:
            deviations.append(np.max(pairs, axis=0))
        found = [summed(window) for window in _windows(evidence, WINDOW)]
        if found:
            lens = np.abs(found).max(axis=0)
            largest.append((lens[:2].max(), lens[2]))
    if not largest:
        return None
    log_focal, distortion = np.median(largest, axis=0).tolist()
    most = _DEVIATION_MOST * np.median(deviations, axis=0)
    fx, fy, k1 = np.minimum(_DEVIATION_MARGIN * np.max(deviations, axis=0), most).tolist()
    return LensLimits(
        _FOCAL_MARGIN * log_focal, _DISTORTION_MARGIN * distortion, (fx, fy, k1), step
    )


def _motion(pose: Array, other: Array) -> tuple[float, float]:
    """Return distance, m, and angle, rad, between two poses (7,)."""
    tx, ty, tz, x, y, z, w = pose.tolist()
    ux, uy, uz, a, b, c, d = other.tolist()
    cosine = min(1.0, abs(x * a + y * b + z * c + w * d))
    return math.dist((tx, ty, tz), (ux, uy, uz)), 2.0 * math.acos(cosine)


def _beyond(motion: tuple[float, float], step: tuple[float, float]) -> bool:
    return motion[0] > step[0] or motion[1] > step[1]


def _usual_step(poses: Array, recordings: Sequence[NDArray[np.int64]]) -> tuple[float, float]:
    """Return a share of the median motion between neighbouring frames, in m and rad."""
    steps = [_motion(poses[i], poses[j]) for frames in recordings for i, j in pairwise(frames)]
    if not steps:
        return _LEAST_STEP, _LEAST_STEP
    metres, radians = np.maximum(_STEP_SHARE * np.median(steps, axis=0), _LEAST_STEP).tolist()
    return metres, radians


def _moved(poses: Array, frames: NDArray[np.int64], step: tuple[float, float]) -> list[int]:
    """Return the frames that have moved since the one before them that has."""
    kept: list[int] = []
    for i in frames.tolist():
        if not kept or _beyond(_motion(poses[kept[-1]], poses[i]), step):
            kept.append(i)
    return kept


def _windows(evidence: list[Evidence], length: int) -> list[list[Evidence]]:
    return [evidence[start : start + length] for start in range(len(evidence) - length + 1)]


def _is_clear(signs: NDArray[Any]) -> NDArray[np.bool_]:
    """Signs of n frames (n, 2) -> whether each frame is clear evidence."""
    return np.asarray(signs[:, 1] <= _CONTRADICTING)
