"""Whether the images agree with the poses, or with another reading of the same numbers.

Points are tracked between neighbouring frames. A point fits a reading of the poses if it moves as a
point before both cameras would (Hartley and Zisserman 2004, sections 9.6 and 11.4.3) or, too far
away for parallax, as the rotation alone demands. Poses alone cannot tell the readings apart: a
quaternion with its numbers in another order turns by exactly the same angles, and inverse poses are
as smooth as poses.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.camera import Camera
from cvo_edge.errors import SourceError
from cvo_export.datasets.base import PoseDataset

Array = NDArray[np.float64]

# Pairs of frames that are looked at; frames between the two of a pair, the first that can be
# tracked; and tracked points and pairs without which nothing is said.
_PAIRS, _STEPS = 12, (3, 1)
_POINTS, _LEAST_POINTS, _LEAST_PAIRS = 200, 30, 4
# Width of the images in which points are tracked, and how far they may be off, pixels.
_WIDTH, _OFF_PX = 480, 1.0
# Parallax from which a point's depth counts, pixels.
_PARALLAX_PX = 2.0
# Rounding moves a camera at coordinates of 1e7 m by less than this, in the poses' unit.
_LEAST_BASELINE = 1e-6
# Focal lengths that are tried if the camera is not stated, as shares of the width.
_FOCAL = (0.6, 0.75, 0.9, 1.1)
# A reading that fits this share of points, and twice as many as the poses as read, is right.
_FITS, _TWICE = 0.4, 2.0
# Less agreement than this needs a reason.
_POOR = 0.4

_FLIPPED = np.diag([1.0, -1.0, -1.0, 1.0])
# T_body_camera of a body with x forward, y left, z up.
_FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

READ = "as read"


def _matrices(poses: Array) -> Array:
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = geometry.quaternion_to_matrix(poses[:, 3:]), poses[:, :3]
    return T


def _inverse(T: Array) -> Array:
    return np.asarray(np.linalg.inv(T), np.float64)


def _reordered(poses: Array) -> Array:
    """Return the poses if their quaternions were in the order w x y z."""
    return np.concatenate([poses[:, :3], np.roll(poses[:, 3:], -1, axis=1)], axis=1)


# What the file may hold instead, and T_world_camera (n, 4, 4) if it does.
_READINGS: dict[str, Callable[[Array], Array]] = {
    READ: _matrices,
    "quaternions in the order w x y z": lambda poses: _matrices(_reordered(poses)),
    "world-to-camera poses": lambda poses: _inverse(_matrices(poses)),
    "world-to-camera poses with quaternions in the order w x y z": (
        lambda poses: _inverse(_matrices(_reordered(poses)))
    ),
    "OpenGL camera axes (y up, z backwards)": lambda poses: _matrices(poses) @ _FLIPPED,
    "world-to-camera poses with OpenGL camera axes": (
        lambda poses: _inverse(_matrices(poses)) @ _FLIPPED
    ),
    "poses of a body with x forward and z up": lambda poses: _matrices(poses) @ _FORWARD,
}


class Agreement(NamedTuple):
    """Shares of tracked points that fit each reading of the poses, over ``pairs`` of frames.

    ``depth`` is the median distance of points that fit the poses as read, in the poses' unit; None
    without parallax.
    """

    fits: dict[str, float]
    pairs: int
    depth: float | None

    @property
    def better(self) -> str | None:
        """The reading that the images fit instead of the poses as read, or None."""
        best = max(self.fits, key=lambda reading: self.fits[reading])
        if self.fits[best] < max(_FITS, _TWICE * self.fits[READ]):
            return None
        return best

    @property
    def poor(self) -> bool:
        """Whether the images fit no reading."""
        return max(self.fits.values()) < _POOR


class _Pair(NamedTuple):
    """Two frames with the pixels (n, 2) of tracked points, in images of a width and height."""

    first: int
    second: int
    pixels: tuple[Array, Array]
    size: tuple[int, int]


def agreement_of(dataset: PoseDataset) -> Agreement | None:
    """Compare images and poses in pairs of frames from all over the data set.

    Returns None if too few points can be tracked, e.g. where frames are far apart.
    """
    pairs = [pair for first in _starts(dataset) if (pair := _tracked(dataset, first)) is not None]
    if len(pairs) < _LEAST_PAIRS:
        return None
    return max(
        (_compared(dataset.poses, pairs, focal, dataset.camera()) for focal in _focal(dataset)),
        key=lambda found: max(found.fits.values()),
    )


def _focal(dataset: PoseDataset) -> tuple[float, ...]:
    return _FOCAL if dataset.intrinsics is None else (1.0,)


def _starts(dataset: PoseDataset) -> list[int]:
    return sorted({int(i) for i in np.linspace(0, max(0, len(dataset) - _STEPS[0] - 1), _PAIRS)})


def _tracked(dataset: PoseDataset, first: int) -> _Pair | None:
    start = _grey(dataset, first)
    corners = None if start is None else cv2.goodFeaturesToTrack(start, _POINTS, 0.01, 6.0)
    if start is None or corners is None:
        return None
    for step in _STEPS:
        second = first + step
        if second >= len(dataset) or dataset.sequence[first] != dataset.sequence[second]:
            continue
        end = _grey(dataset, second)
        if end is None or end.shape != start.shape:
            continue
        found, ahead = _flow(start, end, np.asarray(corners, np.float32))
        back, behind = _flow(end, start, found)
        kept = ahead & behind & (np.linalg.norm(back - corners, axis=2)[:, 0] < _OFF_PX)
        if kept.sum() >= _LEAST_POINTS:
            pixels = corners[kept, 0].astype(np.float64), found[kept, 0].astype(np.float64)
            return _Pair(first, second, pixels, (start.shape[1], start.shape[0]))
    return None


def _flow(
    start: NDArray[np.uint8], end: NDArray[np.uint8], points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    moved = np.empty_like(points)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        start, end, points, moved, winSize=(21, 21), maxLevel=4
    )
    return np.asarray(found, np.float32), np.asarray(status[:, 0] > 0)


def _grey(dataset: PoseDataset, index: int) -> NDArray[np.uint8] | None:
    try:
        image = cv2.cvtColor(dataset.read_image(index), cv2.COLOR_BGR2GRAY)
    except SourceError:
        return None
    height, width = image.shape
    if width > _WIDTH:
        size = (_WIDTH, max(1, round(height * _WIDTH / width)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(image, np.uint8)


def _compared(poses: Array, pairs: list[_Pair], focal: float, stated: Camera | None) -> Agreement:
    fits: dict[str, list[float]] = {reading: [] for reading in _READINGS}
    depths: list[Array] = []
    for pair in pairs:
        width, height = pair.size
        camera = Camera(
            width=width,
            height=height,
            fx=focal * width,
            fy=focal * width,
            cx=0.5 * (width - 1),
            cy=0.5 * (height - 1),
        )
        if stated is not None:
            camera = stated.scaled(width, height)
        rays = [camera.rays(pixels) for pixels in pair.pixels]
        valid = np.isfinite(rays[0]).all(axis=1) & np.isfinite(rays[1]).all(axis=1)
        seen = [np.column_stack([each[valid], np.ones(valid.sum())]) for each in rays]
        both = poses[[pair.first, pair.second]]
        for reading, read in _READINGS.items():
            T = read(both)
            fit, depth = _fit(_inverse(T[1]) @ T[0], seen[0], seen[1], camera.focal_px)
            fits[reading].append(float(fit.mean()) if fit.size else 0.0)
            if reading == READ:
                depths.append(depth[fit & np.isfinite(depth)])
    depth = np.concatenate(depths)
    return Agreement(
        {reading: float(np.mean(shares)) for reading, shares in fits.items()},
        len(pairs),
        float(np.median(depth)) if depth.size else None,
    )


def _fit(T: Array, first: Array, second: Array, focal_px: float) -> tuple[NDArray[np.bool_], Array]:
    """Return which rays (n, 3) fit T_second_first (4, 4), and their depths (n,) in the first.

    A depth is NaN where there is little parallax.
    """
    R, t = T[:3, :3], T[:3, 3]
    length = float(np.linalg.norm(t))
    # Poses that are equal but for rounding give no direction of motion, which anything would fit.
    moved = length > _LEAST_BASELINE
    length = max(length, _LEAST_BASELINE)
    turned = first @ R.T
    ahead = turned[:, 2] > 0.0
    flow = np.full(len(first), np.inf)
    flow[ahead] = focal_px * np.linalg.norm(
        turned[ahead, :2] / turned[ahead, 2:] - second[ahead, :2], axis=1
    )
    # The depths along both rays whose points are nearest to each other.
    aa, ab, bb = (np.sum(p * q, axis=1) for p, q in _products(turned, second))
    at, bt = turned @ t, second @ t
    determinant = aa * bb - ab * ab + 1e-15
    depth, other = (ab * bt - bb * at) / determinant, (aa * bt - ab * at) / determinant
    # Sampson's distance to the epipolar lines.
    cross = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]]) / length
    line, back = first @ (cross @ R).T, second @ (cross @ R)
    squared = (line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    off = focal_px * np.abs((second * line).sum(axis=1)) / np.sqrt(squared + 1e-30)
    fit = (flow < _OFF_PX) | (moved & (off < _OFF_PX) & (depth > 0.0) & (other > 0.0))
    return fit, np.where(moved & (flow > _PARALLAX_PX), depth, np.nan)


def _products(a: Array, b: Array) -> tuple[tuple[Array, Array], ...]:
    return (a, a), (a, b), (b, b)
