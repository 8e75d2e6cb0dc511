"""The motion between two images of one camera, from the rays of shared points.

A first solution is that of five points (Nister 2004) that agrees with most others (RANSAC); of its
four decompositions, two have a rotation that is half a turn off (the twisted pair), which no video
has: the rotation nearest to that of a fit without translation is right. Both signs of the direction
fit equally well; points in front of both cameras decide, each one by how far it moved, so that
points without parallax decide nothing. Where most points have hardly any parallax, the fit without
translation is the better one, and says nothing of a direction.

Points of one plane fit two motions equally well (Longuet-Higgins 1986), both from their homography
(Malis and Vargas 2007). A camera turns smoothly: the one whose rotation is nearer to that of the
step before is taken, unless the other one fits better.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.frontend.refine import Refined, refine_motion, refine_rotation

Array = NDArray[np.float64]

# Median parallax (pixels) below which there is no direction.
LEAST_PARALLAX_PX = 0.3
# With fewer points that agree, or a smaller share of all, there is no motion.
LEAST_INLIERS, _LEAST_SHARE = 15, 0.3
# Pixels: how near points must be to agree with a motion; with five points', while it is sought. At
# a pixel, a motion with little parallax agrees with any direction.
_AGREES_PX, _SOUGHT_PX = 1.0, 0.25
_MOST_SAMPLES, _SURE = 100, 0.999
# Share of the points near a homography's with which the other motion of a plane is looked for, and
# how much lower the other one's loss has to be.
_PLANE, _BETTER = 0.8, 0.9
# A loss that is not worth comparing: errors of a thirtieth of their scale.
_NO_LOSS = 1e-3
# Cauchy's scale is at least this, in pixels: what follows points is not more exact.
_LEAST_SCALE_PX = 0.3
# Pixels of parallax beyond which a point counts no more for the sign of the direction.
_SURELY_PX = 2.0
# Cauchy's scale in deviations of normal errors.
_DEVIATIONS = 2.385
_RARELY = math.pi
_STILL = np.eye(3)


class Motion(NamedTuple):
    """X1 = R X2 + s t, from the later camera's frame to the earlier one's.

    Attributes
    ----------
    R
        Shape (3, 3).
    direction
        Shape (3,): the later camera's centre in the earlier one's frame, of length 1; None below
        ``LEAST_PARALLAX_PX``.
    parallax_px
        Median length of what a rotation alone leaves of the points' motion, pixels.
    inliers
        The number of points that agree with the motion.
    deviations
        Standard deviations (rad) of rotation and direction by the curvature of the loss: a scale
        of the errors, whose size it does not tell. pi without direction.
    """

    R: Array
    direction: Array | None
    parallax_px: float
    inliers: int
    deviations: tuple[float, float]


def solve(x1: Array, x2: Array, focal_px: float, before: Array = _STILL) -> Motion | None:
    """Rays (3, n) of the earlier and the later image -> the motion; None if too few points agree.

    The third component of a ray is 1; ``focal_px`` pixels are a unit. ``before`` (3, 3): the
    rotation of the step before.
    """
    if x1.shape[1] < LEAST_INLIERS:
        return None
    least = _LEAST_SCALE_PX / focal_px
    turned = refine_rotation(x1, x2, np.eye(3), least)
    parallax_px = focal_px * float(np.median(turned.errors))
    if parallax_px < LEAST_PARALLAX_PX:
        return _motion(turned, None, parallax_px, focal_px)
    start = _five_points(x1, x2, turned.R, focal_px)
    if start is None:
        return None
    moved = refine_motion(x1, x2, *start, least)
    for start in _of_plane(x1, x2, moved, focal_px):
        other = refine_motion(x1, x2, *start, least)
        scale = min(moved.scale, other.scale)
        nearer = np.sum(other.R * before) > np.sum(moved.R * before)
        if _loss(other, scale) * (_BETTER if nearer else 1.0 / _BETTER) < _loss(moved, scale):
            moved = other
    sign = _sign(x1, x2, moved, focal_px)
    return _motion(moved, sign * moved.t, parallax_px, focal_px)


def _motion(
    found: Refined, direction: Array | None, parallax_px: float, focal_px: float
) -> Motion | None:
    agree = np.abs(found.errors) * focal_px < _AGREES_PX
    inliers = int(agree.sum())
    if inliers < max(LEAST_INLIERS, _LEAST_SHARE * len(agree)):
        return None
    variance = (found.scale / _DEVIATIONS) ** 2
    information = found.information + 1e-9 * np.trace(found.information) * np.eye(
        len(found.information)
    )
    variances = variance * np.diag(np.linalg.inv(information))
    deviations = np.sqrt([variances[:3].sum(), variances[3:].sum()]).tolist()
    if direction is None:
        deviations[1] = _RARELY
    return Motion(
        found.R,
        direction,
        parallax_px,
        inliers,
        (min(deviations[0], _RARELY), min(deviations[1], _RARELY)),
    )


def _five_points(x1: Array, x2: Array, R: Array, focal_px: float) -> tuple[Array, Array] | None:
    """Return a rotation, of the two that fit the one nearest to R (3, 3), and a direction."""
    E, _ = cv2.findEssentialMat(
        np.ascontiguousarray(x2[:2].T),
        np.ascontiguousarray(x1[:2].T),
        np.eye(3),
        cv2.RANSAC,
        _SURE,
        _SOUGHT_PX / focal_px,
        _MOST_SAMPLES,
    )
    if E is None or E.shape[0] < 3 or not np.isfinite(E[:3]).all():
        return None
    first, second, t = cv2.decomposeEssentialMat(E[:3])
    nearest = max((first, second), key=lambda each: float(np.sum(each * R)))
    return np.asarray(nearest, np.float64), np.asarray(t, np.float64).ravel()


def _of_plane(x1: Array, x2: Array, found: Refined, focal_px: float) -> list[tuple[Array, Array]]:
    """Return the motions (R, t) of the points' homography; none unless they are of one plane."""
    agree = np.abs(found.errors) * focal_px < _AGREES_PX
    if agree.sum() < LEAST_INLIERS:
        return []
    H, _ = cv2.findHomography(x2[:2, agree].T, x1[:2, agree].T, 0)
    if H is None:
        return []
    y = H @ x2[:, agree]
    with np.errstate(all="ignore"):
        off_px = focal_px * np.linalg.norm(y[:2] / y[2] - x1[:2, agree], axis=0)
    if not (off_px < _AGREES_PX).mean() > _PLANE:
        return []
    _, R, t, normals = cv2.decomposeHomographyMat(H, _STILL)
    motions = []
    for each, direction, normal in zip(R, t, normals, strict=True):
        length = float(np.linalg.norm(direction))
        # A plane that the camera sees is in front of it.
        if length > 0.0 and (normal.T @ x2 > 0.0).mean() > _PLANE:
            unit = np.asarray(direction, np.float64).ravel() / length
            motions.append((np.asarray(each, np.float64), unit))
    return motions


def _loss(found: Refined, scale: float) -> float:
    return _NO_LOSS + float(np.log1p(np.square(found.errors / scale)).mean())


def _sign(x1: Array, x2: Array, found: Refined, focal_px: float) -> float:
    """Return 1 or -1: the sign of t with which points are in front of the cameras."""
    y = found.R @ x2
    moved = x1[:2] - y[:2] / y[2]
    # A point in front of the camera moves away from the later camera's centre in the image.
    away = found.t[:2, np.newaxis] - x1[:2] * found.t[2]
    away /= np.maximum(np.linalg.norm(away, axis=0), 1e-12)
    along_px = focal_px * (moved * away).sum(axis=0)
    agree = np.abs(found.errors) <= found.scale
    return math.copysign(1.0, float(np.clip(along_px[agree], -_SURELY_PX, _SURELY_PX).sum()))
