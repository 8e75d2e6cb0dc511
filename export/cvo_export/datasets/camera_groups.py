"""Nearly equal cameras count as one: a phone refocuses, and COLMAP fits a camera to each image."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import Camera

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Cameras are nearly equal if the same directions lie, in every part of the image, within this share
# of half its diagonal. Coefficients of a lens are not compared: COLMAP trades them for each other.
MOST_SPREAD = 0.01
_PLACES = (0.0, 0.25, 0.5, 0.75, 1.0)


def alike(cameras: Sequence[Camera], images: Sequence[int]) -> list[tuple[Camera, Indices]]:
    """Divide cameras into groups of nearly equal ones.

    ``cameras`` have one size and lens model, and ``images`` is the number of images of each.
    Returns for each group its camera, whose numbers are the medians over the images, and the
    indices of its members, which differ from it by at most ``MOST_SPREAD``.
    """
    numbers = np.array([_numbers(camera) for camera in cameras])
    weights = np.array(images)
    rays = _rays(_camera(cameras[0], numbers, weights))
    half = 0.5 * float(np.hypot(cameras[0].width, cameras[0].height))
    with np.errstate(all="ignore"):
        places = np.array([camera.project(rays) for camera in cameras]) / half
    left = np.arange(len(cameras))
    groups = []
    while left.size:
        own = left
        while True:
            middle = _camera(cameras[0], numbers[own], weights[own])
            with np.errstate(all="ignore"):
                off = np.abs(places[own] - middle.project(rays) / half).max(axis=(1, 2))
            near = own[off <= MOST_SPREAD]
            if near.size == own.size or own.size == 1:
                break
            own = near if near.size else own[[np.nan_to_num(off, nan=np.inf).argmin()]]
        groups.append((middle, own))
        left = np.setdiff1d(left, own)
    return groups


def _numbers(camera: Camera) -> tuple[float, ...]:
    return (camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients)


def _camera(like: Camera, numbers: Array, images: Indices) -> Camera:
    fx, fy, cx, cy, *lens = np.median(np.repeat(numbers, images, axis=0), axis=0).tolist()
    return msgspec.structs.replace(like, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=tuple(lens))


def _rays(camera: Camera) -> Array:
    """Return directions (n, 3) to all parts of the image, as if it had no distortion."""
    x, y = (
        (np.array(_PLACES) * length - centre) / focal
        for length, centre, focal in (
            (camera.width, camera.cx, camera.fx),
            (camera.height, camera.cy, camera.fy),
        )
    )
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.hstack([grid, np.ones((len(grid), 1))])
